"""The shape of a surface of a body's size, as a camera sees it: ranges over cells of 5 cm, and 16 measures of them.

Furniture is flat where bodies are curved: the second differences of neighbouring cells are near 0 on planes; noise,
which is estimated from the pixels, is allowed for.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.kernels import use_compiled
from bodyseg_data.core.rig import Camera

Floats = NDArray[np.float64]

MEASURES: Final = (
    "flat share",
    "flat share down",
    "flat share across",
    "curvature down",
    "curvature across",
    "median curvature",
    "upper quartile of curvature",
    "log curved share",
    "log hollow share",
    "filled cells",
    "width",
    "height",
    "depth",
    "log area",
    "area of bounding box",
    "log area of height squared",
)
"""What is measured of a shape, in its order."""

CELL_M: Final = 0.05
"""Side of the cells over which ranges are averaged, metres."""

_PIXELS_A_CELL: Final = 5  # a side: of larger cells, only every second, third ... pixel is read
_FEW: Final = 4096  # of the pixels for a median, evenly spaced, no fewer are read

_LEAST_FILLED: Final = 0.5
_JUMP_M: Final = 0.15  # between cells on two surfaces
_FLAT_M: Final = 0.003
_SIGMAS: Final = 2.0
_MOST_CURVED_M: Final = (0.05, 0.08)
_LEAST_SHARE: Final = 0.02  # added before logarithms
_MAD: Final = 0.6745 * np.sqrt(6.0)  # median of the second differences of normal noise, in standard deviations


@dataclass(frozen=True)
class SurfaceShape:
    """Shape of a surface as the camera sees it. measures: `MEASURES`, float64 [16].

    cells: mean ranges of cells of about `CELL_M` in the surface's bounding box, float64 [h, w], metres, NaN where less
    than half of one is measured.
    """

    measures: Floats = field(repr=False)
    cells: Floats = field(repr=False)


def surface_shape(pixels: NDArray[np.intp], range_m: NDArray[np.float32], camera: Camera) -> SurfaceShape:
    """Describe the shape of a surface.

    pixels: int [N], row * columns + column, ascending, at least one, all measured. range_m: float32 [H, W], metres.
    camera: the frame's.
    """
    form = _loops() if use_compiled() else _NumpyForm
    flat = range_m.ravel()
    cell_px = max(2, round(CELL_M / _pixel_m(pixels, flat, camera)))
    step = max(1, cell_px // _PIXELS_A_CELL)
    side = -(-cell_px // step)
    most = len(pixels)
    rows, columns, z = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
    count = form.list_every(pixels, flat, camera.columns, step, rows, columns, z)
    if not count:  # a surface narrower than the step
        return SurfaceShape(np.zeros(len(MEASURES)), np.full((1, 1), np.nan))
    rows, columns, z = rows[:count], columns[:count], z[:count]
    left, right = form.extent(columns, z, step, camera.centre_px[0], camera.focal_px)
    top, bottom = form.extent(rows, z, step, camera.centre_px[1], camera.focal_px)
    bends = np.empty(count)  # show the noise of one pixel: neighbours lie on a plane, nearly
    noise_m = _value_at(bends[: form.list_bends(rows, columns, z, bends)], 0.5) / _MAD
    cells = _Cells(form, rows, columns, z, side)
    down, across = _second_differences(cells.means)
    every = np.concatenate([down, across])
    bent = np.abs(every)
    limit = _FLAT_M + _SIGMAS * np.sqrt(6.0) * noise_m / side
    width, height = max(right - left, CELL_M), max(bottom - top, CELL_M)
    area = float(((step * z / camera.focal_px) ** 2).sum())
    measures = np.array(
        [
            *(_share_of(np.abs(each) < limit, 1.0) for each in (every, down, across)),
            *(100 * min(_value_at(each, 0.5), _MOST_CURVED_M[0]) for each in (down, across)),
            100 * min(_value_at(bent, 0.5), _MOST_CURVED_M[0]),
            100 * min(_value_at(bent, 0.75), _MOST_CURVED_M[1]),
            *(np.log(_share_of(each, 0.0) + _LEAST_SHARE) for each in (every > limit, every < -limit)),
            cells.filled_share,
            width,
            height,
            _value_at(z, 0.97) - _value_at(z, 0.03),
            np.log(area),
            area / (width * height),
            np.log(area / height**2),
        ]
    )
    return SurfaceShape(measures, cells.means)


@cache
def _loops() -> Any:
    """The compiled loops, in a module that needs numba."""
    return import_module("bodyseg_model.segmentation.people.shape_loops")


class _NumpyForm:
    """The functions of `shape_loops`, with the same bits."""

    @staticmethod
    def list_every(pixels: Any, flat: Any, width: int, step: int, rows: Any, columns: Any, depths: Any) -> int:
        row, column = np.divmod(pixels, width)
        every = (row % step == 0) & (column % step == 0)
        count = int(np.count_nonzero(every))
        rows[:count], columns[:count] = row[every] // step, column[every] // step
        depths[:count] = flat[pixels[every]]
        return count

    @staticmethod
    def add_to_cells(rows: Any, columns: Any, depths: Any, side: int, counts: Any, sums: Any) -> None:
        index = rows // side * counts.shape[1] + columns // side
        counts += np.bincount(index, minlength=counts.size).reshape(counts.shape)
        sums += np.bincount(index, depths, minlength=counts.size).reshape(counts.shape)

    @staticmethod
    def list_bends(rows: Any, columns: Any, depths: Any, bends: Any) -> int:
        beside = (np.diff(columns) == 1) & (np.diff(rows) == 0)
        found = np.abs(depths[:-2] - 2 * depths[1:-1] + depths[2:])[beside[:-1] & beside[1:]]
        bends[: len(found)] = found
        return len(found)

    @staticmethod
    def extent(places: Any, depths: Any, step: int, centre: float, focal_px: float) -> tuple[float, float]:
        at = (places * step + 0.5 - centre) * depths / focal_px
        return float(at.min()), float(at.max())


def _pixel_m(pixels: NDArray[np.intp], flat: NDArray[np.float32], camera: Camera) -> float:
    """Side of a pixel at the surface's median range, metres. flat: the frame, [H * W]."""
    some = flat[pixels[:: max(1, len(pixels) // _FEW)]]
    return _value_at(some, 0.5) / camera.focal_px


class _Cells:
    """Squares of `side` x `side` pixels of a surface. means: their mean ranges [h, w], NaN where less than half of one
    is measured. filled_share: of those measured at all, the share that is measured for a half or more.

    form: the loops, or their NumPy form.
    """

    def __init__(self, form: Any, rows: NDArray[np.int64], columns: NDArray[np.int64], z: Floats, side: int) -> None:
        rows, columns = rows - rows[0], columns - columns.min()
        shape = int(rows[-1]) // side + 1, int(columns.max()) // side + 1
        counts, sums = np.zeros(shape, np.int64), np.zeros(shape)
        form.add_to_cells(rows, columns, z, side, counts, sums)
        filled = counts >= _LEAST_FILLED * side**2
        self.means = np.where(filled, sums / np.maximum(counts, 1), np.nan)
        self.filled_share = float(filled.sum() / np.count_nonzero(counts))


def _second_differences(means: Floats) -> tuple[Floats, Floats]:
    """Second differences of cells down and across, metres, positive where the surface bulges towards the camera."""
    found = []
    for image in (means, means.T):
        steps = np.diff(image, axis=0)
        smooth = np.abs(steps) < _JUMP_M  # False beside an empty cell
        found.append(np.diff(steps, axis=0)[smooth[:-1] & smooth[1:]])
    return found[0], found[1]


def _share_of(of: NDArray[np.bool_], without: float) -> float:
    return float(np.count_nonzero(of) / len(of)) if len(of) else without


def _value_at(values: NDArray[np.floating[Any]], share: float) -> float:
    """The value below which a share of all lies; 0 without any."""
    place = min(int(share * len(values)), len(values) - 1)
    return float(np.partition(values, place)[place]) if len(values) else 0.0
