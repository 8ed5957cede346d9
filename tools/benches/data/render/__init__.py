"""Renderers side by side."""
