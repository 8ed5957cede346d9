"""A set of shards that ships with the package."""
