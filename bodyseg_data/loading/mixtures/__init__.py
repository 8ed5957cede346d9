"""Mixtures of several sets: the sets' shares of every epoch, and the order in which each set gives its samples."""
