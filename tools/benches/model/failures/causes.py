"""Causes of wrong pixels: eleven, each an exact rule; docs/results/failures.md says why they are tried in this order.

Rules about a place depend on the clean sample and on what the variant left of it; rules about a mistake on the
network's prediction; rules about an image hold for all of its pixels or for none.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

from benches.model.border_distance import EDGES, distance_bins
from bodyseg_data.artifacts import RangeImage
from bodyseg_data.labels import BACKGROUND, PART_CLASSES, PART_COUNT, PARTS, PARTS33
from bodyseg_data.rigs import Camera
from bodyseg_data.samples import Sample
from bodyseg_model.evaluation import KINDS, kinds_of

About = Literal["a place", "a mistake", "an image"]

NEAR_PX: Final = 8
LEAST_MEASURED: Final = 0.4
FRAME_PX: Final = 32
GRAZING_DEG: Final = 70.0
BORDER_PX: Final = 2
NEW_POSE_DEG: Final = 30.0
NOISE_MM: Final = 60.0


@dataclass(frozen=True)
class Cause:
    """One cause. rule: when it holds."""

    name: str
    about: About
    rule: str


CAUSES: Final = (
    Cause(
        "lost_data",
        "a place",
        f"less than {LEAST_MEASURED:.0%} of the body's pixels within {NEAR_PX} rows and columns were measured",
    ),
    Cause(
        "out_of_frame",
        "a place",
        f"within {FRAME_PX} px of an edge of the image that the body touches",
    ),
    Cause(
        "grazing",
        "a place",
        f"the clean surface is seen at more than {GRAZING_DEG:.0f} degrees from its normal",
    ),
    Cause(
        "contact",
        "a place",
        f"a part that does not adjoin on the body within {NEAR_PX} rows and columns of the clean labels",
    ),
    Cause(
        "border",
        "a place",
        f"within {BORDER_PX} px of a pixel of another part in the clean labels",
    ),
    Cause(
        "left/right",
        "a mistake",
        f"named as the mirror part, which is not within {NEAR_PX} rows and columns",
    ),
    Cause(
        "front/back",
        "a mistake",
        f"a front part for a back one, or the reverse, and none of it within {NEAR_PX} rows and columns",
    ),
    Cause(
        "pose",
        "an image",
        f"some segment of the body points more than {NEW_POSE_DEG:.0f} degrees elsewhere than in any training body",
    ),
    Cause(
        "noise",
        "an image",
        f"sigma of the image's noise above {NOISE_MM:.0f} mm",
    ),
    Cause(
        "border_moved",
        "a mistake",
        f"named as another part that is within {NEAR_PX} rows and columns",
    ),
    Cause("unexplained", "a mistake", "none of the above"),
)
"""In the order in which they are tried: the first whose rule holds is a pixel's cause."""

NAMES: Final = tuple(cause.name for cause in CAUSES)

