"""Shadow tests side by side."""
