"""Selection of a set's samples from its manifest: patterns of keys, conditions, and a part of train to validate on."""
