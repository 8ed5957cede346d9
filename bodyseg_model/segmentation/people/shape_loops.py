"""Pixels of a surface and their cells, compiled; `surface_shape.py` has the NumPy forms of the same bits."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from bodyseg_data.core.kernels import compiled

_kernel = partial(compiled, feature="the compiled form of the shapes of surfaces")


@_kernel
def list_every(pixels: Any, flat: Any, width: Any, step: Any, rows: Any, columns: Any, depths: Any) -> Any:
    """Write row and column, divided by `step`, and range of the pixels of every `step`-th row and column; returns their
    number. width: columns of the frame. rows, columns, depths: int64 twice and float64 [N], of which the first are set.
    """
    count, row, row_end, listed = 0, 0, width, True
    for i in range(pixels.size):
        pixel = pixels[i]
        while pixel >= row_end:
            row += 1
            row_end += width
            listed = row % step == 0
        if listed:
            column = pixel - row_end + width
            if column % step == 0:
                rows[count], columns[count] = row // step, column // step
                depths[count] = np.float64(flat[pixel])
                count += 1
    return count


@_kernel
def add_to_cells(rows: Any, columns: Any, depths: Any, side: Any, counts: Any, sums: Any) -> None:
    """Add each pixel to its cell of `side` x `side`: counts int64 and sums float64 [h, w]. Rows and columns begin at
    0.
    """
    for i in range(rows.size):
        row, column = rows[i] // side, columns[i] // side
        counts[row, column] += 1
        sums[row, column] += depths[i]


@_kernel
def list_bends(rows: Any, columns: Any, depths: Any, bends: Any) -> Any:
    """Write the second difference, without its sign, of every three neighbours in a row, into float64 [N]; returns
    their number.
    """
    count = 0
    for i in range(1, rows.size - 1):
        if rows[i - 1] == rows[i + 1] and columns[i] - columns[i - 1] == 1 and columns[i + 1] - columns[i] == 1:
            bends[count] = abs(depths[i - 1] - 2 * depths[i] + depths[i + 1])
            count += 1
    return count


@_kernel
def extent(places: Any, depths: Any, step: Any, centre: Any, focal_px: Any) -> Any:
    """Least and greatest place of pixels to one side of the optical axis, metres. places: their rows or columns."""
    least, greatest = np.inf, -np.inf
    for i in range(places.size):
        at = (np.float64(places[i] * step) + 0.5 - centre) * depths[i] / focal_px
        least, greatest = min(least, at), max(greatest, at)
    return least, greatest
