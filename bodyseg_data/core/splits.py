"""Train/test protocol of the paper (section 3.5): split by mesh, so that no mesh has views in both.

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

_FIRST_FOR_TRAINING: Final = {"A": 57, "people": 467}
_MOTION_FOR_TESTING: Final = {"B": "jumping", "C": "squat"}


def split_by_order(subset: Literal["A", "people"], index: int) -> Split:
    """Return the split of mesh number `index`, counted from 0 over the whole subset."""
    return "train" if index < _FIRST_FOR_TRAINING[subset] else "test"


def split_by_motion(subset: Literal["B", "C"], motion: str) -> Split:
    """Return the split of all frames of a motion sequence."""
    return "test" if motion == _MOTION_FOR_TESTING[subset] else "train"
