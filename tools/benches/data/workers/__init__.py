"""Worker threads beside worker processes."""
