"""Pictures of labelled frames: overlays, their animation, and their encoding."""
