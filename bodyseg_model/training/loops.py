"""The loop that moves the images of a batch, compiled: the bits of `augmentation` in PyTorch's operations."""

from typing import Any

import numpy as np

from bodyseg_data.labels import BACKGROUND
from bodyseg_data.machine import compiled

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
