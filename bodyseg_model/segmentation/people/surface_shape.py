"""The shape of a surface of a body's size, as a camera sees it: ranges over cells of 5 cm, and 16 measures of them.

Furniture is flat where bodies are curved: the second differences of neighbouring cells are near 0 on planes; noise,
which is estimated from the pixels, is allowed for.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

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
FEW: Final = 4096
"""Of the pixels for a median or a share, evenly spaced, no fewer are read."""

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
    cell_px = max(2, round(CELL_M / pixel_m(pixels, range_m, camera)))
    step = max(1, cell_px // _PIXELS_A_CELL)
    side = -(-cell_px // step)
    shown = np.zeros(range_m.shape, np.bool_)
    shown.ravel()[pixels] = True
    coarse = np.ascontiguousarray(shown[::step, ::step])
    rows, columns = np.divmod(np.flatnonzero(coarse), coarse.shape[1])
    if not len(rows):  # a surface narrower than the step
        return SurfaceShape(np.zeros(len(MEASURES)), np.full((1, 1), np.nan))
    z = range_m.ravel()[rows * (step * camera.columns) + columns * step].astype(np.float64)
    cells = _Cells(rows, columns, z, side)
    down, across = _second_differences(cells.means)
    every = np.concatenate([down, across])
    bent = np.abs(every)
    limit = _FLAT_M + _SIGMAS * np.sqrt(6.0) * _noise(rows, columns, z) / side
    x = (columns * step + 0.5 - camera.centre_px[0]) * z / camera.focal_px
    y = (rows * step + 0.5 - camera.centre_px[1]) * z / camera.focal_px
    width, height = max(float(np.ptp(x)), CELL_M), max(float(np.ptp(y)), CELL_M)
    area = float(((step * z / camera.focal_px) ** 2).sum())
    measures = np.array(
        [
            *(share_of(np.abs(each) < limit, 1.0) for each in (every, down, across)),
            *(100 * min(value_at(each, 0.5), _MOST_CURVED_M[0]) for each in (down, across)),
            100 * min(value_at(bent, 0.5), _MOST_CURVED_M[0]),
            100 * min(value_at(bent, 0.75), _MOST_CURVED_M[1]),
            *(np.log(share_of(each, 0.0) + _LEAST_SHARE) for each in (every > limit, every < -limit)),
            cells.filled_share,
            width,
            height,
            value_at(z, 0.97) - value_at(z, 0.03),
            np.log(area),
            area / (width * height),
            np.log(area / height**2),
        ]
    )
    return SurfaceShape(measures, cells.means)


def pixel_m(pixels: NDArray[np.intp], range_m: NDArray[np.float32], camera: Camera) -> float:
    """Side of a pixel at the surface's median range, metres."""
    some = range_m.ravel()[pixels[:: max(1, len(pixels) // FEW)]]
    return value_at(some, 0.5) / camera.focal_px


class _Cells:
    """Squares of `side` x `side` pixels of a surface. means: their mean ranges [h, w], NaN where less than half of one
    is measured. filled_share: of those measured at all, the share that is measured for a half or more.
    """

    def __init__(self, rows: NDArray[np.intp], columns: NDArray[np.intp], z: Floats, side: int) -> None:
        down, across = (rows - rows.min()) // side, (columns - columns.min()) // side
        shape = int(down.max()) + 1, int(across.max()) + 1
        index = down * shape[1] + across
        count = np.bincount(index, minlength=shape[0] * shape[1])
        filled = count >= _LEAST_FILLED * side**2
        means = np.bincount(index, z, minlength=len(count)) / np.maximum(count, 1)
        self.means = np.where(filled, means, np.nan).reshape(shape)
        self.filled_share = float(filled.sum() / np.count_nonzero(count))


def _second_differences(means: Floats) -> tuple[Floats, Floats]:
    """Second differences of cells down and across, metres, positive where the surface bulges towards the camera."""
    found = []
    for image in (means, means.T):
        steps = np.diff(image, axis=0)
        smooth = np.abs(steps) < _JUMP_M  # False beside an empty cell
        found.append(np.diff(steps, axis=0)[smooth[:-1] & smooth[1:]])
    return found[0], found[1]


def _noise(rows: NDArray[np.intp], columns: NDArray[np.intp], z: Floats) -> float:
    """Standard deviation of the noise of one pixel, metres, from second differences of neighbours in a row."""
    beside = (np.diff(columns) == 1) & (np.diff(rows) == 0)
    inner = beside[:-1] & beside[1:]
    return float(value_at(np.abs(z[:-2] - 2 * z[1:-1] + z[2:])[inner], 0.5) / _MAD)


def share_of(of: NDArray[np.bool_], without: float) -> float:
    return float(np.count_nonzero(of) / len(of)) if len(of) else without


def value_at(values: NDArray[np.floating[Any]], share: float) -> float:
    """The value below which a share of all lies; 0 without any."""
    place = min(int(share * len(values)), len(values) - 1)
    return float(np.partition(values, place)[place]) if len(values) else 0.0
