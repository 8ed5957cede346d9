"""Input of the networks: centred ranges, and the patches that the first layer of `compact` reads."""
