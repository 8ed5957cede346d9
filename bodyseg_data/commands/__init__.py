"""Commands of `bodyseg`: one module a command, each with its options, an example and `run`."""
