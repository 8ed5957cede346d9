"""Distances along the surface, and from them the part of every point."""
