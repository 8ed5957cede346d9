"""Shards (plain tars of samples), their manifest, codecs, stores and cache."""
