"""Compiled loops of the artifacts, and their memory; `artifacts/compiled.py` applies them to a sample."""
