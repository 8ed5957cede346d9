"""`phase_shift` compiled: its `decode` along rows, so that the compiler takes several pixels at once."""

from functools import partial
from typing import Any

import numpy as np
from numba.extending import intrinsic, overload, register_jitable
from numba.np.unsafe.ndarray import to_fixed_tuple
from numpy.typing import NDArray

from bodyseg_data.artifacts import phase_shift
from bodyseg_data.artifacts.constants import FAR, SEGMENTS
from bodyseg_data.artifacts.phase_shift import PART_COUNT, REACH, decode
from bodyseg_data.artifacts.random_loops import draw_normals
from bodyseg_data.artifacts.scratch import CHUNK, ROOM, constant
from bodyseg_data.machine import compiled

_kernel = partial(compiled, feature="the compiled form of the artifacts")
_LOOKS, _NO_PART, _REACH = 19, np.uint8(PART_COUNT), np.int64(REACH)
_CHUNK, _ROOM = np.int64(CHUNK), np.uint64(ROOM)
_ONE, _TWO, _THREE, _FOUR, _FIVE, _SIX, _SEVEN, _EIGHT, _NINE, _TEN, _ELEVEN = map(np.uint64, range(1, 12))
_LEAST, _MOST = np.float32(1), np.float32(65535)

for _formula in (
    phase_shift.sine,
    phase_shift.angle,
    phase_shift.slope,
    phase_shift.wave,
    phase_shift.changes_at,
    decode,
):
    register_jitable(forceinline=True)(_formula)


def _select(typing: Any, condition: Any, first: Any, second: Any) -> Any:
    """One of two numbers without a branch, which would keep the compiler from taking several pixels at once."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(*arguments)

    return first(condition, first, second), generate


_selected: Any = intrinsic(_select)


@overload(phase_shift.pick, strict=False, jit_options={"forceinline": True})
def _pick(condition: Any, first: Any, second: Any) -> Any:
    return lambda condition, first, second: _selected(condition, first, second)


@_kernel
def _find_runs(clean: Any, labels: Any, runs: Any, sums: Any) -> Any:
    """Find runs of one label in a row, (row, first, end, label, pixels before it), and sum as `sums_of`."""
    rows, columns = clean.shape
    count, points = np.int64(0), np.int64(0)
    for row in range(rows):
        ranges, names = clean[row], labels[row]
        column = np.uint64(0)
        while column < np.uint64(columns):
            if ranges[column] == 0:
                column += _ONE
                continue
            label, end, steps = names[column], column, np.int64(0)
            while end < np.uint64(columns) and ranges[end] > 0 and names[end] == label:
                steps += np.int64(ranges[end])
                end += _ONE
            first, after, label = np.int64(column), np.int64(end), min(label, _NO_PART)
            runs[count, 0], runs[count, 1], runs[count, 2] = row, first, after
            runs[count, 3], runs[count, 4] = label, points
            length = after - first
            sums[0, label] += length
            sums[1, label] += (first + after - 1) * length // 2
            sums[2, label] += row * length
            sums[3, label] += steps
            points += length
            count += 1
            column = end
    return count


@_kernel
def _known(value: Any) -> Any:
    return np.float32(value) if value > 0 else FAR


@_kernel
def _gather(clean: Any, row: Any, first: Any, end: Any, x: Any, y: Any, at: Any, f: Any) -> None:
    """Write ranges of a run's pixels and of those beside them, and their rays, from place `at` on."""
    rows, columns = clean.shape
    here, to, start, length = clean[row], np.uint64(at), np.uint64(first), np.uint64(end - first)
    ray = y[row]
    for i in range(length):
        f[to + i] = np.float32(here[start + i])
        f[_FIVE * _ROOM + to + i] = x[start + i]
        f[_SIX * _ROOM + to + i] = ray
    if first >= _REACH and end <= columns - _REACH:
        for i in range(length):
            f[_ROOM + to + i] = _known(here[start - np.uint64(_REACH) + i])
            f[_TWO * _ROOM + to + i] = _known(here[start + np.uint64(_REACH) + i])
    else:
        for i in range(length):
            column = first + np.int64(i)
            f[_ROOM + to + i] = _known(here[column - _REACH]) if column >= _REACH else FAR
            f[_TWO * _ROOM + to + i] = _known(here[column + _REACH]) if column < columns - _REACH else FAR
    if row >= _REACH:
        above = clean[row - _REACH]
        for i in range(length):
            f[_THREE * _ROOM + to + i] = _known(above[start + i])
    else:
        f[_THREE * _ROOM + to : _THREE * _ROOM + to + length] = FAR
    if row < rows - _REACH:
        below = clean[row + _REACH]
        for i in range(length):
            f[_FOUR * _ROOM + to + i] = _known(below[start + i])
    else:
        f[_FOUR * _ROOM + to : _FOUR * _ROOM + to + length] = FAR


