"""Scores of a network on a set of range images."""
