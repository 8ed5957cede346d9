"""Background removal by range: the pixels of a frame that show bodies, divided into bodies."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.rig import Camera
from bodyseg_data.core.system.divided_work import of_each
from bodyseg_model.segmentation.room_planes import LEAST_AREA_M2, TOLERANCE_PER_M, on_largest_plane
from bodyseg_model.segmentation.surfaces import GAP_PIXELS, JUMP_M, JUMP_SHARE, REACH_M, SHADOW_M, Surfaces

BackgroundMode = Literal["people", "limits", "keep"]

BODY_AREA_M2: Final = (0.05, 2.0)
"""Least and greatest visible surface of a body, square metres, as if it faced the camera."""

BODY_EXTENT_M: Final = 2.5
"""Greatest width, height or depth of a body, metres."""

BODY_HEIGHT_M: Final = 0.3
"""Least height of a body, metres; less of one cannot be recognised."""

LOOSE_AREA_M2: Final = 0.1
"""Surfaces smaller than this, such as a forearm with its hand, join a body that they overlap in the image, if within
its reach; square metres."""

_MOST_PLANES: Final = 6

Bodies = tuple[NDArray[np.intp], ...]
"""One array for each body: its pixels [N] as row * columns + column, ascending."""


@dataclass(frozen=True)
class Background:
    """Rule for removing the background before a network labels the rest.

    mode: "people" keeps surfaces within the limits that are on no large plane and have the size of a body; "limits"
    keeps every pixel within the limits, as one body; "keep" keeps every measured pixel, as one body, for frames whose
    background was removed before. near_m, far_m: the limits of range, metres. Raises BadConfig for limits in the wrong
    order.
    """

    mode: BackgroundMode = "people"
    near_m: float = 0.5
    far_m: float = 5.0

    def __post_init__(self) -> None:
        if not 0 <= self.near_m < self.far_m < float("inf"):
            raise BadConfig(
                "the near limit must be at least 0 m and less than the far one, found "
                f"{self.near_m:g} and {self.far_m:g} m"
            )

    def to_json(self) -> dict[str, Any]:
        """Everything that the removal depends on, for summary.json."""
        if self.mode == "keep":
            return {"mode": self.mode}
        if self.mode == "limits":
            return asdict(self)
        return {
            **asdict(self),
            "neighbours": {"pixels": GAP_PIXELS, "shadow_m": SHADOW_M, "jump_m": JUMP_M, "jump_share": JUMP_SHARE},
            "plane": {"least_m2": LEAST_AREA_M2, "tolerance_per_m": TOLERANCE_PER_M},
            "body": {"area_m2": list(BODY_AREA_M2), "extent_m": BODY_EXTENT_M, "height_m": BODY_HEIGHT_M},
            "loose": {"area_m2": LOOSE_AREA_M2, "reach_m": list(REACH_M)},
        }


def find_bodies(range_m: NDArray[np.float32], camera: Camera, background: Background, threads: int = 1) -> Bodies:
    """Find the bodies in a frame, the largest first; a pixel belongs to at most one.

    range_m: [H, W], metres along the optical axis, 0 = nothing measured, as are NaN and infinity. camera: the one that
    took it. threads: among which the work is divided; the bodies do not depend on it. Raises MissingLibrary without
    numba, in mode "people".
    """
    if background.mode == "keep":
        return _all_of((range_m > 0) & (range_m < np.inf))
    kept = _within_limits(range_m, background)
    return _all_of(kept > 0) if background.mode == "limits" else _people(kept, camera, threads)


def _within_limits(range_m: NDArray[np.float32], background: Background) -> NDArray[np.float32]:
    """A copy of the frame with 0 where range is not within the limits."""
    near, far = np.float32(background.near_m), np.float32(background.far_m)
    return np.where((range_m >= near) & (range_m <= far), range_m, np.float32(0))


def _all_of(mask: NDArray[np.bool_]) -> Bodies:
    pixels = np.flatnonzero(mask)
    return (pixels,) if len(pixels) else ()


def _people(range_m: NDArray[np.float32], camera: Camera, threads: int) -> Bodies:
    """Surfaces of a body's size, after large planes are removed from `range_m`, in place."""
    surfaces = Surfaces(range_m, camera, threads)
    for _ in range(_MOST_PLANES):
        large = [surfaces.pixels_of(number) for number in surfaces.by_size(LEAST_AREA_M2 / 2)]
        flat = of_each(lambda pixels: on_largest_plane(range_m, pixels, camera), large, threads)
        if not any(map(np.any, flat)):
            break
        surfaces.remove(large, flat)
    boxes = surfaces.bounding_boxes()
    taken = np.zeros(len(surfaces.area_m2), np.bool_)
    bodies = []
    for number in surfaces.by_size(BODY_AREA_M2[0]):
        if taken[number] or not _has_body_size(surfaces, number):
            continue
        taken[number] = True
        pieces = np.flatnonzero(~taken & (surfaces.area_m2 < LOOSE_AREA_M2) & boxes.near(number))
        taken[pieces] = True
        pixels = [surfaces.pixels_of(piece) for piece in (number, *pieces)]
        bodies.append(np.sort(np.concatenate(pixels), kind="stable") if len(pieces) else pixels[0])
    return tuple(bodies)


def _has_body_size(surfaces: Surfaces, number: int) -> bool:
    if surfaces.area_m2[number] > BODY_AREA_M2[1]:
        return False
    width, height, depth = surfaces.extents_m(number)
    return max(width, height, depth) <= BODY_EXTENT_M and height >= BODY_HEIGHT_M
