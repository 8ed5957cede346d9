"""How images become bytes: runs of equal pixels, ranges by their slopes, a checked file of zstd frames, PNG."""