_JOINED: Final[dict[str, tuple[str, ...]]] = {
    "Sellion": ("Nuchale", "Supramenton"),
    "Nuchale": ("Supramenton", "Cervicale"),
    "Supramenton": ("Suprasternale", "Cervicale"),
    "Suprasternale": ("Rt. Thelion/Bustpoint", "Substernale", "Cervicale", "Rt. Acromion"),
    "Rt. Thelion/Bustpoint": (
        *("Lt. Thelion/Bustpoint", "Substernale", "Rt. ASIS", "10th Rib Midspine", "Rt. PSIS", "Rt. Axilla, Post."),
        "Rt. Acromion",
    ),
    "Substernale": ("Rt. ASIS",),
    "Rt. ASIS": (*("Lt. ASIS", "10th Rib Midspine", "Rt. PSIS", "Lt. PSIS", "Rt. Trochanterion", "Rt. Knee Crease"),),
    "Cervicale": ("10th Rib Midspine", "Rt. Axilla, Post.", "Rt. Acromion"),
    "10th Rib Midspine": ("Rt. PSIS", "Rt. Axilla, Post."),
    "Rt. PSIS": ("Lt. PSIS", "Rt. Axilla, Post.", "Rt. Trochanterion", "Lt. Trochanterion", "Rt. Knee Crease"),
    "Rt. Axilla, Post.": ("Rt. Acromion", "Rt. Olecranon"),
    "Rt. Acromion": ("Rt. Olecranon",),
    "Rt. Olecranon": ("Rt. Radial Styloid",),
    "Rt. Radial Styloid": ("Rt. Dactylion",),
    "Rt. Trochanterion": ("Rt. Femoral Lateral Epicn", "Rt. Knee Crease"),
    "Rt. Femoral Lateral Epicn": ("Rt. Knee Crease", "Rt. Lateral Malleolus"),
    "Rt. Knee Crease": ("Rt. Lateral Malleolus",),
    "Rt. Lateral Malleolus": ("Rt. Digit II",),
}
"""Parts that share an edge on the open body, in any of twelve people and postures; the other side is the same."""


def _adjoining() -> NDArray[np.bool_]:
    """True where two parts adjoin on the body, or are the same: bool [33, 33]."""
    labels = {part.landmark: part.label for part in PARTS}
    found = np.eye(PART_COUNT, dtype=np.bool_)
    for name, others in _JOINED.items():
        for other in others:
            pair = [labels[name], labels[other]]
            for one, two in (pair, PART_CLASSES.mirrored[pair].tolist()):
                found[one, two] = found[two, one] = True
    return found


ADJOINING: Final = _adjoining()

_BITS: Final[NDArray[np.uint64]] = np.array(
    [1 << label if label < PART_COUNT else 0 for label in range(256)], np.uint64
)
_STRANGERS: Final[NDArray[np.uint64]] = np.array(
    [sum(1 << other for other in np.flatnonzero(~row).tolist()) for row in ADJOINING] + [0] * (256 - PART_COUNT),
    np.uint64,
)
"""The bits of the parts that do not adjoin a part."""


class Prediction(NamedTuple):
    """One image and a network's labels of it, uint8 [H, W]. new_pose_deg: NaN if it is not known."""

    clean: Sample
    shown: RangeImage
    labels: NDArray[np.uint8]
    new_pose_deg: float


