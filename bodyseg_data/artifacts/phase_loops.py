"""`phase_shift` compiled: its `decode` along rows, so that the compiler takes several pixels at once."""

from functools import partial
from typing import Any

import numpy as np
from numba.extending import intrinsic, overload, register_jitable
from numba.np.unsafe.ndarray import to_fixed_tuple

from bodyseg_data.artifacts import fringes
from bodyseg_data.artifacts.constants import FAR, SEGMENTS
from bodyseg_data.artifacts.fringes import REACH, decode, pick
from bodyseg_data.artifacts.fringes import fill as fill_tables
from bodyseg_data.artifacts.random_loops import draw_normals, raw_words
from bodyseg_data.artifacts.scratch import BLOCK, CHUNK, ROOM, constant
from bodyseg_data.artifacts.shadow_loops import find_runs
from bodyseg_data.core import Draws
from bodyseg_data.labels import PART_COUNT
from bodyseg_data.machine import compiled
from bodyseg_data.samples import Sample

_kernel = partial(compiled, feature="the compiled form of the artifacts")
_LOOKS, _LABELS, _NO_PART, _REACH = 19, PART_COUNT + 1, np.uint8(PART_COUNT), np.int64(REACH)
_CHUNK, _ROOM = np.int64(CHUNK), np.uint64(ROOM)
_ONE, _TWO, _THREE, _FOUR, _FIVE, _SIX, _SEVEN, _EIGHT, _NINE, _TEN, _ELEVEN = map(np.uint64, range(1, 12))
_ZERO, _LEAST, _MOST = map(np.float32, (0, 1, 65535))

for _formula in (
    fringes.sine,
    fringes.angle,
    fringes.slope,
    fringes.wave,
    fringes.changes_at,
    decode,
    fringes.cross,
):
    register_jitable(forceinline=True)(_formula)
register_jitable(fill_tables)  # by its name, which a kernel's digest follows


