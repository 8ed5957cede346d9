"""Meshes from files, in the file's order."""
