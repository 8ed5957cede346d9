"""Cells and measures of a surface, compiled; `surface_shape.py` has the NumPy form of the same bits."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from bodyseg_data.core.kernels import compiled
from bodyseg_model.segmentation.order_loops import value_at
from bodyseg_model.segmentation.people.surface_shape import JUMP_M

_kernel = partial(compiled, feature="the compiled form of the shapes of surfaces")


@_kernel
def _list_every(pixels: Any, flat: Any, width: Any, step: Any, rows: Any, columns: Any, depths: Any) -> Any:
    """Write row and column, divided by `step`, and range of the pixels of every `step`-th row and column; returns their
    number. rows, columns, depths: int64 twice and float64 [N], of which the first are set.
    """
    place = np.full(width, -1, np.int64)  # of a column among those that are read
    for column in range(0, width, step):
        place[column] = column // step
    count, row, row_end, listed = 0, 0, width, True
    for i in range(pixels.size):
        pixel = pixels[i]
        while pixel >= row_end:
            row += 1
            row_end += width
            listed = row % step == 0
        if listed:
            column = place[pixel - row_end + width]
            rows[count], columns[count], depths[count] = row // step, column, np.float64(flat[pixel])
            count += column >= 0  # else overwritten
    return count


@_kernel
def _noise(rows: Any, columns: Any, depths: Any) -> Any:
    """Median of the second differences, without their signs, of every three neighbours in a row."""
    bends, count = np.empty(rows.size), 0
    for i in range(1, rows.size - 1):
        if rows[i - 1] == rows[i + 1] and columns[i] - columns[i - 1] == 1 and columns[i + 1] - columns[i] == 1:
            bends[count] = abs(depths[i - 1] - 2 * depths[i] + depths[i + 1])
            count += 1
    return value_at(bends[:count], 0.5)


@_kernel
def _mean_cells(rows: Any, columns: Any, depths: Any, side: Any, least: Any) -> Any:
    """Mean ranges of cells of `side` x `side` pixels, NaN where fewer than `least` are measured, float64 [h, w]; and of
    the cells in which any is, the share that has a mean.
    """
    left, right = columns[0], columns[0]
    for i in range(columns.size):
        left, right = min(left, columns[i]), max(right, columns[i])
    top = rows[0]
    means = np.zeros(((rows[-1] - top) // side + 1, (right - left) // side + 1))
    counts = np.zeros(means.shape, np.int64)
    for i in range(rows.size):
        row, column = (rows[i] - top) // side, (columns[i] - left) // side
        counts[row, column] += 1
        means[row, column] += depths[i]
    filled = measured = 0
    for row in range(means.shape[0]):
        for column in range(means.shape[1]):
            count = counts[row, column]
            measured += count > 0
            filled += count >= least
            means[row, column] = means[row, column] / count if count >= least else np.nan
    return means, filled / measured


@_kernel
def _second_differences(means: Any, found: Any) -> Any:
    """Write the second differences of cells down into `found`, float64 [N]; returns their number."""
    count = 0
    for row in range(means.shape[0] - 2):
        for column in range(means.shape[1]):
            one, other = means[row + 1, column] - means[row, column], means[row + 2, column] - means[row + 1, column]
            if abs(one) < JUMP_M and abs(other) < JUMP_M:  # False beside an empty cell
                found[count] = other - one
                count += 1
    return count


@_kernel
def _share_below(values: Any, limit: Any, without: Any) -> Any:
    """Share of values that are less than a limit."""
    count = 0
    for i in range(values.size):
        count += values[i] < limit
    return count / values.size if values.size else without


@_kernel
def describe(pixels: Any, flat: Any, width: Any, step: Any, side: Any, least: Any, lens: Any, limits: Any) -> Any:
    """As `surface_shape._describe_in_numpy`."""
    centre_x, centre_y, focal_px = lens[0], lens[1], lens[2]
    raw = np.zeros(14)
    most = pixels.size
    rows, columns, z = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most)
    count = _list_every(pixels, flat, width, step, rows, columns, z)
    if count == 0:
        return raw, np.full((1, 1), np.nan)
    rows, columns, z = rows[:count], columns[:count], z[:count]
    left = top = np.inf
    right = bottom = -np.inf
    area = 0.0
    for i in range(count):
        x = (np.float64(columns[i] * step) + 0.5 - centre_x) * z[i] / focal_px
        y = (np.float64(rows[i] * step) + 0.5 - centre_y) * z[i] / focal_px
        left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
        side_m = np.float64(step) * z[i] / focal_px
        area += side_m * side_m
    limit = limits[0] + limits[1] * _noise(rows, columns, z)
    means, filled = _mean_cells(rows, columns, z, side, least)
    every = np.empty(2 * means.size)
    count_down = _second_differences(means, every)
    every = every[: count_down + _second_differences(means.T, every[count_down:])]
    bent = np.abs(every)
    raw[0] = _share_below(bent, limit, 1.0)
    raw[1], raw[2] = _share_below(bent[:count_down], limit, 1.0), _share_below(bent[count_down:], limit, 1.0)
    raw[3], raw[4] = value_at(every[:count_down], 0.5), value_at(every[count_down:], 0.5)
    raw[5], raw[6] = value_at(bent, 0.5), value_at(bent, 0.75)
    raw[7], raw[8] = _share_below(-every, -limit, 0.0), _share_below(every, -limit, 0.0)
    raw[9] = filled
    raw[10], raw[11] = right - left, bottom - top
    raw[12] = value_at(z, 0.97) - value_at(z, 0.03)
    raw[13] = area
    return raw, means
