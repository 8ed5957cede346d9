"""The machine under this program: its hardware, its shared libraries."""
