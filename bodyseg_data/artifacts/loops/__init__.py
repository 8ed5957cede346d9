"""Compiled loops of the artifacts, and their memory; `fused.py` applies those of Table 1 to a sample in one call."""
