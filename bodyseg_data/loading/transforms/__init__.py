"""Transforms of samples in the loader's workers, after the artifacts: the protocol, and those that ship."""
