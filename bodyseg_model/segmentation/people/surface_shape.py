"""The shape of a surface of a body's size, as a camera sees it: ranges over cells of 5 cm, and 16 measures of them.

Furniture is flat where bodies are curved: the second differences of neighbouring cells are near 0 on planes; noise,
which is estimated from the pixels, is allowed for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.kernels import use_compiled
from bodyseg_data.core.rig import Camera
from bodyseg_model.segmentation.order_statistics import value_at
from bodyseg_model.segmentation.people.room_planes import lens_of

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

JUMP_M: Final = 0.15
"""Greatest difference of range between neighbouring cells of one surface, metres."""

_LEAST_FILLED: Final = 0.5
_FLAT_M: Final = 0.003
_SIGMAS: Final = 2.0
_MOST_CURVED_M: Final = (0.05, 0.05, 0.05, 0.08)
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
    flat = range_m.ravel()
    cell_px = max(2, round(CELL_M / _pixel_m(pixels, flat, camera)))
    step = max(1, cell_px // _PIXELS_A_CELL)
    side = -(-cell_px // step)
    least = math.ceil(_LEAST_FILLED * side**2)
    limits = np.array([_FLAT_M, _SIGMAS * np.sqrt(6.0) / _MAD / side])
    describe = _loops().describe if use_compiled() else _describe_in_numpy
    raw, cells = describe(pixels, flat, camera.columns, step, side, least, lens_of(camera), limits)
    if not raw[13]:  # a surface narrower than the step has no area
        return SurfaceShape(np.zeros(len(MEASURES)), cells)
    width, height, area = max(raw[10], CELL_M), max(raw[11], CELL_M), raw[13]
    logs = np.log([raw[7] + _LEAST_SHARE, raw[8] + _LEAST_SHARE, area, area / height**2])
    measures = np.array(
        [
            *raw[:3],
            *(100 * min(each, most) for each, most in zip(raw[3:7], _MOST_CURVED_M, strict=True)),
            *logs[:2],
            raw[9],
            width,
            height,
            raw[12],
            logs[2],
            area / (width * height),
            logs[3],
        ]
    )
    return SurfaceShape(measures, cells)


@cache
def _loops() -> Any:
    """The compiled loops, in a module that needs numba."""
    return import_module("bodyseg_model.segmentation.people.shape_loops")


def _describe_in_numpy(
    pixels: NDArray[np.intp],
    flat: NDArray[np.float32],
    width: int,
    step: int,
    side: int,
    least: int,
    lens: Floats,
    limits: Floats,
) -> tuple[Floats, Floats]:
    """Measure a surface, float64 [14]: shares that are flat, of both directions, down and across; medians of curvature
    down, across and without its sign, and the upper quartile of that; shares that are curved and hollow; share of the
    cells that are filled; width, height and depth, metres; area, square metres. All are 0 where no pixel is read.

    And its cells, as of `SurfaceShape`. pixels: ascending flat indices in `flat`, the frame of `width` columns. step:
    only every step-th row and column is read. side: of cells, in pixels that are read; least: of these, in a cell that
    is filled. lens: principal point and focal length, pixels. limits: of what is flat, metres, and how much is added
    for each metre of the second differences of neighbouring pixels.
    """
    rows, columns = np.divmod(pixels, width)
    every = (rows % step == 0) & (columns % step == 0)
    raw = np.zeros(14)
    if not every.any():
        return raw, np.full((1, 1), np.nan)
    z = flat[pixels[every]].astype(np.float64)
    rows, columns = rows[every] // step, columns[every] // step
    x, y = (columns * step + 0.5 - lens[0]) * z / lens[2], (rows * step + 0.5 - lens[1]) * z / lens[2]
    beside = (np.diff(columns) == 1) & (np.diff(rows) == 0)
    bends = np.abs(z[:-2] - 2 * z[1:-1] + z[2:])[beside[:-1] & beside[1:]]
    limit = limits[0] + limits[1] * value_at(bends, 0.5)
    cells, filled_share = _mean_cells(rows, columns, z, side, least)
    down, across = _second_differences(cells), _second_differences(cells.T)
    curvature = np.concatenate([down, across])
    bent = np.abs(curvature)
    raw[:3] = [_share_of(np.abs(each) < limit, 1.0) for each in (curvature, down, across)]
    raw[3:7] = value_at(down, 0.5), value_at(across, 0.5), value_at(bent, 0.5), value_at(bent, 0.75)
    raw[7:10] = _share_of(curvature > limit, 0.0), _share_of(curvature < -limit, 0.0), filled_share
    raw[10:13] = np.ptp(x), np.ptp(y), value_at(z, 0.97) - value_at(z, 0.03)
    raw[13] = np.cumsum((step * z / lens[2]) ** 2)[-1]  # from the first to the last, as a loop adds them
    return raw, cells


def _pixel_m(pixels: NDArray[np.intp], flat: NDArray[np.float32], camera: Camera) -> float:
    """Side of a pixel at the surface's median range, metres. flat: the frame, [H * W]."""
    return value_at(flat[pixels[:: max(1, len(pixels) // _FEW)]], 0.5) / camera.focal_px


def _mean_cells(
    rows: NDArray[np.intp], columns: NDArray[np.intp], z: Floats, side: int, least: int
) -> tuple[Floats, float]:
    """Mean ranges of cells of `side` x `side` pixels, NaN where fewer than `least` are measured, [h, w]; and of the
    cells in which any is, the share that has a mean.
    """
    rows, columns = (rows - rows[0]) // side, (columns - columns.min()) // side
    shape = int(rows[-1]) + 1, int(columns.max()) + 1
    index = rows * shape[1] + columns
    counts = np.bincount(index, minlength=shape[0] * shape[1]).reshape(shape)
    sums = np.bincount(index, z, minlength=counts.size).reshape(shape)
    filled = counts >= least
    means: Floats = np.where(filled, sums / np.maximum(counts, 1), np.nan)
    return means, float(filled.sum() / np.count_nonzero(counts))


def _second_differences(means: Floats) -> Floats:
    """Second differences of cells down, metres, positive where the surface bulges towards the camera."""
    steps = np.diff(means, axis=0)
    smooth = np.abs(steps) < JUMP_M  # False beside an empty cell
    found: Floats = np.diff(steps, axis=0)[smooth[:-1] & smooth[1:]]
    return found


def _share_of(of: NDArray[np.bool_], without: float) -> float:
    return float(np.count_nonzero(of) / len(of)) if len(of) else without
