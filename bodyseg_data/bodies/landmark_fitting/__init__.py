"""Landmark proposals for a mesh that has none, from the open body fitted to it."""
