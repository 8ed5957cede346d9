"""The example set: 48 samples of 16 open bodies, made by the commands in docs/reference/open_bodies.md."""

from pathlib import Path

__all__ = ["example_set"]


def example_set() -> Path:
    """Return the folder of a set that ships with the package: 16 bodies from three sides, 36 samples train, 12 test.

    It has 1.1 MB and serves wherever the path of a set is taken: `RangeImages(example_set(), "all")`. The bodies are
    made, so the set is under the package's licence.
    """
    return Path(__file__).parent / "shards"
