"""Decoding of `bsi` numbers compiled with numba: one pass over the rows of an image, each written once.

The NumPy form in `bodyseg_images.py` is the reference, with the same bits. The loops refuse whatever that form refuses,
by returning -1, and test every index that depends on stored bytes before they use it. Indices are unsigned, so that no
code is made for those that count from the end.
"""

from typing import Any, Final

import numpy as np

from bodyseg_data.machine import compiled

_0, _1, _2, _3, _4 = np.uint64(0), np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
_ESCAPE: Final = np.uint64(255)
_BACKGROUND: Final = np.uint64(255)
_UNLABELLED: Final = np.uint8(254)
_CHUNK: Final = np.uint64(64)
"""Pixels that are written at once: most runs are shorter, and the next run overwrites what is too much."""


@compiled
def unzigzag(coded: Any) -> Any:
    """Decode one number as `residuals.unzigzag`, modulo 2**64."""
    return (coded >> _1) ^ (_0 - (coded & _1))


@compiled
def read_long(numbers: Any, at: Any, long: Any, index: Any) -> Any:
    """Length number `index` of `long` long runs, whose byte planes begin at `at`."""
    low = np.uint64(numbers[at + index]) | np.uint64(numbers[at + long + index]) << np.uint64(8)
    high = np.uint64(numbers[at + _2 * long + index]) | np.uint64(numbers[at + _3 * long + index]) << np.uint64(8)
    return low | high << np.uint64(16)


@compiled
def paint(names: Any, faces: Any, begin: Any, count: Any, label: Any, facing: Any) -> None:
    """Write a run into labels and facing, in whole chunks, which may end behind it."""
    chunks = (count + _CHUNK - _1) // _CHUNK
    if begin + chunks * _CHUNK <= np.uint64(names.size):
        for chunk in range(chunks):
            at = begin + chunk * _CHUNK
            for i in range(_CHUNK):
                names[at + i] = label
            for i in range(_CHUNK):
                faces[at + i] = facing
    else:
        for i in range(count):
            names[begin + i] = label
        for i in range(count):
            faces[begin + i] = facing


