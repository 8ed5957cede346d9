"""Gross errors: how far from a pixel the part lies that is predicted for it, on the true surface.

A pixel beside a border between parts may be wrong and yet within the error of a landmark; one whose predicted part is
nowhere near is not. Both count the same in every score of classes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from importlib.util import find_spec
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.labels import BACKGROUND
from bodyseg_data.rigs import Camera

LIMITS_MM: Final = (30, 60)
"""Distances beyond which an error is gross, mm."""

FARTHEST_M: Final = 0.5
"""How far the mean takes a part to be that is farther away, or that the surface does not show at all, metres."""

_EVERY: Final = 4

MEASURABLE: Final = find_spec("scipy") is not None
"""Whether SciPy, which finds the nearest points, is installed."""


def distances_to_parts(
    points: NDArray[Any], predicted: NDArray[np.uint8], surface: NDArray[Any], surface_labels: NDArray[np.uint8]
) -> NDArray[np.float32]:
    """Distance from each point to the nearest point of the surface that has the part predicted for it, float32 [N].

    points [N, 3], surface [M, 3]: of one frame of reference, metres. predicted: uint8 [N]; surface_labels: uint8 [M].
    inf where no point of the surface has that part, 0 for a point of the surface with its own label: whoever counts
    right pixels need not look them up. Needs SciPy (`MEASURABLE`).
    """
    from scipy.spatial import cKDTree

    found = np.full(len(points), np.inf, np.float32)
    for part in np.unique(predicted):
        own, asked = surface[surface_labels == part], np.flatnonzero(predicted == part)
        if len(own):  # asked once each: a tree that is fast to build
            found[asked] = cKDTree(own, 32, compact_nodes=False, balanced_tree=False).query(points[asked])[0]
    return found


@dataclass(frozen=True, eq=False)
class TrueSurface:
    """The true surface as a camera sees it without any artifact. range_m: float32 [H, W], metres, 0 = none; labels:
    uint8 [H, W]; camera: without its distortion.

    The outlines of its parts and every fourth row and column within represent them: distances of wrong pixels of the
    example's images become longer by 13 mm at most, by 0.01 mm on average.
    """

    range_m: NDArray[np.float32] = field(repr=False)
    labels: NDArray[np.uint8] = field(repr=False)
    camera: Camera

    def points(self, pixels: NDArray[np.intp]) -> NDArray[np.float64]:
        """Points that `pixels` [N], row * W + column, see, in the camera's frame, float64 [N, 3], metres."""
        return self.camera.points(self.range_m, *np.divmod(pixels, self.camera.columns))

    @cached_property
    def _kept(self) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """Points that represent the parts, [M, 3], and their labels, [M]."""
        beside = [np.roll(self.labels, step, axis) for axis in (0, 1) for step in (-1, 1)]
        kept = np.logical_or.reduce([self.labels != each for each in beside])
        kept[::_EVERY, ::_EVERY] = True
        pixels = np.flatnonzero(kept & (self.range_m > 0) & (self.labels != BACKGROUND))
        return self.points(pixels), self.labels.ravel()[pixels]

    def distances(self, pixels: NDArray[np.intp], predicted: NDArray[np.uint8]) -> NDArray[np.float32]:
        """`distances_to_parts`, float32 [N], of pixels, int64 [N], row * W + column; predicted: uint8 [N]."""
        return distances_to_parts(self.points(pixels), predicted, *self._kept)


class GrossErrors:
    """Counts of pixels by the distance of their predicted part. pixels: in all; beyond: int64 [2], of them farther away
    than each of `LIMITS_MM`, those whose part the surface does not show among them; micrometres: summed, `FARTHEST_M`
    each at most, whole, so that sums depend on no order.
    """

    def __init__(self) -> None:
        self.pixels = 0
        self.beyond: NDArray[np.int64] = np.zeros(len(LIMITS_MM), np.int64)
        self.micrometres = 0

    def add(self, distances: NDArray[np.floating[Any]], right: int = 0) -> None:
        """Count pixels by their distances, metres, [N], inf for none, and `right` more, whose part is right."""
        self.pixels += len(distances) + right
        self.beyond += np.count_nonzero(distances[:, None] > np.divide(LIMITS_MM, 1000), axis=0)
        self.micrometres += int(np.rint(1e6 * np.minimum(distances, FARTHEST_M)).sum(dtype=np.int64))

    def merge(self, other: GrossErrors) -> None:
        """Add the counts of other pixels."""
        self.pixels += other.pixels
        self.beyond += other.beyond
        self.micrometres += other.micrometres

    def to_json(self) -> dict[str, float] | None:
        """Shares of pixels whose predicted part is farther away than each of `LIMITS_MM`, to five decimals, and the
        mean distance, right ones included, mm, to two; None if nothing was counted.
        """
        if not self.pixels:
            return None
        limits = zip(LIMITS_MM, self.beyond.tolist(), strict=True)
        shares = {f"beyond_{mm}_mm": round(beyond / self.pixels, 5) for mm, beyond in limits}
        return {**shares, "mean_mm": round(self.micrometres / 1000 / self.pixels, 2)}
