"""Labels and confidences of pixels, compiled: the bits of `labelling.label_points`, over measured pixels alone.

Pixels between the same four scores, `stride` x `stride` of them, are labelled together: the same classes count for all
of them, and each class is interpolated, compared and summed for all of them in loops that fit a processor's vectors.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bodyseg_data.core.kernels import compiled
from bodyseg_model.networks.labelling import LEAST_POWER, LOG2_E, POWER, REACH

_P0, _P1, _P2, _P3, _P4, _P5 = POWER
_HALF, _ONE, _LEAST = np.float32(0.5), np.float32(1), np.float32(-np.inf)


def _label_rows(
    scores: Any,
    range_m: Any,
    stride: Any,
    down: Any,
    across: Any,
    first: Any,
    last: Any,
    labels: Any,
    confidence: Any,
) -> None:
    """As `labelling.label_pixels`, of one image, from one row of squares between scores to before another; square 0 is
    before all.

    down, across: weights of `labelling.interpolation`, float32 [rows] and [columns].
    """
    height, width, classes = scores.shape
    low, high = np.empty(classes, np.float32), np.empty(classes, np.float32)
    area = stride * stride
    value = np.empty((classes, area), np.float32)
    best, total = np.empty(area, np.float32), np.empty(area, np.float32)
    label, number = np.empty(area, np.int32), np.empty(classes, np.int32)
    shown = np.empty(across.size, np.uint8)
    right_weight, lower_weight = np.empty(area, np.float32), np.empty(area, np.float32)
    for square_row in range(first, last):
        top, bottom = max(square_row - 1, 0), min(square_row, height - 1)
        row_start = max((stride * (2 * square_row - 1)) // 2, 0)
        row_end = min((stride * (2 * square_row + 1)) // 2, down.size)
        shown[:] = 0  # where any of these rows was measured: most squares are empty
        for row in range(row_start, row_end):
            metres = range_m[row]
            for column in range(metres.size):
                shown[column] |= metres[column] > 0
        for square_column in range(width + 1):
            column_start = max((stride * (2 * square_column - 1)) // 2, 0)
            column_end = min((stride * (2 * square_column + 1)) // 2, across.size)
            seen = False
            for column in range(column_start, column_end):
                seen |= shown[column] != 0
            if not seen:
                continue
            count = 0
            for row in range(row_start, row_end):
                for column in range(column_start, column_end):
                    lower_weight[count] = down[row]
                    right_weight[count] = across[column]
                    count += 1
            left, right = max(square_column - 1, 0), min(square_column, width - 1)
            a, b = scores[top, left], scores[top, right]
            c, d = scores[bottom, left], scores[bottom, right]
            for k in range(classes):
                low[k] = min(min(a[k], b[k]), min(c[k], d[k]))
                high[k] = max(max(a[k], b[k]), max(c[k], d[k]))
            least = low[0]
            for k in range(1, classes):
                least = max(least, low[k])
            least -= REACH
            counted = 0
            for k in range(classes):
                if high[k] >= least:
                    number[counted] = k
                    counted += 1
            for p in range(count):
                best[p] = _LEAST
                total[p] = np.float32(0)
            for n in range(counted):
                k = number[n]
                at_a, at_c = a[k], c[k]
                rise_above, rise_below = b[k] - at_a, d[k] - at_c
                row_of = value[n]
                for p in range(count):
                    above = at_a + rise_above * right_weight[p]
                    below = at_c + rise_below * right_weight[p]
                    score = above + (below - above) * lower_weight[p]
                    row_of[p] = score
                    greater = score > best[p]
                    best[p] = score if greater else best[p]
                    label[p] = k if greater else label[p]
            for n in range(counted):
                row_of = value[n]
                for p in range(count):
                    power = max((row_of[p] - best[p]) * LOG2_E, LEAST_POWER)
                    whole = np.int32(power - _HALF)
                    rest = power - np.float32(whole)
                    series = ((((_P0 * rest + _P1) * rest + _P2) * rest + _P3) * rest + _P4) * rest + _P5
                    total[p] += series * np.int32((whole + np.int32(127)) << np.int32(23)).view(np.float32)
            p = 0
            for row in range(row_start, row_end):
                for column in range(column_start, column_end):
                    if range_m[row, column] > 0:
                        labels[row, column] = label[p]
                        confidence[row, column] = _ONE / total[p]
                    p += 1


label_rows: Any = compiled(_label_rows, "labelling in a compiled loop")
