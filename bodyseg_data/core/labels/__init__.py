"""Label maps: fewer classes than the 33 parts."""
