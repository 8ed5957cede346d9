"""Motions of the open bodies: a pose for every frame."""
