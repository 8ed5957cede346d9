"""Evaluation of a network on a set of range images: accuracy, calibration, kinds of mistakes, figures, caching."""
