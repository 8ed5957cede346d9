"""Scores by which a segmentation of range images into body parts is judged."""
