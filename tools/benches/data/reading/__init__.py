"""Benches of opening large sets, and of many ranks that read one object store."""
