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
from bodyseg_data.machine import compiled

_kernel = partial(compiled, feature="the compiled form of the artifacts")
_LOOKS, _NO_PART, _REACH = 19, np.uint8(PART_COUNT), np.int64(REACH)
_HALF, _LEAST, _MOST = np.float32(0.5), np.float32(1), np.float32(65535)

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
def _sums(clean: Any, labels: Any, sums: Any) -> None:
    rows, columns = clean.shape
    for row in range(rows):
        for column in range(columns):
            if clean[row, column] > 0:
                label = min(labels[row, column], _NO_PART)
                sums[0, label] += 1
                sums[1, label] += column
                sums[2, label] += row
                sums[3, label] += clean[row, column]


@_kernel
def _alter(
    image: Any, clean: Any, labels: Any, x: Any, y: Any, looks: Any, o: Any, bits: Any, normals: Any, edge: Any, times: Any,
    padded: Any, made: Any,
) -> None:  # fmt: skip
    """padded: float32, room for `clean` with REACH more pixels on every side; made: float32 [4, columns]."""
    rows, columns = clean.shape
    padded[:] = FAR
    for row in range(rows):
        for column in range(columns):
            if clean[row, column] > 0:
                padded[row + _REACH, column + _REACH] = np.float32(clean[row, column])
    point = np.int64(0)
    for row in range(rows):
        column = np.int64(0)
        here, above, below = padded[row + _REACH], padded[row], padded[row + 2 * _REACH]
        while column < columns:
            if clean[row, column] == 0:
                column += 1
                continue
            label, end = labels[row, column], column + 1
            while end < columns and clean[row, end] > 0 and labels[row, end] == label:
                end += 1
            look, ray = to_fixed_tuple(looks[min(label, _NO_PART)], _LOOKS), y[row]
            first = point - column
            for i in range(np.uint64(column), np.uint64(end)):
                at = i + np.uint64(_REACH)
                made[0, i], made[1, i], made[2, i], made[3, i] = decode(
                    here[at], here[i], here[at + np.uint64(_REACH)], above[at], below[at], x[i], ray, look, o,
                    normals[first + np.int64(i)], bits[first + np.int64(i)],
                )  # fmt: skip
            for i in range(column, end):
                kept = image[row, i] > 0 and made[1, i] > 0
                for time in times:
                    at_row, at_column = (
                        row - np.int64(np.rint(made[3, i] * time)),
                        i - np.int64(np.rint(made[2, i] * time)),
                    )
                    inside = 0 <= at_row < rows and 0 <= at_column < columns
                    seen = padded[at_row + _REACH, at_column + _REACH] if inside else FAR
                    kept = kept and abs(seen - here[i + _REACH]) <= edge
                value = np.rint(np.float32(image[row, i]) + made[0, i])
                image[row, i] = np.uint16(np.int32(min(max(value, _LEAST), _MOST))) if kept else np.uint16(0)
            point += end - column
            column = end


def sums_of(clean: NDArray[np.uint16], labels: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Pixels of each label, and the sums of their columns, rows and steps, [4, 34]."""
    sums = np.zeros((4, PART_COUNT + 1), np.int64)
    _sums(clean, labels, sums)
    return sums


def alter(
    image: Any, clean: Any, labels: Any, x: Any, y: Any, looks: Any, optics: Any, bits: NDArray[np.uint32], *given: Any
) -> None:
    """As `PhaseShift.apply` from the tables on."""
    normals = np.empty(len(bits), np.float32)
    draw_normals(bits, len(bits), SEGMENTS, np.empty(len(bits), np.int32), normals)
    padded = np.empty(tuple(side + 2 * REACH for side in clean.shape), np.float32)
    made = np.empty((4, clean.shape[1]), np.float32)
    _alter(image, clean, labels, x, y, np.ascontiguousarray(looks.T), optics, bits, normals, *given, padded, made)
