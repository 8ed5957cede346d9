"""Plain forms of the loops that label frames, in NumPy: of planes, and of the resampling of a body; and surfaces as an
image.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.rigs import Camera
from bodyseg_model.segmentation.surfaces import TOLERANCE_PER_M, Surfaces
from bodyseg_model.segmentation.views import Turn

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]


def connected_surfaces(range_m: Floats, focal_px: float) -> NDArray[np.int32]:
    """The number of every pixel's surface by `Surfaces`, int32 [H, W], -1 where range is 0."""
    rows, columns = range_m.shape
    camera = Camera(rows, columns, focal_px, (columns / 2, rows / 2), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    table = Surfaces(np.ascontiguousarray(range_m), camera)
    numbers = np.full(range_m.shape, -1, np.int32)
    for number in range(len(table.area_m2)):
        numbers.ravel()[table.pixels_of(number)] = number
    return numbers


def plain_near_plane(range_m: Floats, pixels: Indices, camera: Camera, plane: Doubles) -> tuple[Mask, float]:
    """As `room_planes._near_plane`."""
    rows, columns = np.divmod(pixels, range_m.shape[1])
    z, (across, down) = range_m.ravel()[pixels].astype(np.float64), camera.centre_px
    a, b, c = plane[0] / camera.focal_px, plane[1] / camera.focal_px, plane[2]
    inverse = (columns + 0.5 - across) * a + ((rows + 0.5 - down) * b + c)
    near = np.abs(inverse * z - 1) <= TOLERANCE_PER_M * z
    return near, float(np.cumsum(z[near] * z[near] * z[near])[-1])


def plain_best_candidate(judges: Doubles, corners: Doubles) -> Doubles:
    """As `room_planes._best_candidate`, where a candidate explains a judge."""
    surface = np.zeros(len(corners))
    a, b, c = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).T
    offsets = a * corners[:, 0, 0] + b * corners[:, 0, 1] + c * corners[:, 0, 2]
    for x, y, inverse in judges:
        away = x * a + y * b + inverse * c - offsets
        surface += np.where(np.abs(away) < TOLERANCE_PER_M * np.abs(c), np.square(1 / inverse), 0.0)
    best = int(np.argmax(surface))
    return np.array([-a[best], -b[best], offsets[best]]) / c[best]


class PlainViewLoops:
    """The functions of `view_loops`, with the same bits."""

    @staticmethod
    def list_pixels(
        flat: Floats,
        pixels: Indices,
        width: int,
        centre: float,
        rows: Indices,
        columns: Indices,
        depths: Doubles,
    ) -> tuple[float, float, int, int]:
        np.divmod(pixels, width, out=(rows, columns))
        depths[:] = flat[pixels]
        sides = (columns + 0.5 - centre) * depths
        return float(sides.min()), float(sides.max()), int(columns.min()), int(columns.max())

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

    @staticmethod
    def move_ranges(box: Doubles, shift: float, nearest: float, farthest: float, view: Floats) -> None:
        np.copyto(view, np.clip(box + shift, nearest, farthest), where=box > 0, casting="same_kind")
