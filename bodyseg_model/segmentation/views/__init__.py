"""What a network sees of a frame: without lens distortion, and each body as the trained camera would see it."""
