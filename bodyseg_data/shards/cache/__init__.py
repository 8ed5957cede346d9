"""Shards from elsewhere, kept in a bounded folder."""
