"""Encodings of images: runs of equal pixels, slope residuals of ranges, a checked file of zstd frames, PNG."""
