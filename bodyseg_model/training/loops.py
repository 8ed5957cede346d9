"""Loops of a training, compiled: images moved, and scores interpolated; the bits of the same in PyTorch's operations,
which GPUs need (`augmentation`, `loss`).
"""

from typing import Any

import numpy as np

from bodyseg_data.labels import BACKGROUND
from bodyseg_data.machine import compiled
from bodyseg_model.networks import BITS, nearest

_NOTHING = np.float32(0)


@compiled
def move_images(range_m: Any, labels: Any, down: Any, across: Any, moved: Any, named: Any) -> None:
    """Take every pixel from the one nearest to row down[0][column] + down[1][row], and column likewise.

    down, across: pairs of float32 [B, W] and [B, H]. range_m: float32 [B, H, W]; labels: uint8 [B, H, W]; moved, named:
    of the same shapes, written.
    """
    images, rows, columns = range_m.shape
    row_by_column, row_by_row = down
    column_by_column, column_by_row = across
    row_of, column_of = np.empty(columns, np.float32), np.empty(columns, np.float32)
    for image in range(images):
        metres, parts = range_m[image], labels[image]
        for row in range(rows):
            for column in range(columns):
                row_of[column] = np.rint(row_by_column[image, column] + row_by_row[image, row])
                column_of[column] = np.rint(column_by_column[image, column] + column_by_row[image, row])
            for column in range(columns):
                y, x = row_of[column], column_of[column]
                if 0 <= y < rows and 0 <= x < columns:
                    moved[image, row, column] = metres[int(y), int(x)]
                    named[image, row, column] = parts[int(y), int(x)]
                else:
                    moved[image, row, column] = _NOTHING
                    named[image, row, column] = BACKGROUND


@compiled
def interpolate(table: Any, places: Any, shares: Any, found: Any) -> None:
    """Write the interpolated scores, float32 [N, C].

    table: scores in a row, the 32 bits of each float32 or the 16 of each bfloat16. places: int64 [4, N], where in it
    the scores of the classes at the four points around each pixel begin; shares: float32 [4, N], weight of each.
    """
    count, classes = found.shape
    corner = np.empty(classes, np.float32)
    bits = corner.view(np.uint32)
    for pixel in range(count):
        for point in range(4):
            start, share = places[point, pixel], shares[point, pixel]
            if table.itemsize == 2:
                for k in range(classes):
                    bits[k] = np.uint32(table[start + k]) << BITS
            else:
                for k in range(classes):
                    bits[k] = table[start + k]
            if point == 0:
                for k in range(classes):
                    found[pixel, k] = corner[k] * share
            else:
                for k in range(classes):
                    found[pixel, k] += corner[k] * share


@compiled
def add_gradient(gradient: Any, places: Any, shares: Any, ends: Any, table: Any) -> None:
    """Write the gradient by the scores, from the one by the interpolated scores, float32 [N, C].

    Pixels are in the order of their images. table, places, shares: as of `interpolate`; the table has B equal parts,
    one for each image. ends: int64 [B], the number of pixels of each image and those before it. A pixel's gradient by a
    point has the type of the scores; sums are in float32, point by point and pixel by pixel.
    """
    classes, rounded = gradient.shape[1], table.itemsize == 2
    size = table.size // ends.size
    total, corner = np.empty(size, np.float32), np.empty(classes, np.float32)
    bits, sums = corner.view(np.uint32), total.view(np.uint32)
    first = 0
    for image in range(ends.size):
        total[:] = np.float32(0)
        for point in range(4):
            for pixel in range(first, ends[image]):
                start, share = places[point, pixel] - image * size, shares[point, pixel]
                for k in range(classes):
                    corner[k] = gradient[pixel, k] * share
                if rounded:
                    for k in range(classes):
                        bits[k] = nearest(bits[k]) << BITS
                for k in range(classes):
                    total[start + k] += corner[k]
        part = table[image * size : (image + 1) * size]
        if rounded:
            for k in range(size):
                part[k] = nearest(sums[k])
        else:
            for k in range(size):
                part[k] = sums[k]
        first = ends[image]
