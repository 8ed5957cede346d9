"""The example set: 48 samples of 16 open bodies, made by the commands in docs/reference/open_bodies.md."""

from pathlib import Path

__all__ = ["example_set"]


def example_set() -> Path:
    """Return the folder of a set that ships with the package: 16 bodies from three sides, 36 samples train, 12 test.

    It is a set like any other, 1.1 MB, for all that takes the path of one: `RangeImages(example_set(), "all")`. Its
    bodies are made, so it is under the package's licence.
    """
    return Path(__file__).parent / "shards"
