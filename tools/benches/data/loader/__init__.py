"""Loaders side by side."""