@compiled
def fill_camera(
    numbers: Any, counts: Any, box: Any, unlabelled: Any, image: Any, labels: Any, facing: Any, edges: Any
) -> Any:
    """Decode range, labels and facing, [H, W], whatever the images hold, and the edges of foreground.

    numbers: uint8, the rows of the first frame, as many as `counts` (`Counts`) says. box: a `Box` in the image.
    unlabelled: uint8, written for surfaces of no class.
    edges: int32, room for 2 * (starts + height), receives the flat indices where foreground begins, ends, begins ...;
    the end of a row of the box ends it, too.

    Returns the number of edges, or -1 if the numbers do not fit the counts or the box.
    """
    runs, long, starts = np.uint64(counts.runs), np.uint64(counts.long), np.uint64(counts.starts)
    others, escapes = np.uint64(counts.pixels) - starts, np.uint64(counts.escapes)
    left, height, width = np.uint64(box.left), np.uint64(box.height), np.uint64(box.width)
    facing_at, lengths_at, longs_at = runs, _2 * runs, _3 * runs
    firsts_at = longs_at + np.uint64(4) * long
    steps_at = firsts_at + _2 * starts
    large_at = steps_at + others
    columns, size = np.uint64(image.shape[1]), np.uint64(image.size)
    ranges, names, faces = image.ravel(), labels.ravel(), facing.ravel()
    above = np.zeros(width, np.uint16)  # the last step in each column
    run, next_long, start, step, escape, edge = _0, _0, _0, _0, _0, _0
    value, remaining, first, here = _BACKGROUND, _0, _0, _0
    label, faced = np.uint8(255), np.uint8(0)
    inside = False  # whether the pixel before was measured
    done = np.uint64(box.top) * columns
    for i in range(done):
        ranges[i] = 0
    for i in range(done):
        names[i] = 255
    for i in range(done):
        faces[i] = 0
    for _ in range(height):
        row = done + left
        for i in range(columns):
            ranges[done + i] = 0
        for i in range(left):
            names[done + i] = 255
            faces[done + i] = 0
        column, begin = _0, width  # begin: of the stretch in this row; width on background
        while column < width:
            if remaining == _0:
                if run == runs:
                    return -1
                label, faced = numbers[run], numbers[facing_at + run]
                value, remaining = np.uint64(label), np.uint64(numbers[lengths_at + run])
                if faced > np.uint8(3) or (value == _BACKGROUND and faced):
                    return -1
                if label == _UNLABELLED:
                    label = unlabelled
                run += _1
                if remaining == _ESCAPE:
                    if next_long == long:
                        return -1
                    remaining = read_long(numbers, longs_at, long, next_long)
                    next_long += _1
                if remaining == _0:
                    return -1
            count = min(remaining, width - column)
            paint(names, faces, row + column, count, label, faced)
            remaining -= count
            end = column
            column += count
            if value != _BACKGROUND:
                begin = min(begin, end)
                if column < width:
                    continue
                end = width
            if begin < end:
                edges[edge], edges[edge + _1] = row + begin, row + end
                edge += _2
                if not inside:
                    if start == starts:
                        return -1
                    coded = np.uint64(numbers[firsts_at + start])
                    coded |= np.uint64(numbers[firsts_at + starts + start]) << np.uint64(8)
                    first += unzigzag(coded)
                    here = first
                    ranges[row + begin] = np.uint16(here)
                    start += _1
                    begin += _1
                length = end - begin
                if length > others - step:
                    return -1
                escaped = np.uint8(0)
                for i in range(length):
                    low = numbers[steps_at + step + i]
                    above[begin + i] += (np.uint16(low) >> np.uint16(1)) ^ (np.uint16(0) - np.uint16(low & np.uint8(1)))
                    escaped |= np.uint8(low == np.uint8(255))
                if escaped:
                    for i in range(length):
                        if numbers[steps_at + step + i] == 255:
                            if escape == escapes:
                                return -1
                            coded = np.uint64(numbers[large_at + escape])
                            coded |= np.uint64(numbers[large_at + escapes + escape]) << np.uint64(8)
                            above[begin + i] += np.uint16(unzigzag(coded) - unzigzag(_ESCAPE))
                            escape += _1
                # Four at a time: each sum then waits for one addition in four.
                for four in range(length // _4):
                    at = begin + four * _4
                    sum_1 = np.uint64(above[at])
                    sum_2 = sum_1 + np.uint64(above[at + _1])
                    sum_3 = sum_2 + np.uint64(above[at + _2])
                    sum_4 = sum_3 + np.uint64(above[at + _3])
                    ranges[row + at] = np.uint16(here + sum_1)
                    ranges[row + at + _1] = np.uint16(here + sum_2)
                    ranges[row + at + _2] = np.uint16(here + sum_3)
                    ranges[row + at + _3] = np.uint16(here + sum_4)
                    here += sum_4
                for i in range(length // _4 * _4, length):
                    here += np.uint64(above[begin + i])
                    ranges[row + begin + i] = np.uint16(here)
                step += length
                begin = width
            inside = value != _BACKGROUND
        done += columns
        for i in range(row + width, done):
            names[i] = 255
            faces[i] = 0
    for i in range(done, size):
        ranges[i] = 0
    for i in range(done, size):
        names[i] = 255
    for i in range(done, size):
        faces[i] = 0
    whole = remaining == _0 and run == runs and next_long == long
    if not whole or start != starts or step != others or escape != escapes:
        return -1
    return np.int64(edge)


@compiled
def fill_projector(numbers: Any, counts: Any, box: Any, image: Any, texels: Any) -> Any:
    """Decode the occluder range into an image [Hp, Wp] of zeros.

    numbers: uint8, the rows of the second frame, as many as `counts` (`Counts`) says. box: a `Box` in the image.
    texels: int32, room for all of the image, receives the flat indices of the texels that are not 0.

    Returns their number, or -1 if the numbers do not fit the counts or the box.
    """
    flat = image.ravel()
    runs, long, width = np.uint64(counts.runs), np.uint64(counts.long), np.uint64(box.width)
    lengths_at, longs_at = _2 * runs, _3 * runs
    columns, area = np.uint64(image.shape[1]), np.uint64(box.height) * width
    corner = np.uint64(box.top) * columns + np.uint64(box.left)
    next_long, place, count = _0, _0, _0
    row, column = corner, _0
    for run in range(runs):
        remaining = np.uint64(numbers[lengths_at + run])
        if remaining == _ESCAPE:
            if next_long == long:
                return -1
            remaining = read_long(numbers, longs_at, long, next_long)
            next_long += _1
        if remaining == _0 or remaining > area - place:
            return -1
        place += remaining
        value = np.uint16(numbers[run]) | np.uint16(np.uint16(numbers[runs + run]) << np.uint16(8))
        if value == 0:
            column += remaining
            if column >= width:
                row, column = row + column // width * columns, column % width
            continue
        for _ in range(remaining):
            flat[row + column] = value
            texels[count] = row + column
            count += _1
            column += _1
            if column == width:
                row, column = row + columns, _0
    return np.int64(count) if place == area and next_long == long else -1


@compiled
def fill_copies(kinds: Any, numbers: Any, columns: Any, plane: Any) -> None:
    """Write a plane, uint16 [N], of pixels that equal the one above (0), to the left (1) or take the next number (2).

    kinds: uint8 [N], checked by `residuals.decode_copies`.
    """
    taken, row = _0, np.uint64(columns)
    for i in range(np.uint64(plane.size)):
        if kinds[i] == 0:
            plane[i] = plane[i - row]
        elif kinds[i] == 1:
            plane[i] = plane[i - _1]
        else:
            plane[i] = numbers[taken]
            taken += _1
