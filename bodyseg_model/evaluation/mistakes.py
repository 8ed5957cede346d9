"""Kinds of mistakes: left for right, front for back, both, and any other.

Left/right: the mirror part of the true one, Rt. for Lt. or the reverse.

Front/back: head, trunk and knees have parts on their front and parts on their back (`Part.face`). Within one of these
regions any front part counts as opposite to any back part. On the head that is the face (Sellion, Supramenton) against
Nuchale; on the trunk breastbone, breasts and ASIS against Cervicale, spine, PSIS and armpits; at the knees the front of
either knee against the back of either.

Both: the predicted part is on the opposite face and the opposite side. A network that mistakes a body's back for its
front makes these mistakes on trunk and knees, and plain left/right swaps on arms and feet.
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
"""Region -> landmarks of its front and back parts, without "Lt." and "Rt."."""

KINDS: Final = ("right", "left/right", "front/back", "both", "other")
"""Kinds of predictions; a kind's number is its index here. "other" is any other mistake."""

SWAPS: Final = KINDS[1:4]


def _without_side(part: Part) -> str:
    return part.landmark.removeprefix("Rt. ").removeprefix("Lt. ")


def _kind(truth: Part, predicted: Part) -> str:
    if truth is predicted:
        return "right"
    if truth.mirror == predicted.label:
        return "left/right"
    sides_differ = {truth.side, predicted.side} == {"left", "right"}
    together = any({_without_side(truth), _without_side(predicted)} <= {*names} for names in REGIONS.values())
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
