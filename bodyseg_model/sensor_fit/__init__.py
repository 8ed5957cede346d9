"""Measurement of a sensor's artifacts from its own frames: a verdict for each artifact, and a sensor file."""