@_kernel
def _decode(count: Any, look: Any, o: Any, words: Any, f: Any) -> None:
    for i in range(np.uint64(count)):
        f[_EIGHT * _ROOM + i], f[_NINE * _ROOM + i], f[_TEN * _ROOM + i], f[_ELEVEN * _ROOM + i] = decode(
            f[i], f[_ROOM + i], f[_TWO * _ROOM + i], f[_THREE * _ROOM + i], f[_FOUR * _ROOM + i], f[_FIVE * _ROOM + i],
            f[_SIX * _ROOM + i], look, o, f[_SEVEN * _ROOM + i], words[i],
        )  # fmt: skip


@_kernel
def _scatter(image: Any, clean: Any, row: Any, first: Any, end: Any, edge: Any, times: Any, at: Any, f: Any) -> None:
    rows, columns = clean.shape
    for i in range(np.uint64(end - first)):
        column, place = first + np.int64(i), np.uint64(at) + i
        kept = image[row, column] > 0 and f[_NINE * _ROOM + place] > 0
        if kept:
            for time in times:
                at_row = row - np.int64(np.rint(f[_ELEVEN * _ROOM + place] * time))
                at_column = column - np.int64(np.rint(f[_TEN * _ROOM + place] * time))
                inside = 0 <= at_row < rows and 0 <= at_column < columns
                seen = clean[at_row, at_column] if inside else np.uint16(0)
                kept &= seen > 0 and abs(np.float32(seen) - f[place]) <= edge
        value = np.rint(np.float32(image[row, column]) + f[_EIGHT * _ROOM + place])
        image[row, column] = np.uint16(np.int32(min(max(value, _LEAST), _MOST))) if kept else np.uint16(0)


@_kernel
def _alter(
    image: Any, clean: Any, runs: Any, x: Any, y: Any, looks: Any, o: Any, bits: Any, edge: Any, times: Any, words: Any,
    segments: Any, segment_of: Any, f: Any,
) -> None:  # fmt: skip
    """Alter the pixels of runs that are sorted by label; words, segment_of, f: room for those of a chunk."""
    run, taken = np.int64(0), np.int64(0)
    while run < len(runs):
        label, begin, begun, count = runs[run, 3], run, taken, np.int64(0)
        while run < len(runs) and runs[run, 3] == label and count < _CHUNK:
            first, point = runs[run, 1] + taken, runs[run, 4] + taken
            end = min(runs[run, 2], first + _CHUNK - count)
            _gather(clean, runs[run, 0], first, end, x, y, count, f)
            for i in range(np.uint64(end - first)):
                words[np.uint64(count) + i] = bits[np.uint64(point) + i]
            count += end - first
            taken = taken + end - first if end < runs[run, 2] else 0
            run += np.int64(taken == 0)
        draw_normals(words, count, segments, segment_of, f[_SEVEN * _ROOM : _EIGHT * _ROOM])
        _decode(count, to_fixed_tuple(looks[label], _LOOKS), o, words, f)
        place = np.int64(0)
        while place < count:
            first = runs[begin, 1] + begun
            end = min(runs[begin, 2], first + count - place)
            _scatter(image, clean, runs[begin, 0], first, end, edge, times, place, f)
            place += end - first
            begin, begun = begin + 1, 0


def runs_of(clean: NDArray[np.uint16], labels: NDArray[np.uint8]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Runs of one label, sorted by it, and sums of the pixels of each: number, columns, rows and steps, [4, 34]."""
    sums = np.zeros((4, PART_COUNT + 1), np.int64)
    ends = (labels[:, 1:] != labels[:, :-1]) | ((clean[:, 1:] == 0) != (clean[:, :-1] == 0))
    runs = np.empty((np.count_nonzero(ends) + len(clean), 5), np.int64)
    count = _find_runs(constant(clean).reshape(clean.shape), constant(labels).reshape(clean.shape), runs, sums)
    runs = runs[:count]
    return runs[np.argsort(runs[:, 3], kind="stable")], sums


def alter(image: Any, clean: Any, runs: Any, x: Any, y: Any, looks: Any, *given: Any) -> None:
    """As `PhaseShift.apply` from the tables on."""
    room = np.empty(CHUNK, np.uint32), SEGMENTS, np.empty(CHUNK, np.int32), np.empty(12 * ROOM, np.float32)
    looks = np.ascontiguousarray(looks.T)
    _alter(image, constant(clean).reshape(clean.shape), runs, x, y, looks, *given, *room)
