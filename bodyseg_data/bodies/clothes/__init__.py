"""Clothes over the open body."""
