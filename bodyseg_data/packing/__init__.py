"""Packing: bodies are rendered into shards."""
