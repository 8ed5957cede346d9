"""Kinds of mistakes: left for right, front for back, both, and any other.

Left/right: the mirror part of the true one, Rt. for Lt. or the reverse.

Front/back: head, trunk and knees have parts on their front and parts on their back (`Part.face`). Within one of these
regions any front part counts as opposite to any back part. On the head that is the face (Sellion, Supramenton) against
Nuchale; on the trunk breastbone, breasts and ASIS against Cervicale, spine, PSIS and armpits; at the knees the front of
either knee against the back of either.

Both: the predicted part is on the opposite face and the opposite side. A network that mistakes a body's back for its
front makes these mistakes on trunk and knees, and plain left/right swaps on arms and feet.

Classes that join parts have a kind only where it can be told: a class has a face or a side if all its parts have it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.labels.label_map import PARTS33, LabelMap
from bodyseg_data.core.parts import Part

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


@lru_cache(maxsize=16)
def kinds_of(label_map: LabelMap) -> NDArray[np.uint8]:
    """Kind's number of every pair of classes, uint8 [C, C], row truth, column prediction; not to be written to."""
    labels = range(len(label_map))
    kinds = [[KINDS.index(_kind(label_map, truth, predicted)) for predicted in labels] for truth in labels]
    found = np.array(kinds, np.uint8)
    found.setflags(write=False)
    return found


def _kind(label_map: LabelMap, truth: int, predicted: int) -> str:
    if truth == predicted:
        return "right"
    if label_map.mirrored[truth] == predicted:
        return "left/right"
    true_parts, predicted_parts = label_map.parts[truth], label_map.parts[predicted]
    names = {_without_side(part) for part in (*true_parts, *predicted_parts)}
    faces = [{part.face for part in parts} for parts in (true_parts, predicted_parts)]
    if any(names <= {*region} for region in REGIONS.values()) and faces in _OPPOSITE:
        sides = [{part.side for part in parts} for parts in (true_parts, predicted_parts)]
        return "both" if sides in ([{"left"}, {"right"}], [{"right"}, {"left"}]) else "front/back"
    return "other"


_OPPOSITE: Final = ([{"front"}, {"back"}], [{"back"}, {"front"}])


def count_kinds(confusion: NDArray[np.int64], label_map: LabelMap = PARTS33) -> dict[str, int | None]:
    """Pixels of each kind in a confusion matrix, int64 [C, C]; None for a kind that the classes cannot tell."""
    counts = np.bincount(kinds_of(label_map).ravel(), confusion.ravel(), len(KINDS))
    told = told_kinds(label_map)
    return {kind: int(count) if kind in told else None for kind, count in zip(KINDS, counts, strict=True)}


def told_kinds(label_map: LabelMap) -> frozenset[str]:
    """Kinds that a prediction of these classes can have: joined front and back parts are no mistake any more."""
    return frozenset(KINDS[number] for number in np.unique(kinds_of(label_map)).tolist())
