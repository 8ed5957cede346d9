"""Labels and confidences of pixels from scores that are coarser than the image: interpolation, best class, softmax.

Compiled loops over measured pixels; without numba, and on GPUs, PyTorch does the same. All is in single operations of
float32, which the tests' plain form repeats bit by bit. Of the classes, only those count whose highest score at the
four points around a pixel comes within `REACH` of the score that some class has at all four: the best class is always
among them, and all others together change a confidence by less than 2e-4 (4e-5 with the one that ships).
"""

import itertools
from functools import lru_cache, partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.machine import compiled, of_each, pieces
from bodyseg_model.networks.body_map import point_grids

REACH: Final = np.float32(12.0)
"""A class whose score is less than another's by as much has at most exp(-12), 6e-6, of its probability."""

LOG2_E: Final = np.float32(1.44269504)
LEAST_POWER: Final = np.float32(-120.0)
"""Powers of two below are taken as this one: still a normal number of float32."""

POWER: Final = tuple(np.float32(c) for c in (1.3333558e-3, 9.6181291e-3, 5.5504109e-2, 0.24022651, 0.69314718, 1.0))
"""Coefficients of 2^x for x from -1/2 to 1/2, highest power first: Taylor's series, within 4e-6 of the value."""

_P0, _P1, _P2, _P3, _P4, _P5 = POWER
_HALF, _ONE, _LEAST = np.float32(0.5), np.float32(1), np.float32(-np.inf)
_NOTHING = np.float32(0)
_PIECES: Final = 6  # pieces of an image that several threads take: its rows do not have equal shares of a body
_LEAST_PIXELS: Final = 1 << 13  # measured pixels that pay for a thread: to start one takes as long as some thousand

Floats = NDArray[np.float32]
Axis = tuple[NDArray[np.int64], Floats]
"""Of every pixel along an axis, the index of the score before it, from -1, and the weight of the score after it."""


def label_pixels(
    scores: Floats, range_m: Floats, stride: int, labels: NDArray[np.uint8], confidence: Floats, threads: int = 1
) -> None:
    """Write labels and confidences of images' measured pixels, uint8 and float32 [B, H, W]; others stay as they are.

    scores: [B, ceil(H / stride), ceil(W / stride), C], finite, C contiguous; score (i, j) belongs to the point
    ((i + 1/2) stride, (j + 1/2) stride) of its image. range_m: [B, H, W], metres, 0 = nothing measured. threads: among
    which images and their rows are divided; the bits do not depend on it.
    """
    rows, columns = range_m.shape[1:]
    down, across = interpolation(rows, stride), interpolation(columns, stride)
    useful = min(threads, max(1, int(np.count_nonzero(range_m > 0)) // _LEAST_PIXELS))
    runs = pieces(scores.shape[1] + 1, _PIECES if useful > 1 else 1)

    def work(part: tuple[int, tuple[int, int]]) -> None:
        image, run = part
        of_image = scores[image], range_m[image], stride, down[1], across[1]
        label_rows(*of_image, *run, labels[image], confidence[image])

    of_each(work, list(itertools.product(range(len(scores)), runs)), useful)


def number_pixels(
    places: Floats, range_m: Floats, stride: int, labels: NDArray[np.uint8] | None, numbers: NDArray[np.uint16]
) -> None:
    """Write the template's points at measured pixels, uint16 [B, H, W]; others, and NaN places, stay as they are.

    places: as scores of `label_pixels`, [B, h, w, 3]. range_m, stride: as there. labels: parts, uint8 [B, H, W], whose
    points alone are taken; None for any. Raises MissingLibrary without scipy.
    """
    down, across = (interpolation(size, stride) for size in range_m.shape[1:])
    grids = point_grids(labels is not None)
    parts = np.zeros(range_m.shape, np.uint8) if labels is None else labels
    for image in range(len(places)):
        number_image(places[image], range_m[image], down, across, parts[image], grids, numbers[image])


@partial(compiled, feature="labelling in compiled loops")
def number_image(places: Any, range_m: Any, down: Any, across: Any, parts: Any, grids: Any, numbers: Any) -> None:
    """As `number_pixels`, of one image. down, across: each an `Axis`; grids: `PointGrids`."""
    (rows, row_weight), (columns, column_weight) = down, across
    height, width, _ = places.shape
    for row in range(rows.size):
        top, bottom = places[max(rows[row], 0)], places[min(rows[row] + 1, height - 1)]
        for column in range(columns.size):
            if range_m[row, column] > 0:
                left, right = max(columns[column], 0), min(columns[column] + 1, width - 1)
                a, b, c, d = top[left], top[right], bottom[left], bottom[right]
                part, cube, known = parts[row, column], 0, True
                for axis in range(3):
                    above = a[axis] + (b[axis] - a[axis]) * column_weight[column]
                    below = c[axis] + (d[axis] - c[axis]) * column_weight[column]
                    at = (above + (below - above) * row_weight[row] - grids.corner[part, axis]) / grids.side
                    size = grids.shape[part, axis]
                    known &= not np.isnan(at)  # NaN as a whole number may be any
                    cube = cube * size + int(min(max(at, _NOTHING), np.float32(size - 1)))
                if known:
                    numbers[row, column] = grids.numbers[grids.first[part] + cube]


@lru_cache(maxsize=64)
def interpolation(size: int, stride: int) -> Axis:
    """Neighbours and weights of `size` pixels between scores `stride` apart, both [size]."""
    twice = 2 * np.arange(size) + 1 - stride  # from the first score's point to the pixel's centre, half pixels
    before = twice // (2 * stride)
    after = (twice - 2 * stride * before) / (2 * stride)
    return before, after.astype(np.float32)


@partial(compiled, feature="labelling in compiled loops")
def label_rows(
    scores: Any, range_m: Any, stride: Any, down: Any, across: Any, first: Any, last: Any, labels: Any, confidence: Any
) -> None:
    """As `label_pixels`, of one image, from one row of squares between scores to before another; 0 is before all.

    Pixels between the same four scores, `stride` x `stride` of them, are labelled together: the same classes count for
    all of them, and each class is interpolated, compared and summed for all of them in loops that fit a processor's
    vectors. down, across: weights of `interpolation`, float32 [rows] and [columns].
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
        shown[:] = 0  # columns with a measured pixel in these rows: most squares are empty
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
