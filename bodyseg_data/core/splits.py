"""Train/test protocol of the paper (section 3.5): split by mesh, so that no mesh has views in both.

Splits are stored in shards. The split "val" is not: it is chosen out of train while reading (docs/how-to/splits.md).

| subset          | train                           | test               |
| --------------- | ------------------------------- | ------------------ |
| A, 71 postures  | the first 57                    | the remaining 14   |
| B, 4 motions    | crane, march, squat             | jumping            |
| C, 4 motions    | bouncing, handstand, march      | squat              |
| people, 583     | the first 467                   | the remaining 116  |
"""

from __future__ import annotations

from typing import Final, Literal

Split = Literal["train", "test"]
SPLITS: Final[tuple[Split, ...]] = ("train", "test")

ReadSplit = Literal["train", "val", "test"]
READ_SPLITS: Final[tuple[ReadSplit, ...]] = ("train", "val", "test")
"""The splits that a set can be read by."""

_FIRST_FOR_TRAINING: Final = {"A": 57, "people": 467}
_MOTION_FOR_TESTING: Final = {"B": "jumping", "C": "squat"}


def split_by_order(subset: Literal["A", "people"], index: int) -> Split:
    """Return the split of mesh number `index`, counted from 0 over the whole subset."""
    return "train" if index < _FIRST_FOR_TRAINING[subset] else "test"


def split_by_motion(subset: Literal["B", "C"], motion: str) -> Split:
    """Return the split of all frames of a motion sequence."""
    return "test" if motion == _MOTION_FOR_TESTING[subset] else "train"


def motion_of(subset: str, pose: str) -> str:
    """Return the motion whose frame a body is: its pose in the subsets B and C, "" in others, which hold postures."""
    return pose if subset in _MOTION_FOR_TESTING else ""


def holds_postures(subset: str) -> bool:
    """Return whether every mesh of one of the paper's subsets is a posture of its own, not a frame of a motion."""
    return subset in _FIRST_FOR_TRAINING
