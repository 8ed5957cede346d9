"""The connected surfaces of a frame, by number: their pixels, areas and bounding boxes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.kernels import use_compiled
from bodyseg_data.core.rig import Camera
from bodyseg_model.segmentation.people.surfaces import connected_surfaces, loops

REACH_M: Final = (0.6, 0.3)
"""Greatest distance of a small surface in front of a body and behind it, metres, that may still belong to it: of an arm
stretched towards the camera or behind the trunk, only the hand may be seen."""


class Surfaces:
    """The connected surfaces of a range image [H, W], metres, taken by `camera`.

    area_m2: float64 [N], of each as if it faced the camera.
    """

    def __init__(self, range_m: NDArray[np.float32], camera: Camera) -> None:
        self._range_m = range_m
        self._surface = connected_surfaces(range_m, camera.focal_px)
        count = int(self._surface.max(initial=-1)) + 1
        if use_compiled():
            self.area_m2, self._ends = np.zeros(count), np.zeros(count, np.intp)
            loops().measure_surfaces(range_m, self._surface, camera.focal_px, self.area_m2, self._ends)
        else:
            flat = self._surface.ravel()
            measured = np.flatnonzero(flat >= 0)
            sides = range_m.ravel()[measured].astype(np.float64) / camera.focal_px
            self.area_m2 = np.bincount(flat[measured], sides * sides, minlength=count)
            self._ends = np.cumsum(np.bincount(flat[measured], minlength=count))

    def by_size(self, least_m2: float) -> list[int]:
        """The numbers of surfaces of at least this area, the largest first."""
        large = np.flatnonzero(self.area_m2 >= least_m2)
        return [int(number) for number in large[np.argsort(-self.area_m2[large], kind="stable")]]

    def pixels_of(self, number: int) -> NDArray[np.intp]:
        """The pixels of a surface, flat indices, ascending."""
        return self._pixels[self._starts[number] : self._ends[number]]

    @property
    def _starts(self) -> NDArray[np.intp]:
        return np.concatenate([np.zeros(1, np.intp), self._ends[:-1]])

    @cached_property
    def _pixels(self) -> NDArray[np.intp]:
        """The pixels of all surfaces, one surface after another."""
        if use_compiled():
            pixels = np.empty(self._ends[-1], np.intp)
            loops().sort_pixels(self._surface, self._starts, pixels)
            return pixels
        flat = self._surface.ravel()
        measured = np.flatnonzero(flat >= 0)
        return measured[np.argsort(flat[measured], kind="stable")]

    def bounding_boxes(self) -> BoundingBoxes:
        """The bounding box of every surface."""
        lowest, highest = np.full((3, len(self.area_m2)), np.inf), np.full((3, len(self.area_m2)), -np.inf)
        if use_compiled():
            loops().bound_surfaces(self._range_m, self._surface, lowest, highest)
        elif len(self.area_m2):
            axes = (*np.divmod(self._pixels, self._range_m.shape[1]), self._range_m.ravel()[self._pixels])
            for number, axis in enumerate(axes):
                lowest[number] = np.minimum.reduceat(axis, self._starts)
                highest[number] = np.maximum.reduceat(axis, self._starts)
        return BoundingBoxes(lowest, highest)


@dataclass(frozen=True)
class BoundingBoxes:
    """Bounding boxes of surfaces: lowest and highest row, column and range (metres), each float64 [3, N]."""

    lowest: NDArray[np.float64]
    highest: NDArray[np.float64]

    def near(self, number: int) -> NDArray[np.bool_]:
        """True for surfaces that overlap one of them in rows and columns, and in range within `REACH_M`, bool [N]."""
        low, high = self.lowest[:, number].copy(), self.highest[:, number].copy()
        low[2] -= REACH_M[0]
        high[2] += REACH_M[1]
        overlap = (self.highest[:2] >= low[:2, None]) & (self.lowest[:2] <= high[:2, None])
        within = (self.lowest[2] >= low[2]) & (self.highest[2] <= high[2])
        near: NDArray[np.bool_] = overlap.all(axis=0) & within
        return near