def _select(typing: Any, condition: Any, first: Any, second: Any) -> Any:
    """One of two numbers without a branch, which would keep the compiler from taking several pixels at once."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(*arguments)

    return first(condition, first, second), generate


_selected: Any = intrinsic(_select)


@overload(fringes.pick, strict=False, jit_options={"forceinline": True})  # type: ignore[untyped-decorator]
def _pick(condition: Any, first: Any, second: Any) -> Any:
    return lambda condition, first, second: _selected(condition, first, second)


@_kernel
def _split(clean: Any, labels: Any, width: Any, edges: Any, runs: Any, sums: Any, order: Any) -> Any:
    """Cut runs of foreground into those of one label in a row, (row, first pixel, end, label, pixels before it), and
    sum pixels of each label, their columns, rows and steps; order: numbers of runs, by label.

    Images are flat. Returns how many there are, and their pixels.
    """
    count, points = np.int64(0), np.int64(0)
    row: Any = np.int64(0)
    starts = np.zeros(_LABELS + 1, np.int64)
    for edge in range(np.uint64(edges.size // 2)):
        first, last = np.int64(edges[_TWO * edge]), np.int64(edges[_TWO * edge + _ONE])
        while first < last:
            while first >= (row + 1) * width:
                row += 1
            name, end, limit = labels[np.uint64(first)], first + 1, min(last, (row + 1) * width)
            while end < limit and labels[np.uint64(end)] == name:
                end += 1
            steps = np.int64(0)
            for pixel in range(np.uint64(first), np.uint64(end)):
                steps += np.int64(clean[pixel])
            label, length = np.int64(min(name, _NO_PART)), end - first
            at = np.uint64(count)
            runs[at, 0], runs[at, 1], runs[at, 2], runs[at, 3], runs[at, 4] = row, first, end, label, points
            sums[0, label] += length
            sums[1, label] += (first + end - 1 - 2 * row * width) * length // 2
            sums[2, label] += row * length
            sums[3, label] += steps
            starts[label + 1] += 1
            points += length
            count += 1
            first = end
    for each in range(_LABELS):
        starts[each + 1] += starts[each]
    for run in range(count):
        label = runs[run, 3]
        order[starts[label]] = run
        starts[label] += 1
    return count, points


@_kernel
def _known(value: Any) -> Any:
    return np.float32(value) if value > 0 else FAR


@_kernel
def _gather(clean: Any, width: Any, run: Any, first: Any, length: Any, x: Any, y: Any, at: Any, f: Any) -> None:
    """Write ranges of a run's pixels and of those beside them, and their rays, from place `at` on.

    Whole blocks are quicker; what is written behind the last pixel is not read.
    """
    row, column, place, size = run[0], first - run[0] * width, np.uint64(at), clean.size
    span = (length + BLOCK - 1) // BLOCK * BLOCK
    has_above, has_below = row >= _REACH, row < size // width - _REACH
    if column < _REACH or column + length > width - _REACH or first + _REACH * width + span > size:
        span = length
    here, ray, ray_y = np.uint64(first), np.uint64(column), y[row]
    up, down = np.uint64(first - _REACH * width), np.uint64(first + _REACH * width)
    for i in range(np.uint64(span)):
        f[place + i] = np.float32(clean[here + i])
        f[_FIVE * _ROOM + place + i] = x[ray + i]
        f[_SIX * _ROOM + place + i] = ray_y
    if has_above:
        for i in range(np.uint64(span)):
            f[_THREE * _ROOM + place + i] = _known(clean[up + i])
    else:
        f[_THREE * _ROOM + place : _THREE * _ROOM + place + np.uint64(span)] = FAR
    if has_below:
        for i in range(np.uint64(span)):
            f[_FOUR * _ROOM + place + i] = _known(clean[down + i])
    else:
        f[_FOUR * _ROOM + place : _FOUR * _ROOM + place + np.uint64(span)] = FAR
    if column >= _REACH and column + length <= width - _REACH:
        for i in range(np.uint64(span)):
            f[_ROOM + place + i] = _known(clean[here - np.uint64(_REACH) + i])
            f[_TWO * _ROOM + place + i] = _known(clean[here + np.uint64(_REACH) + i])
    else:
        for step in range(length):
            to, pixel = place + np.uint64(step), here + np.uint64(step)
            left, right = column + step >= _REACH, column + step < width - _REACH
            f[_ROOM + to] = _known(clean[pixel - np.uint64(_REACH)]) if left else FAR
            f[_TWO * _ROOM + to] = _known(clean[pixel + np.uint64(_REACH)]) if right else FAR


@_kernel
def _decode(count: Any, look: Any, o: Any, words: Any, f: Any) -> None:
    for i in range(np.uint64(count)):
        f[_EIGHT * _ROOM + i], f[_NINE * _ROOM + i], f[_TEN * _ROOM + i], f[_ELEVEN * _ROOM + i] = decode(
            f[i], f[_ROOM + i], f[_TWO * _ROOM + i], f[_THREE * _ROOM + i], f[_FOUR * _ROOM + i], f[_FIVE * _ROOM + i],
            f[_SIX * _ROOM + i], look, o, f[_SEVEN * _ROOM + i], words[i],
        )  # fmt: skip


@_kernel
def _trace(rows: Any, width: Any, run: Any, first: Any, length: Any, times: Any, at: Any, ints: Any, f: Any) -> None:
    """Write which pixels the surfaces of a run came from at both times, -1 for those beyond the image."""
    column, row, place, most = np.float32(first - run[0] * width), np.float32(run[0]), np.uint64(at), np.float32(rows)
    span, wide = (length + BLOCK - 1) // BLOCK * BLOCK, np.float32(width)
    for time in range(_TWO):
        to = time * _ROOM + place
        for i in range(np.uint64(span)):
            down = row - np.rint(f[_ELEVEN * _ROOM + place + i] * times[time])
            along = column + np.float32(np.int32(i)) - np.rint(f[_TEN * _ROOM + place + i] * times[time])
            inside = (down >= _ZERO) & (down < most) & (along >= _ZERO) & (along < wide)
            pixel = np.int32(pick(inside, down, _ZERO)) * np.int32(width) + np.int32(pick(inside, along, _ZERO))
            ints[to + i] = pick(inside, np.int32(pixel), np.int32(-1))


@_kernel
def _scatter(image: Any, first: Any, length: Any, edge: Any, at: Any, f: Any) -> None:
    to, place = np.uint64(first), np.uint64(at)
    span = min((length + BLOCK - 1) // BLOCK * BLOCK, image.size - first)
    for i in range(np.uint64(span)):
        before, here = image[to + i], f[place + i]
        one, two = f[_THREE * _ROOM + place + i], f[_FOUR * _ROOM + place + i]
        kept = (before > 0) & (f[_NINE * _ROOM + place + i] > _ZERO) & (one > _ZERO) & (two > _ZERO)
        kept &= (abs(one - here) <= edge) & (abs(two - here) <= edge)
        value = np.rint(np.float32(before) + f[_EIGHT * _ROOM + place + i])
        after = np.uint16(np.int32(min(max(value, _LEAST), _MOST))) * np.uint16(kept)
        image[to + i] = np.uint16(after) if np.int64(i) < length else before


@_kernel
def _alter(
    image: Any, clean: Any, width: Any, runs: Any, order: Any, points: Any, x: Any, y: Any, looks: Any, o: Any,
    stream: Any, edge: Any, times: Any, segments: Any, f: Any, ints: Any,
) -> None:  # fmt: skip
    """Alter the pixels of runs in the order of their labels; f, ints: room for numbers of a chunk's points."""
    drawn = np.empty((points + 7) // 8 * 4, np.uint64)
    raw_words(stream[0], stream[1], 0, drawn.size, drawn)
    bits, words = drawn.view(np.uint32), np.empty(CHUNK, np.uint32)
    pieces = np.empty((CHUNK, 4), np.int64)  # run, first pixel, length, place
    number = np.int64(0)
    taken: Any = np.int64(0)
    while number < len(order):
        label, count, found = runs[order[number], 3], np.int64(0), np.int64(0)
        while number < len(order) and runs[order[number], 3] == label and count < _CHUNK:
            run = order[number]
            first, point = runs[run, 1] + taken, runs[run, 4] + taken
            length = min(runs[run, 2] - first, _CHUNK - count)
            pieces[found, 0], pieces[found, 1], pieces[found, 2], pieces[found, 3] = run, first, length, count
            _gather(clean, width, runs[run], first, length, x, y, count, f)
            for i in range(np.uint64(length)):
                words[np.uint64(count) + i] = bits[np.uint64(point) + i]
            count += length
            found += 1
            taken = taken + length if first + length < runs[run, 2] else 0
            number += np.int64(taken == 0)
        draw_normals(words, count, segments, ints, f[_SEVEN * _ROOM : _EIGHT * _ROOM])
        _decode(count, to_fixed_tuple(looks[label], _LOOKS), o, words, f)
        for i in range(found):
            piece = pieces[i]
            _trace(clean.size // width, width, runs[piece[0]], piece[1], piece[2], times, piece[3], ints, f)
        for time in range(_TWO):
            for i in range(np.uint64(count)):
                pixel = ints[time * _ROOM + i]
                f[(_THREE + time) * _ROOM + i] = np.float32(clean[np.uint64(max(pixel, 0))] if pixel >= 0 else 0)
        for i in range(found):
            _scatter(image, pieces[i, 1], pieces[i, 2], edge, pieces[i, 3], f)


@_kernel
def fill(parts: Any, sums: Any, place: Any, cloth: Any, clothes: Any, motion: Any, tables: Any) -> None:
    """As `fringes.fill`."""
    fill_tables(parts, sums, place, cloth, clothes, motion, tables)


def apply(
    image: Any, sample: Sample, x: Any, y: Any, looks_of: Any, optics: Any, draws: Draws, edge: Any, times: Any
) -> None:
    """As `PhaseShift.apply`, from the tables on; looks_of: makes those of labels of their sums."""
    clean, labels, occupancy, width = constant(sample.range), constant(sample.labels), sample.occupancy, image.shape[1]
    if occupancy is not None and occupancy.edges is not None:
        edges = occupancy.edges
    else:
        edges = np.empty(clean.size + 2, np.int32)
        edges = edges[: 2 * find_runs(clean, np.zeros(clean.size // 8 * 8 + 8, np.uint8), edges)]
    # Of memory that is not written to, the system gives none.
    runs, order = np.empty((clean.size, 5), np.int64), np.empty(clean.size, np.int64)
    sums = np.zeros((4, _LABELS), np.int64)
    count, points = _split(clean, labels, width, edges, runs, sums, order)
    looks = np.ascontiguousarray(looks_of(sums, draws=draws).T)
    room = SEGMENTS, np.empty(12 * ROOM, np.float32), np.empty(2 * ROOM, np.int32)
    of_labels = runs[:count], order[:count], points, x, y, looks, optics
    _alter(image.reshape(-1), clean, width, *of_labels, draws.stream("fringe noise"), edge, times, *room)
