"""Codecs side by side."""
