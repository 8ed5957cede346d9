"""Batches of range images from shards."""
