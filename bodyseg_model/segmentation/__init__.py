"""Segmentation of the frames of a real sensor: background removal, resampling, labels, overlays."""
