"""Evidence for labels, carried from the pixels of one frame to those of the next, compiled with numba.

A pixel has a few slots, uint32: weight << 8 | label, in units of 1 / `UNIT`. The first slot is the label shown, the
others contend for its place. All arithmetic on evidence is of whole numbers.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np

from bodyseg_data.core.kernels import compiled
from bodyseg_data.core.parts import BACKGROUND

_kernel = partial(compiled, feature="carrying labels through a video")

UNIT: Final = 4096
"""Evidence of one frame with confidence 1."""

SLOTS: Final = 3
"""Labels that a pixel has evidence for, at most; a new one replaces the weaker of those not shown."""

_EMPTY: Final = np.uint32(BACKGROUND)
_LABEL: Final = np.uint32(255)
_BITS: Final = np.uint32(8)
_SHARE_BITS: Final = np.uint32(10)
_HALF: Final = np.float32(0.5)
_UNIT: Final = np.float32(UNIT)
_SHIFT: Final = np.float32(4096)  # makes coordinates positive, so that cutting off decimals rounds down
_FARTHEST: Final = np.float32(4000)  # pixels outside the image that coordinates can be
_NEAREST_M: Final = np.float32(0.1)  # before the camera
_FAST: Final = 256  # pixels of motion; from there on a point keeps the same share


@_kernel
def weight_of(confidence: Any) -> Any:
    """Evidence that a frame gives for its label: the square of its confidence, in units."""
    return np.uint32(confidence * confidence * _UNIT + _HALF)


@_kernel
def begin(range_m: Any, pixels: Any, labels: Any, confidence: Any, ranges: Any, slots: Any, shown: Any) -> None:
    """Evidence of a body that was not seen before; arguments as of `carry`."""
    for n in range(len(pixels)):
        p = np.uint64(pixels[n])
        ranges[p] = range_m[p]
        shown[p] = labels[p]
        slots[p, 0] = (weight_of(confidence[n]) << _BITS) | np.uint32(labels[p])
        slots[p, 1], slots[p, 2] = _EMPTY, _EMPTY


@_kernel
def nearest_first(reach: Any) -> Any:
    """Steps along rows and columns, int64 [N, 2], of all pixels up to `reach` away along each axis but (0, 0): the
    nearest first, equally near ones in reading order.
    """
    found, count = np.empty(((2 * reach + 1) ** 2 - 1, 2), np.int64), 0
    for squared in range(1, 2 * reach * reach + 1):
        for v in range(-reach, reach + 1):
            for u in range(-reach, reach + 1):
                if u * u + v * v == squared:
                    found[count, 0], found[count, 1] = v, u
                    count += 1
    return found


@_kernel
def nearest(column: Any, line: Any, z: Any, old_range_m: Any, lens: Any, tolerance: Any, reach: Any, steps: Any) -> Any:
    """The first pixel, by `steps`, those of `nearest_first` up to `reach`, from (column, line), whose old range is
    within `tolerance` of z, metres; -1 for none.
    """
    here = line * lens.columns + column
    inside = reach <= line < lens.rows - reach and reach <= column < lens.columns - reach
    for n in range(len(steps)):
        v, u = steps[n, 0], steps[n, 1]
        if inside or (0 <= line + v < lens.rows and 0 <= column + u < lens.columns):
            p = np.uint64(here + v * lens.columns + u)
            if (old_range_m[p] > 0) & (abs(old_range_m[p] - z) <= tolerance):
                return np.int64(p)
    return np.int64(-1)


@_kernel
def shown_near(
    found: Any, label: Any, z: Any, old_range_m: Any, old_slots: Any, lens: Any, tolerance: Any, reach: Any
) -> Any:
    """True if the old frame shows a label up to `reach` pixels from pixel `found` along each axis, at a range within
    `tolerance` of z, metres.
    """
    line, column = found // lens.columns, found % lens.columns
    for v in range(max(line - reach, 0), min(line + reach + 1, lens.rows)):
        for u in range(max(column - reach, 0), min(column + reach + 1, lens.columns)):
            p = np.uint64(v * lens.columns + u)
            if (old_slots[p, 0] & _LABEL) == label and old_range_m[p] > 0 and abs(old_range_m[p] - z) <= tolerance:
                return True
    return False


@_kernel
def carry(
    range_m: Any, pixels: Any, labels: Any, confidence: Any, lens: Any, motion: Any, field: Any, index: Any,
    old_range_m: Any, old_slots: Any, tolerance: Any, reach: Any, keep: Any, slow: Any, margin: Any,
    border: Any, border_share: Any, ranges: Any, slots: Any, shown: Any,
) -> None:  # fmt: skip
    """Carry evidence to a body's pixels, add the new frame's, and show the labels that have most.

    range_m, old_range_m: float32 [H * W], metres; the old one is 0 off the bodies. pixels: int64 [N], ascending;
    labels: uint8 [H * W]; confidence: float32 [N], 0 to 1. motion: float32 [3, 4], from this frame to the old one;
    field: float32 [M, 3], metres, added to it, by `index`, int32, of a pixel's cell. A pixel's point is sought at the
    pixel that it projects into, then up to `reach` pixels around it, the nearest first, where the old range is within
    `tolerance`, metres; not found, evidence starts anew. The old weights are multiplied by keep / (1 + slow d), d the
    pixels moved, along rows and columns; and by `border_share` if another label than the new frame's is shown there,
    and the new one up to `border` pixels beside it: a border has moved, or its place is uncertain. The label shown
    changes if another has more evidence by more than `margin`, in units. Written at `pixels`: ranges, float32, metres,
    slots, uint32 [H * W, SLOTS], and shown, uint8, labels.
    """
    steps = nearest_first(reach)
    x_of, cell_of = np.empty(lens.columns, np.float32), np.empty(lens.columns, np.int32)
    focal, cx, cy = np.float32(lens.focal), np.float32(lens.x), np.float32(lens.y)
    for u in range(lens.columns):
        x_of[u], cell_of[u] = (np.float32(u) + _HALF - cx) / focal, u // lens.side
    shares, border_shares = np.empty(_FAST, np.uint32), np.empty(_FAST, np.uint32)
    for away in range(_FAST):
        shares[away] = np.uint32((1 << 10) * keep / (1 + slow * away) + 0.5)
        border_shares[away] = np.uint32((1 << 10) * border_share * keep / (1 + slow * away) + 0.5)
    a, b, c, d = motion[0, 0], motion[0, 1], motion[0, 2], motion[0, 3]
    e, f, g, h = motion[1, 0], motion[1, 1], motion[1, 2], motion[1, 3]
    i, j, k, l = motion[2, 0], motion[2, 1], motion[2, 2], motion[2, 3]  # noqa: E741
    v, first, beyond, row, y_of = np.int64(0), np.int64(0), np.int64(0), np.int64(0), np.float32(0)
    for n in range(len(pixels)):
        pixel = pixels[n]
        if pixel >= beyond:
            v = pixel // lens.columns
            first, beyond, row = v * lens.columns, (v + 1) * lens.columns, (v // lens.side) * lens.across
            y_of = (np.float32(v) + _HALF - cy) / focal
        # Indices are uint64: int64 would be tested for counting from the end.
        p, u = np.uint64(pixel), pixel - first
        z, label = range_m[p], np.uint32(labels[p])
        x, y = x_of[np.uint64(u)] * z, y_of * z
        cell = index[np.uint64(row + cell_of[np.uint64(u)])]
        px, py, pz = a * x + b * y + c * z + d, e * x + f * y + g * z + h, i * x + j * y + k * z + l
        if cell >= 0:
            m = np.uint64(cell)
            px, py, pz = px + field[m, 0], py + field[m, 1], pz + field[m, 2]
        found, column, line = np.int64(-1), np.int64(-1), np.int64(-1)
        if pz > _NEAREST_M:
            scale = focal / pz
            px, py = px * scale + cx, py * scale + cy
            if abs(px) < _FARTHEST and abs(py) < _FARTHEST:
                column, line = np.int64(px + _SHIFT) - np.int64(_SHIFT), np.int64(py + _SHIFT) - np.int64(_SHIFT)
                if 0 <= column < lens.columns and 0 <= line < lens.rows:
                    found = line * lens.columns + column
                    if not abs(old_range_m[np.uint64(found)] - pz) <= tolerance or old_range_m[np.uint64(found)] <= 0:
                        found = np.int64(-1)
                if found < 0:
                    found = nearest(column, line, pz, old_range_m, lens, tolerance, reach, steps)
        ranges[p] = z
        weight = weight_of(confidence[n])
        if found < 0:
            slots[p, 0], slots[p, 1], slots[p, 2] = (weight << _BITS) | label, _EMPTY, _EMPTY
            shown[p] = labels[p]
            continue
        o = np.uint64(found)
        moved = np.uint64(min(abs(column - u) + abs(line - v), _FAST - 1))
        share = shares[moved]
        other = (old_slots[o, 0] & _LABEL) != label
        if other and shown_near(found, label, pz, old_range_m, old_slots, lens, tolerance, border):
            share = border_shares[moved]
        one, two, three = old_slots[o, 0], old_slots[o, 1], old_slots[o, 2]
        n1, n2, n3 = one & _LABEL, two & _LABEL, three & _LABEL
        w1 = ((one >> _BITS) * share) >> _SHARE_BITS
        w2 = ((two >> _BITS) * share) >> _SHARE_BITS
        w3 = ((three >> _BITS) * share) >> _SHARE_BITS
        if n1 == label:
            w1 += weight
        elif n2 == label:
            w2 += weight
        elif n3 == label:
            w3 += weight
        elif w3 <= w2:
            if weight >= w3:
                n3, w3 = label, weight
        elif weight >= w2:
            n2, w2 = label, weight
        if w3 > w2:
            n2, w2, n3, w3 = n3, w3, n2, w2
        if w2 > w1 + margin:
            n1, w1, n2, w2 = n2, w2, n1, w1
        slots[p, 0], slots[p, 1], slots[p, 2] = (w1 << _BITS) | n1, (w2 << _BITS) | n2, (w3 << _BITS) | n3
        shown[p] = n1