def holds(prediction: Prediction, camera: Camera) -> NDArray[np.bool_]:
    """Evaluate all causes' rules at the pixels that were measured: bool [11, N], reading order, causes as in `CAUSES`.

    Rules about a mistake hold nowhere else than at wrong pixels; "unexplained" holds at all of those. camera: the one
    that took the images.
    """
    clean, shown = prediction.clean, prediction.shown
    where = np.flatnonzero(shown.labels != BACKGROUND)
    truth, predicted = shown.labels.ravel()[where], prediction.labels.ravel()[where]
    body = clean.labels != BACKGROUND

    def at(image: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return image.ravel()[where]

    near = parts_within(clean.labels, NEAR_PX).ravel()[where]
    measured = window_sums(shown.labels != BACKGROUND, NEAR_PX)
    kinds = kinds_of(PARTS33)[truth, predicted]
    wrong = kinds != KINDS.index("right")
    moved = wrong & ((_BITS[predicted] & near) != 0)
    with np.errstate(invalid="ignore"):
        grazing = viewing_angles(clean.range, camera) > GRAZING_DEG
    everywhere = np.ones(len(where), np.bool_)
    sigma = shown.drawn.get("sigma_mm", 0.0)
    found: dict[str, NDArray[np.bool_]] = {
        "lost_data": at(measured < LEAST_MEASURED * window_sums(body, NEAR_PX)),
        "out_of_frame": at(edge_distance(body) < FRAME_PX),
        "grazing": at(grazing),
        "contact": (near & _STRANGERS[truth]) != 0,
        "border": at(distance_bins(clean.labels) <= EDGES.index(BORDER_PX)),
        "left/right": ~moved & (kinds == KINDS.index("left/right")),
        "front/back": ~moved & ((kinds == KINDS.index("front/back")) | (kinds == KINDS.index("both"))),
        "pose": everywhere & (prediction.new_pose_deg > NEW_POSE_DEG),
        "noise": everywhere & (sigma > NOISE_MM),
        "border_moved": moved,
        "unexplained": wrong,
    }
    return np.stack([found[name] for name in NAMES])


def parts_within(labels: NDArray[np.uint8], reach: int) -> NDArray[np.uint64]:
    """Parts within `reach` rows and columns of each pixel: bit n for part n, uint64 [H, W]."""
    seen = _BITS[labels]
    for _ in range(2):  # along rows, then columns; each transposes
        seen = np.pad(seen, ((reach, reach), (0, 0)))
        covered, wanted = 1, 2 * reach + 1
        while covered < wanted:
            step = min(covered, wanted - covered)
            seen = seen[:-step] | seen[step:]
            covered += step
        seen = seen.T
    return seen


def window_sums(mask: NDArray[np.bool_], reach: int) -> NDArray[np.int32]:
    """Count a mask's pixels within `reach` rows and columns of each pixel, int32 [H, W]."""
    sums = mask.astype(np.int32)
    for axis in range(2):
        sums = convolve1d(sums, np.ones(2 * reach + 1), axis, mode="constant")
    return sums


def edge_distance(body: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Pixels from each pixel to the nearest edge of the image that the body touches, int64 [H, W]: 0 for the outermost
    row or column; rows + columns everywhere if it touches none.
    """
    rows, columns = (np.arange(size) for size in body.shape)
    found = np.full(body.shape, sum(body.shape))
    for touched, distance in (
        (body[0].any(), rows[:, None]),
        (body[-1].any(), rows[::-1, None]),
        (body[:, 0].any(), columns),
        (body[:, -1].any(), columns[::-1]),
    ):
        if touched:
            found = np.minimum(found, distance)
    return found


def viewing_angles(range_steps: NDArray[np.uint16], camera: Camera) -> NDArray[np.float64]:
    """Angle between the surface's normal and the ray that sees it, degrees [H, W]; NaN where no normal can be had.

    The normal is the cross product of the steps to a neighbour in the row and one in the column: of both sides the one
    whose range differs less, so that an edge in depth is no slope. range_steps: a clean range image of `camera`.
    """
    body = range_steps != 0
    rows, columns = np.flatnonzero(body.any(axis=1)), np.flatnonzero(body.any(axis=0))
    angles = np.full(body.shape, np.nan)
    if not rows.size:
        return angles
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    rays = _rays(camera)[box]
    # In steps: the length of a step changes no angle.
    points = rays * np.where(body[box], range_steps[box], np.nan)[..., None]
    down, along = _smaller_steps(points), _smaller_steps(points.transpose(1, 0, 2)).transpose(1, 0, 2)
    normals = np.cross(down, along)
    lengths = np.linalg.norm(normals, axis=2) * np.linalg.norm(rays, axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosines = np.abs((normals * rays).sum(axis=2)) / lengths
    angles[box] = np.degrees(np.arccos(np.clip(cosines, 0, 1)))
    return angles


@lru_cache(maxsize=2)
def _rays(camera: Camera) -> NDArray[np.float64]:
    return camera.pixel_rays()


def _smaller_steps(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """From points [H, W, 3] to the next ones down or from those above, whichever changes range less; NaN if none."""
    steps = np.full((points.shape[0] + 1, *points.shape[1:]), np.nan)
    steps[1:-1] = np.diff(points, axis=0)
    before, after = steps[:-1], steps[1:]
    with np.errstate(invalid="ignore"):
        first = np.isnan(after[..., 2]) | (np.abs(before[..., 2]) < np.abs(after[..., 2]))
    return np.where(first[..., None], before, after)
