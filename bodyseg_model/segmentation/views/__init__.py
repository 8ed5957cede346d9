"""Views of a frame as networks see them: without lens distortion, each body as the trained camera would see it."""
