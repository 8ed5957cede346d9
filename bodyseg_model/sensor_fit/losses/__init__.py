"""Pixels lost on bodies: the body as it would be without loss, and the ways in which pixels of it are lost."""
