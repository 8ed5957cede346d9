"""Gross errors: how far from a pixel the part lies that is predicted for it, on the true surface.

A pixel beside a border between parts may be wrong and yet within the error of a landmark; one whose predicted part is
nowhere near is not. Both count the same in every score of classes.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.rigs import Camera

LIMITS_MM: Final = (30, 60)
"""Distances beyond which an error is gross, mm."""

FARTHEST_M: Final = 0.5
"""How far the mean takes a part to be that is farther away, or that the surface does not show at all, metres."""

_EVERY: Final = 4  # rows and columns of pixels inside a part that stand for it: at most 6 mm off at 2.5 m

MEASURABLE: Final = find_spec("scipy") is not None
"""Whether SciPy, which finds the nearest points, is installed."""


def distances_to_parts(
    points: NDArray[Any], predicted: NDArray[np.uint8], surface: NDArray[Any], surface_labels: NDArray[np.uint8]
) -> NDArray[np.float32]:
    """Distance from each point to the nearest point of the surface that has the part predicted for it, float32 [N].

    points [N, 3], surface [M, 3]: of one frame of reference, metres. predicted: uint8 [N]; surface_labels: uint8 [M].
    inf where no point of the surface has that part, 0 for a point of the surface with its own label: whoever counts
    right pixels need not look them up. Raises BadConfig for arrays of other shapes, MissingLibrary without SciPy.
    """
    for name, each, labels in (("points", points, predicted), ("the surface", surface, surface_labels)):
        if each.shape != (*labels.shape, 3) or labels.ndim != 1:
            raise BadConfig(f"{name} must be [N, 3] with labels [N], found {each.shape} and {labels.shape}")
    try:
        from scipy.spatial import cKDTree
    except ImportError as error:
        raise MissingLibrary("gross errors need SciPy: pip install 'bodyseg[segment]'") from error
    found = np.full(len(points), np.inf, np.float32)
    for part in np.unique(predicted):
        own, asked = surface[surface_labels == part], np.flatnonzero(predicted == part)
        if len(own):  # asked once each: a tree that is fast to build
            found[asked] = cKDTree(own, 32, compact_nodes=False, balanced_tree=False).query(points[asked])[0]
    return found


def distances_in_image(
    truth: NDArray[np.uint8],
    predicted: NDArray[np.uint8],
    range_m: NDArray[np.float32],
    labels: NDArray[np.uint8],
    camera: Camera,
) -> NDArray[np.float32]:
    """`distances_to_parts` of the wrong pixels of an image that show the true surface, float32 [N], in reading order.

    truth, predicted: uint8 [H, W], of the image as the network got it; `BACKGROUND` in the truth does not count.
    range_m: float32 [H, W], metres, 0 = none; labels: uint8 [H, W]: of the surface as `camera` sees it without any
    artifact, where every pixel has its place. The surface is represented by the outlines of its parts and by every
    fourth row and column within: distances are too long by less than 0.5 mm.
    """
    shown, border = range_m > 0, np.zeros(labels.shape, np.bool_)
    across, down = labels[:, 1:] != labels[:, :-1], labels[1:] != labels[:-1]
    for where, changes in ((np.s_[:, 1:], across), (np.s_[:, :-1], across), (np.s_[1:], down), (np.s_[:-1], down)):
        border[where] |= changes
    border[::_EVERY, ::_EVERY] = True
    wrong = np.flatnonzero((truth != BACKGROUND) & (truth != predicted) & shown)
    kept = np.flatnonzero(border & shown & (labels != BACKGROUND))
    slopes = camera.slopes

    def points(pixels: NDArray[np.intp]) -> NDArray[np.float64]:
        row, column = np.divmod(pixels, camera.columns)
        return np.stack([slopes[0][column], slopes[1][row], np.ones(len(row))], 1) * range_m.ravel()[pixels, None]

    return distances_to_parts(points(wrong), predicted.ravel()[wrong], points(kept), labels.ravel()[kept])


class GrossErrors:
    """Counts of pixels by the distance of their predicted part. pixels: in all; beyond: int64 [2], of them farther away
    than each of `LIMITS_MM`, those whose part the surface does not show among them; metres: summed, `FARTHEST_M` each
    at most.
    """

    def __init__(self) -> None:
        self.pixels = 0
        self.beyond: NDArray[np.int64] = np.zeros(len(LIMITS_MM), np.int64)
        self.metres = 0.0

    def __repr__(self) -> str:
        return f"GrossErrors({self.pixels} pixels, {self.to_json()})"

    def add(self, distances: NDArray[np.floating[Any]], right: int = 0) -> None:
        """Count pixels by their distances, metres, [N], inf for none, and `right` more, whose part is right."""
        self.pixels += len(distances) + right
        self.beyond += np.count_nonzero(distances[:, None] > np.divide(LIMITS_MM, 1000), axis=0)
        self.metres += float(np.minimum(distances, FARTHEST_M).sum(dtype=np.float64))

    def merge(self, other: GrossErrors) -> None:
        """Add the counts of other pixels."""
        self.pixels += other.pixels
        self.beyond += other.beyond
        self.metres += other.metres

    def shares(self) -> NDArray[np.float64]:
        """Share of pixels whose predicted part is farther away than each of `LIMITS_MM`; NaN if none was counted."""
        return self.beyond / (self.pixels or np.nan)

    def mean_mm(self) -> float:
        """Mean distance of pixels and their predicted parts, mm, right ones included; NaN if none was counted."""
        return 1000 * self.metres / (self.pixels or float("nan"))

    def to_json(self) -> dict[str, float] | None:
        """The scores as JSON: shares to five decimals, mm to two; None if nothing was counted."""
        if not self.pixels:
            return None
        shares = {f"beyond_{mm}_mm": round(float(share), 5) for mm, share in zip(LIMITS_MM, self.shares(), strict=True)}
        return {**shares, "mean_mm": round(self.mean_mm(), 2)}
