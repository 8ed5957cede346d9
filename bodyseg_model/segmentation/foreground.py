"""Background removal by range: which pixels of a frame are bodies, and which belong to one body."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.rig import Camera
from bodyseg_model.segmentation.room_planes import LEAST_AREA_M2, TOLERANCE_PER_M, on_largest_plane
from bodyseg_model.segmentation.surfaces import GAP_PIXELS, JUMP_M, JUMP_SHARE, SHADOW_M, connected_surfaces

BackgroundMode = Literal["people", "limits", "keep"]

BODY_AREA_M2: Final = (0.05, 2.0)
"""Surface of a body that a camera may see, as it would face the camera."""

BODY_EXTENT_M: Final = 2.5
"""No body is larger than this in width, height or depth."""

BODY_HEIGHT_M: Final = 0.3
"""What is less high is no body, nor the part of one that can be recognised."""

LOOSE_AREA_M2: Final = 0.1
"""A piece smaller than this, a forearm with its hand, belongs to a body that it overlaps in the image, if in reach."""

REACH_M: Final = (0.6, 0.3)
"""How far before and behind a body such a piece may be: of an arm held towards the camera, or beyond the trunk, only
the hand may be seen.
"""

_MOST_PLANES: Final = 6

Bodies = tuple[NDArray[np.intp], ...]
"""One array a body: its pixels [N] as row * columns + column, ascending."""


@dataclass(frozen=True)
class Background:
    """What is taken away before the network looks.

    mode: "people" keeps what lies within the limits, on no large plane, and has the size of a body; "limits" keeps all
    that lies within the limits, as one body; "keep" keeps all that was measured, as one body, for frames whose
    background is gone already. near_m, far_m: the limits, metres.
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
        """All that the removal depends on."""
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


def find_bodies(range_m: NDArray[np.float32], camera: Camera, background: Background) -> Bodies:
    """The bodies in a frame, the largest first; a pixel belongs to one at most.

    range_m: [H, W], metres along the optical axis, 0 = nothing measured. camera: the one that took it.
    """
    if background.mode == "keep":
        return _all_of(range_m > 0)
    within = (range_m > 0) & (range_m >= background.near_m) & (range_m <= background.far_m)
    return _all_of(within) if background.mode == "limits" else _people(np.where(within, range_m, 0), camera)


def _all_of(mask: NDArray[np.bool_]) -> Bodies:
    pixels = np.flatnonzero(mask)
    return (pixels,) if len(pixels) else ()


def _people(range_m: NDArray[np.float32], camera: Camera) -> Bodies:
    """Surfaces of a body's size, once large planes are gone from `range_m`, which is changed."""
    surfaces = _Surfaces(range_m, camera)
    for _ in range(_MOST_PLANES):
        large = [surfaces.pixels_of(number) for number in surfaces.by_size(LEAST_AREA_M2 / 2)]
        flat = [pixels[on_largest_plane(range_m, pixels, camera)] for pixels in large]
        if not sum(map(len, flat)):
            break
        range_m.ravel()[np.concatenate(flat)] = 0
        surfaces = _Surfaces(range_m, camera)
    places = surfaces.places()
    taken = np.zeros(len(surfaces.area_m2), np.bool_)
    bodies = []
    for number in surfaces.by_size(BODY_AREA_M2[0]):
        if taken[number] or not _is_of_a_body(surfaces.pixels_of(number), range_m, camera):
            continue
        taken[number] = True
        parts = np.flatnonzero(~taken & (surfaces.area_m2 < LOOSE_AREA_M2) & places.near(number))
        taken[parts] = True
        bodies.append(np.sort(np.concatenate([surfaces.pixels_of(part) for part in (number, *parts)])))
    return tuple(bodies)


def _is_of_a_body(pixels: NDArray[np.intp], range_m: NDArray[np.float32], camera: Camera) -> bool:
    """Whether a surface has a body's size."""
    rows, columns = np.divmod(pixels, range_m.shape[1])
    depths = range_m.ravel()[pixels].astype(np.float64)
    width = np.ptp((columns + 0.5 - camera.centre_px[0]) * depths) / camera.focal_px
    height = np.ptp((rows + 0.5 - camera.centre_px[1]) * depths) / camera.focal_px
    area = ((depths / camera.focal_px) ** 2).sum()
    extent = max(width, height, np.ptp(depths))
    return bool(area <= BODY_AREA_M2[1] and height >= BODY_HEIGHT_M and extent <= BODY_EXTENT_M)


class _Surfaces:
    """The connected surfaces of a range image [H, W], metres, by number. area_m2: [N], as if they faced the camera."""

    def __init__(self, range_m: NDArray[np.float32], camera: Camera) -> None:
        pixels = np.flatnonzero(range_m)
        surface = connected_surfaces(range_m, camera.focal_px).ravel()[pixels]
        order = np.argsort(surface, kind="stable")
        self._pixels = pixels[order]
        self._ends = np.cumsum(np.bincount(surface))
        depths = range_m.ravel()[pixels].astype(np.float64)
        self.area_m2 = np.bincount(surface, (depths / camera.focal_px) ** 2)
        self._range_m = range_m

    def by_size(self, least_m2: float) -> list[int]:
        """The numbers of those of at least this area, the largest first."""
        order = np.argsort(-self.area_m2, kind="stable")
        return [int(number) for number in order if self.area_m2[number] >= least_m2]

    def pixels_of(self, number: int) -> NDArray[np.intp]:
        """Flat indices, ascending."""
        return self._pixels[self._ends[number - 1] if number else 0 : self._ends[number]]

    def places(self) -> _Places:
        """Where they all are."""
        starts = np.concatenate([[0], self._ends[:-1]]) if len(self._ends) else np.empty(0, np.intp)
        seen = (*np.divmod(self._pixels, self._range_m.shape[1]), self._range_m.ravel()[self._pixels])
        lowest = np.array([np.minimum.reduceat(place, starts) if len(starts) else [] for place in seen])
        highest = np.array([np.maximum.reduceat(place, starts) if len(starts) else [] for place in seen])
        return _Places(lowest, highest)


@dataclass(frozen=True)
class _Places:
    """The blocks of space around some surfaces: lowest and highest rows, columns and ranges (metres), each [3, N]."""

    lowest: NDArray[np.float64]
    highest: NDArray[np.float64]

    def near(self, number: int) -> NDArray[np.bool_]:
        """Which surfaces overlap the outline of one of them and are as far away as it is, within reach, bool [N]."""
        low, high = self.lowest[:, number].copy(), self.highest[:, number].copy()
        low[2] -= REACH_M[0]
        high[2] += REACH_M[1]
        overlap = (self.highest[:2] >= low[:2, None]) & (self.lowest[:2] <= high[:2, None])
        within = (self.lowest[2] >= low[2]) & (self.highest[2] <= high[2])
        near: NDArray[np.bool_] = overlap.all(axis=0) & within
        return near
