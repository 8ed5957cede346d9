"""Geodesic distances from landmarks, and the partition of the surface into parts."""
