"""Engines that a packing runs on: processes of this machine, or a Dask cluster."""
