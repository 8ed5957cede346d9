"""The steps that make docs/results, and `tools/bench all`, which runs those that are stale."""
