"""Augmentation of the batches of a training: images mirrored, rotated, zoomed and cut."""
