"""Images moved and mirrored, compiled: the bits of `mirror.mirror` and `geometric._moved` in PyTorch's operations.

range_m: float32 [B, H, W]; labels: uint8 [B, H, W]; moved, named: of the same shapes, written.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from bodyseg_data.core.kernels import compiled
from bodyseg_data.core.parts import BACKGROUND

_NOTHING = np.float32(0)
_kernel = partial(compiled, feature="augmentation in compiled loops")


@_kernel
def mirror_images(range_m: Any, labels: Any, chosen: Any, table: Any, moved: Any, named: Any) -> None:
    """Mirror the images that are `chosen`, bool [B], and copy the others. table: uint8 [256], label of each label."""
    images, rows, columns = range_m.shape
    for image in range(images):
        for row in range(rows):
            metres, parts = range_m[image, row], labels[image, row]
            to, name = moved[image, row], named[image, row]
            if chosen[image]:
                for column in range(columns):
                    to[column] = metres[columns - 1 - column]
                    name[column] = table[parts[columns - 1 - column]]
            else:
                for column in range(columns):
                    to[column] = metres[column]
                    name[column] = parts[column]


@_kernel
def move_images(range_m: Any, labels: Any, down: Any, across: Any, moved: Any, named: Any) -> None:
    """Take every pixel from the one nearest to row down[0][column] + down[1][row], and column likewise.

    down, across: pairs of float32 [B, W] and [B, H].
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
