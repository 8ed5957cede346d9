"""The connected surfaces of a frame, by number: their pixels, areas and bounding boxes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.kernels import use_compiled
from bodyseg_data.core.rig import Camera
from bodyseg_model.segmentation.people.surfaces import GAP_PIXELS, find_segments, joined_surfaces, jumps, loops, within

REACH_M: Final = (0.6, 0.3)
"""Greatest distance of a small surface in front of a body and behind it, metres, that may still belong to it: of an arm
stretched towards the camera or behind the trunk, only the hand may be seen."""


class Surfaces:
    """The connected surfaces of a range image [H, W], metres, taken by `camera`. The image is changed by `remove`.

    area_m2: float64 [N], of each as if it faced the camera. threads: among which rows are divided.
    """

    def __init__(self, range_m: NDArray[np.float32], camera: Camera, threads: int = 1) -> None:
        self._range_m, self._camera, self._threads = range_m, camera, threads
        self._level = jumps(range_m)
        self._find()

    def __repr__(self) -> str:
        return f"Surfaces({len(self.area_m2)} of {self._range_m.shape[0]} x {self._range_m.shape[1]} pixels)"

    def _find(self) -> None:
        focal_px = self._camera.focal_px
        if use_compiled():
            self._segments, segment_m2, count = find_segments(self._range_m, self._level, focal_px, self._threads)
            self.area_m2 = np.zeros(count)
            self._counts = np.zeros(count, np.intp)
            loops().measure_surfaces(self._segments, segment_m2, self.area_m2, self._counts)
            return
        surface = joined_surfaces(self._range_m, self._level, focal_px).ravel()
        pixels = np.flatnonzero(surface >= 0)
        count = int(surface.max(initial=-1)) + 1
        # Summed by segments first, as the compiled form does.
        here, left = within(self._level), self._level[GAP_PIXELS:, GAP_PIXELS - 1 : -GAP_PIXELS]
        with np.errstate(invalid="ignore"):  # inf - inf
            segment = np.cumsum(~(np.abs(here - left) <= 1).ravel()[pixels]) - 1
        sides = self._range_m.ravel()[pixels].astype(np.float64) / focal_px
        segments_m2 = np.bincount(segment, sides * sides)
        first = np.flatnonzero(np.diff(segment, prepend=-1))
        self.area_m2 = np.bincount(surface[pixels[first]], segments_m2, minlength=count).astype(np.float64)
        self._counts = np.bincount(surface[pixels], minlength=count)
        self._pixels = pixels[np.argsort(surface[pixels], kind="stable")]

    def by_size(self, least_m2: float) -> list[int]:
        """The numbers of surfaces of at least this area, the largest first."""
        large = np.flatnonzero(self.area_m2 >= least_m2)
        return [int(number) for number in large[np.argsort(-self.area_m2[large], kind="stable")]]

    def pixels_of(self, number: int) -> NDArray[np.intp]:
        """The pixels of a surface, flat indices, ascending."""
        if use_compiled():
            pixels = np.empty(self._counts[number], np.intp)
            loops().list_pixels(self._segments, number, pixels)
            return pixels
        start = int(self._counts[:number].sum())
        return self._pixels[start : start + self._counts[number]]

    def remove(self, pixels: Sequence[NDArray[np.intp]], flat: Sequence[NDArray[np.bool_]]) -> None:
        """Take pixels, ascending flat indices [N], out of the image where `flat`, bool [N], is True; surface by
        surface. What is left is numbered anew.
        """
        for some, gone in zip(pixels, flat, strict=True):
            if use_compiled():
                loops().remove_pixels(self._range_m, self._level, some, gone)
            else:
                rows, columns = np.divmod(some[gone], self._range_m.shape[1])
                self._range_m[rows, columns] = 0
                self._level[rows + GAP_PIXELS, columns + GAP_PIXELS] = np.inf
        self._find()

    def extents_m(self, number: int) -> tuple[float, float, float]:
        """Width, height and depth of a surface, metres."""
        pixels, flat, columns = self.pixels_of(number), self._range_m.ravel(), self._range_m.shape[1]
        focal_px, centre = self._camera.focal_px, self._camera.centre_px
        if use_compiled():
            width, height, depth = loops().extents(flat, columns, np.array(centre), pixels)
        else:
            z = flat[pixels].astype(np.float64)
            row, column = np.divmod(pixels, columns)
            axes = ((column + 0.5 - centre[0]) * z, (row + 0.5 - centre[1]) * z, z)
            width, height, depth = (float(np.ptp(axis)) for axis in axes)
        return width / focal_px, height / focal_px, depth

    def bounding_boxes(self) -> BoundingBoxes:
        """The bounding box of every surface."""
        lowest, highest = np.full((3, len(self.area_m2)), np.inf), np.full((3, len(self.area_m2)), -np.inf)
        flat, columns = self._range_m.ravel(), self._range_m.shape[1]
        if use_compiled():
            loops().bound_surfaces(flat, columns, self._segments, lowest, highest)
        elif len(self.area_m2):
            starts = np.cumsum(self._counts) - self._counts
            for number, axis in enumerate((*np.divmod(self._pixels, columns), flat[self._pixels])):
                lowest[number] = np.minimum.reduceat(axis, starts)
                highest[number] = np.maximum.reduceat(axis, starts)
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
