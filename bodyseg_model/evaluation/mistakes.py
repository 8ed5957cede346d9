"""What kind of mistake a prediction is: the only place that knows which parts face each other, front to back.

Left/right: the part that mirrors the true one, so Rt. for Lt. and the other way round.

Front/back: head, trunk and knees have parts on their front and parts on their back (`Part.face`). Within one of these
regions any front part faces any back part: a network that takes a back for a front names whatever lies there. On the
head that is the face (Sellion, Supramenton) against Nuchale; on the trunk breastbone, breasts and ASIS against
Cervicale, spine, PSIS and armpits; the front of either knee against the back of either.

Both at once: the part lies on the other face and on the other side. A body turned round by half a turn in the mind of a
network gives these on trunk and knees, and plain left/right swaps on arms and feet.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.parts import PART_COUNT, PARTS, Part

REGIONS: Final[dict[str, tuple[str, ...]]] = {
    "head": ("Sellion", "Nuchale", "Supramenton"),
    "trunk": (
        "Suprasternale",
        "Thelion/Bustpoint",
        "Substernale",
        "ASIS",
        "Cervicale",
        "10th Rib Midspine",
        "PSIS",
        "Axilla, Post.",
    ),
    "knees": ("Femoral Lateral Epicn", "Knee Crease"),
}
"""Region -> landmarks of the parts that have a front or a back there, without their sides."""

KINDS: Final = ("right", "left/right", "front/back", "both", "other")
"""What a prediction can be; a kind's number is its place here. "other" is wrong in any other way."""

SWAPS: Final = KINDS[1:4]


def _plain(part: Part) -> str:
    return part.landmark.removeprefix("Rt. ").removeprefix("Lt. ")


def _kind(truth: Part, predicted: Part) -> str:
    if truth is predicted:
        return "right"
    if truth.mirror == predicted.label:
        return "left/right"
    sides_differ = {truth.side, predicted.side} == {"left", "right"}
    together = any(_plain(truth) in names and _plain(predicted) in names for names in REGIONS.values())
    if together and truth.face != predicted.face:
        return "both" if sides_differ else "front/back"
    return "other"


KIND_OF: Final[NDArray[np.uint8]] = np.array(
    [[KINDS.index(_kind(truth, predicted)) for predicted in PARTS] for truth in PARTS], np.uint8
)
"""Kind's number, uint8 [33, 33], row truth, column prediction."""


def count_kinds(confusion: NDArray[np.int64]) -> dict[str, int]:
    """Pixels of each kind in a confusion matrix, int64 [33, 33]."""
    counts = np.bincount(KIND_OF.ravel(), confusion.reshape(PART_COUNT**2), len(KINDS))
    return {kind: int(count) for kind, count in zip(KINDS, counts, strict=True)}
