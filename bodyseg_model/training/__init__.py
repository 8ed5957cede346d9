"""Training: shards and a recipe give a network."""
