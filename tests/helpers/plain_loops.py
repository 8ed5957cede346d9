"""Plain forms of the loops that resample a body, in NumPy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyseg_model.segmentation.views import Turn

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Indices = NDArray[np.intp]


class PlainViewLoops:
    """The functions of `pixel_loops`, with the same bits."""

    @staticmethod
    def map_to_view(
        rows: Indices, columns: Indices, mapping: Turn, down: Doubles, across: Doubles
    ) -> tuple[float, float, float, float]:
        centre_x, centre_y, focal_px, view_x, view_y, view_focal_px, sine, cosine, sign = mapping
        x, y = (columns + 0.5 - centre_x) / focal_px, (rows + 0.5 - centre_y) / focal_px
        ahead = x * sine + cosine
        down[:] = view_y + view_focal_px * y / ahead
        across[:] = view_x + sign * view_focal_px * (x * cosine - sine) / ahead
        return float(down.min()), float(down.max()), float(across.min()), float(across.max())

    @staticmethod
    def pick_ranges(own: Doubles, corner: tuple[int, int], mapping: Turn, start: tuple[int, int], box: Doubles) -> None:
        centre_x, centre_y, focal_px, view_x, view_y, view_focal_px, sine, cosine, sign = mapping
        x = (np.arange(start[1], start[1] + box.shape[1]) + 0.5 - view_x) / view_focal_px * sign
        y = (np.arange(start[0], start[0] + box.shape[0])[:, None] + 0.5 - view_y) / view_focal_px
        ahead = np.maximum(cosine - x * sine, 1e-9)
        points = centre_y + focal_px * y / ahead, centre_x + focal_px * (x * cosine + sine) / ahead
        row, column = (
            np.clip(np.floor(point) - first, 0, side - 1).astype(np.intp)
            for point, first, side in zip(points, corner, own.shape, strict=True)
        )
        box[:] = own.ravel()[row * own.shape[1] + column]

    @staticmethod
    def fill_lost(
        down: Doubles,
        across: Doubles,
        start: tuple[int, int],
        ranges: Doubles,
        box: Doubles,
        corner: tuple[int, int],
        width: int,
        pixels: Indices,
    ) -> None:
        row, column = np.floor(down).astype(np.intp), np.floor(across).astype(np.intp)
        pixels[:] = (row - corner[0]) * width + column - corner[1]
        flat, cells = box.ravel(), (row - start[0]) * box.shape[1] + column - start[1]
        lost = np.flatnonzero(flat[cells] == 0)
        right, below = across[lost] - column[lost] - 0.5, down[lost] - row[lost] - 0.5
        nearest_last = lost[np.argsort(-(right * right + below * below), kind="stable")]
        flat[cells[nearest_last]] = ranges[nearest_last]
