"""`phase_shift` compiled, in runs of pixels that the compiler takes together; and `mixed_pixels`, with its bits."""

from typing import Any

import numpy as np
from numba.extending import intrinsic, overload, register_jitable
from numba.np.unsafe.ndarray import to_fixed_tuple

from bodyseg_data.artifacts import fringes
from bodyseg_data.artifacts.fringes import DRAWN, MARGIN, REACH, add, decode, fill, sideways, total
from bodyseg_data.artifacts.random_loops import bits_of, raw_words
from bodyseg_data.artifacts.scratch import kept_array
from bodyseg_data.core import Draws
from bodyseg_data.labels import PART_COUNT
from bodyseg_data.machine import compiled
from bodyseg_data.samples import Sample

_LANES, _MARGIN = np.int64(8), np.int64(MARGIN)
_LOOKS, _LABELS, _NO_PART = 19, PART_COUNT + 1, np.uint8(PART_COUNT)
_LEAST, _MOST = np.float32(1), np.float32(65535)

for _formula in (fringes.within, fringes.angle, fringes.slope, fringes.wave, fringes.velocity, sideways, add, decode):
    register_jitable(forceinline=True)(_formula)


def _select(typing: Any, condition: Any, first: Any, second: Any) -> Any:
    """One of two numbers without a branch, which would keep the compiler from taking several pixels at once."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.select(*arguments)

    return first(condition, first, second), generate


_selected: Any = intrinsic(_select)


@overload(fringes.pick, strict=False, jit_options={"forceinline": True})  # type: ignore[untyped-decorator]
def _pick(condition: Any, first: Any, second: Any) -> Any:
    return lambda condition, first, second: _selected(condition, first, second)


@overload(total, strict=False, jit_options={"forceinline": True})  # type: ignore[untyped-decorator]
def _total(patterns: Any, curve: Any, phases: Any, real: Any, imaginary: Any) -> Any:
    """Unrolled: a loop, too, would keep the compiler from taking several pixels at once."""
    if not len(patterns):
        return lambda patterns, curve, phases, real, imaginary: (real, imaginary)

    def sums(patterns: Any, curve: Any, phases: Any, real: Any, imaginary: Any) -> Any:
        more, across = add(patterns[0], curve, phases, real, imaginary)
        return total(patterns[1:], curve, phases, more, across)

    return sums


@compiled
def _cut(clean: Any, labels: Any, width: Any, changes: Any, runs: Any, sums: Any) -> Any:
    """Cut foreground into runs of one label in a row, (first pixel, end, label), and sum pixels of each label, their
    columns, rows and steps; changes: zeros behind the image. Returns how many runs there are, and their pixels.
    """
    size, count, points = np.uint64(clean.size), np.uint64(0), np.int64(0)
    first: Any = np.int64(0)
    for pixel in range(np.uint64(1), size):
        before = pixel - np.uint64(1)
        changes[pixel] = ((clean[pixel] != 0) != (clean[before] != 0)) | (labels[pixel] != labels[before])
    for start in range(width, clean.size + 1, width):
        changes[start] = 1
    words = changes.view(np.uint64)  # most of the image is alike: look at eight pixels at once
    for word in range(np.uint64(words.size)):
        if words[word] == 0:
            continue
        for pixel in range(word * np.uint64(8), word * np.uint64(8) + np.uint64(8)):
            if changes[pixel] == 0:
                continue
            start, end = first, np.int64(pixel)
            first = end
            if clean[start] == 0:
                continue
            label, length, row, steps = min(labels[start], _NO_PART), end - start, start // width, np.int64(0)
            for each in range(np.uint64(start), pixel):
                steps += np.int64(clean[each])
            runs[count, 0], runs[count, 1], runs[count, 2] = start, end, label
            sums[0, label] += length
            sums[1, label] += (start + end - 1 - 2 * row * width) * length // 2
            sums[2, label] += row * length
            sums[3, label] += steps
            points += length
            count += np.uint64(1)
    return count, points


@compiled
def _alter(
    image: Any, padded: Any, width: Any, runs: Any, count: Any, x: Any, y: Any, looks: Any, o: Any, times: Any,
    bits: Any,
) -> None:  # fmt: skip
    """Alter the pixels of runs, in whole vectors, which are quicker; pixels behind the last one keep their values."""
    stride, point = width + 2 * _MARGIN, np.uint64(0)
    for run in range(np.uint64(count)):
        first, end = np.int64(runs[run, 0]), np.int64(runs[run, 1])
        row, middle, look = first // width, (first + end - 1) // 2, to_fixed_tuple(looks[runs[run, 2]], _LOOKS)
        line = row * width
        low, high = first, end
        while low < high and image[low] == 0:  # pixels that were lost before stay lost
            low += 1
        while low < high and image[high - 1] == 0:
            high -= 1
        start = (row + _MARGIN) * stride + low - line + _MARGIN
        to, ray, here, ray_y = np.uint64(low), np.uint64(low - line), np.uint64(start), y[row]
        at_middle = np.float32(padded[start + middle - low])
        along, down = sideways(at_middle, x[middle - line], ray_y, look, o, times[0])
        then = np.uint64(start - np.int64(down) * stride - np.int64(along))
        along, down = sideways(at_middle, x[middle - line], ray_y, look, o, times[1])
        since = np.uint64(start - np.int64(down) * stride - np.int64(along))
        left, right = np.uint64(start - REACH), np.uint64(start + REACH)
        above, below = np.uint64(start - REACH * stride), np.uint64(start + REACH * stride)
        length, draw = np.uint64(high - low), point + np.uint64(low - first)
        for i in range(np.uint64(min((high - low + _LANES - 1) // _LANES * _LANES, image.size - low))):
            steps, kept = decode(
                np.float32(padded[here + i]), np.float32(padded[left + i]), np.float32(padded[right + i]),
                np.float32(padded[above + i]), np.float32(padded[below + i]), np.float32(padded[then + i]),
                np.float32(padded[since + i]), x[ray + i], ray_y, look, o, bits[draw + i],
            )  # fmt: skip
            before = image[to + i]
            value = np.rint(np.float32(before) + steps)
            after = np.uint16(np.int32(min(max(value, _LEAST), _MOST))) * np.uint16(kept & (before > 0))
            image[to + i] = np.uint16(after) if i < length else before
        point += np.uint64(end - first)


_fill: Any = compiled(fill)


def apply(image: Any, sample: Sample, given: Any, x: Any, y: Any, optics: Any, times: Any, draws: Draws) -> None:
    """As `PhaseShift.apply`; given: the first arguments of `fringes.fill`."""
    rows, width = sample.range.shape
    shape, size = (rows + 2 * MARGIN, width + 2 * MARGIN), rows * width
    padded = kept_array("padded", shape[0] * shape[1] + int(_LANES), np.uint16, shape)
    padded[: -int(_LANES)].reshape(shape)[MARGIN:-MARGIN, MARGIN:-MARGIN] = sample.range
    changes = kept_array("changes", size // 8 * 8 + 8, np.uint8, size)
    runs = kept_array("runs", 3 * size, np.int32).reshape(size, 3)
    sums, tables = np.zeros((4, _LABELS), np.int64), np.zeros((_LABELS, _LOOKS), np.float32)
    flat = sample.range.reshape(-1), sample.labels.reshape(-1)
    count, points = _cut(*flat, width, changes, runs, sums)
    clothes, motion = (bits_of(draws.stream(purpose), each) for purpose, each in DRAWN.items())
    _fill(*given, sums, clothes.reshape(6, 12), motion, tables)
    words = kept_array("words", size // 2 + 8, np.uint64)
    raw_words(*draws.stream("fringe noise"), 0, (points + 1) // 2, words)
    _alter(image.reshape(-1), padded, width, runs, count, x, y, tables, optics, times, words.view(np.uint32))


@compiled
def mix(
    image: Any, clean: Any, columns: Any, pixels: Any, bits: Any, limit: Any, behind: Any, jump_mm: Any, step_m: Any
) -> None:
    """As `MixedPixels.apply`; pixels: flat, of the foreground; limit: of the higher half of bits; behind: in steps."""
    size = clean.size
    for point in range(pixels.size):
        pixel = np.int64(pixels[point])
        before = image[pixel]
        if before == 0 or np.float64(bits[point] >> np.uint32(16)) >= limit:
            continue
        column = pixel % columns
        farthest = np.int64(0)
        above, below, left, right = pixel >= columns, pixel + columns < size, column > 0, column < columns - 1
        for inside, step in ((above, -columns), (below, columns), (left, np.int64(-1)), (right, np.int64(1))):
            if inside:
                value = np.int64(clean[pixel + step])
                farthest = max(farthest, value if value > 0 else behind)
        gap = farthest - np.int64(clean[pixel])
        if gap * step_m * 1000 >= jump_mm:
            position = np.float64(bits[point] & np.uint32(0xFFFF)) / 65536
            value_f = np.rint(np.float64(before) + gap * position)
            image[pixel] = np.uint16(np.int32(min(value_f, np.float64(_MOST))))
