"""The projector's stored range: only texels that can shade a pixel which the camera sees, in as few bits as do.

The shadow test (`artifacts/occlusion.py`) reads four texels for each camera pixel whose surface faces the projector;
only those are rendered. If none of the four lies in front of the point by more than the gap that the test
allows, the test answers "lit" whether they are there or empty. So a texel is kept only if a pixel reads it that has
such a texel among its four; the test then gives the same bits as from a whole image.

What is kept is rounded. The test compares the four texels with one another, and each of them, or their interpolation,
with the point's range. Any texels with the same outcomes give the same shadow. So each texel gets bounds within which
no pixel's answer can change, whatever the others do within theirs; a texel that may be empty is emptied, any other
becomes the multiple of the largest power of two that its bounds hold, which is the same number over large areas. Then
the test itself is run on both images, and where answers differ, the exact ranges come back.
"""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts import ShadowTest, framed
from bodyseg_data.samples import FARTHEST_STEPS

COARSEST_STEP: Final = 1024
"""Ranges are rounded to multiples of at most this many steps: larger ones save nothing more."""

_EMPTY: Final = 65535  # empty texels as the test sees them: 0 less one step, behind every point
_MARGIN: Final = 1  # of bounds: the test computes in single precision, which is off by far less than a step

Range = NDArray[np.uint16]
Floats = NDArray[np.float32]
Ints = NDArray[np.int32]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]

Ranges = Callable[[Indices], Range]
"""Texels [N], row * columns + column, ascending -> projector ranges, uint16 [N], in steps."""


def occluder_range(test: ShadowTest, camera_range: Range, faces_projector: Mask, ranges: Ranges) -> Range:
    """The projector's range where it shades a view, as coarse as the shadows permit, 0 elsewhere, uint16 [Hp, Wp], in
    steps. The shadow test gives the same bits from it as from the whole exact image. Arguments as `exact_range`'s.
    """
    image, *points = exact_range(test, camera_range, faces_projector, ranges)
    return coarsened(test, image, *points)


def exact_range(
    test: ShadowTest, camera_range: Range, faces_projector: Mask, ranges: Ranges
) -> tuple[Range, Floats, Floats, Floats]:
    """The projector's exact range where it can shade, 0 elsewhere, and the points that it may shade (`reached`).

    camera_range: uint16 [H, W], in steps. faces_projector: bool [H, W], False on background. ranges: called once, for
    the texels that the shadow test reads.
    """
    projector = test.rig.projector
    image = np.zeros((projector.rows, projector.columns), np.uint16)
    _, x, y, away = test.project(camera_range, np.flatnonzero(faces_projector))
    width = projector.columns + 2
    start = _starts(image.shape, x, y)
    read = np.flatnonzero(_footprint(start, image.shape))
    image.ravel()[read] = ranges(read)

    texels = framed(image).ravel()
    nearest = texels.take(start)
    for shift in (1, width, width + 1):
        np.minimum(nearest, texels[shift:].take(start), out=nearest)
    behind = np.minimum(away - np.float32(1), FARTHEST_STEPS) - nearest
    image[~_footprint(start[behind > test.gap_steps - _MARGIN], image.shape)] = 0
    return image, x, y, away


def _starts(shape: tuple[int, ...], x: Floats, y: Floats) -> Indices:
    """Flat index into the framed image of the upper left of the four texels around each point, [N]."""
    found = (np.floor(y).astype(np.int32) + 1) * np.int32(shape[1] + 2) + np.floor(x).astype(np.int32) + np.int32(1)
    return found.astype(np.intp)


def _footprint(start: Indices, shape: tuple[int, int]) -> Mask:
    """The texels that points read, bool [Hp, Wp]; start: as `_starts`."""
    rows, columns = shape
    read = np.zeros((rows + 2, columns + 2), np.bool_)
    read.ravel()[start] = True
    read[:, 1:] |= read[:, :-1]
    read[1:] |= read[:-1]
    # The frame repeats the image's border.
    read[1] |= read[0]
    read[-2] |= read[-1]
    read[:, 1] |= read[:, 0]
    read[:, -2] |= read[:, -1]
    return read[1:-1, 1:-1]


def coarsened(test: ShadowTest, image: Range, x: Floats, y: Floats, away: Floats) -> Range:
    """An image, uint16 [Hp, Wp], by which points are lit (`ShadowTest.reached`) as by `image`, in the rig's steps."""
    held = framed(image) != _EMPTY
    held[:-1] |= held[1:]
    held[:, :-1] |= held[:, 1:]
    read = np.flatnonzero(held.ravel().take(_starts(image.shape, x, y)))  # others read empty texels, which stay so
    points = x[read], y[read], away[read]
    texels = texel_indices(image.shape, *points[:2])
    answers = test.reached(image, *points)
    coarse = _simplest(image, *texel_bounds(test, image, texels, points, answers))
    while len(wrong := np.flatnonzero(test.reached(coarse, *points) != answers)):
        coarse.ravel()[texels[:, wrong]] = image.ravel()[texels[:, wrong]]
    return coarse


def texel_indices(shape: tuple[int, ...], x: Floats, y: Floats) -> Indices:
    """Flat indices [4, N] of the four texels around points, in the order of `four_texels`; the border is repeated."""
    left, top = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
    rows = [np.clip(top + below, 0, shape[0] - 1) * shape[1] for below in (0, 1)]
    columns = [np.clip(left + beside, 0, shape[1] - 1) for beside in (0, 1)]
    return np.stack([row + column for row in rows for column in columns])


def texel_bounds(
    test: ShadowTest, image: Range, texels: Indices, points: tuple[Floats, Floats, Floats], lit: Mask
) -> tuple[Ints, Ints]:
    """The least and the greatest value of every texel, flat [Hp * Wp], less one step as in the test, if all texels that
    may be empty are emptied.

    A point stays lit if all its texels are at most the gap before it. That bounds from below only, so it is tried for
    every lit point first, also where texels are empty; but texels that shade another point are bounded from above, too.
    Where the two bounds conflict, a lit point keeps its texels as they are, which bounds them from above, and other lit
    points may conflict with that in turn.
    """
    ranges = (image.ravel().take(texels) - np.uint16(1)).astype(np.int32)  # 0, empty, wraps round to `_EMPTY`
    away = np.minimum(points[2] - np.float32(1), FARTHEST_STEPS)
    enough = np.ceil(away).astype(np.int32) - int(test.gap_steps) + _MARGIN
    lowest, highest = np.zeros(image.size, np.int32), np.full(image.size, _EMPTY, np.int32)
    hard = np.flatnonzero(~lit | (ranges < enough).any(axis=0))
    read, needed, left = texels.take(hard, axis=1), enough[hard], lit[hard]
    low = np.broadcast_to(needed, read.shape).copy()
    kept = np.flatnonzero(~left)
    near, width = np.zeros(image.size, np.bool_), image.shape[1]
    while len(kept):  # in dozens of rounds where a scene fills the image, most with a few points
        moved, at = read.take(kept, axis=1).ravel(), hard[kept]
        low[:, kept], high = _as_they_are(
            test, ranges.take(at, axis=1), (points[0][at], points[1][at], away[at]), lit[at]
        )
        np.minimum.at(highest, moved, high.ravel())
        # Only points that read a moved texel can conflict: it is their upper left one, or right of or below that.
        marks = np.maximum(np.concatenate([moved - shift for shift in (0, 1, width, width + 1)]), 0)
        near[marks] = True
        asked = np.flatnonzero(near.take(read[0]) & left)
        near[marks] = False
        kept = asked[(highest.take(read.take(asked, axis=1)) < needed[asked]).any(axis=0)]
        left[kept] = False
    np.maximum.at(lowest, read.ravel(), low.ravel())
    easy = np.flatnonzero((highest.take(texels) < _EMPTY).any(axis=0))
    easy = easy[lit[easy] & ~(ranges.take(easy, axis=1) < enough[easy]).any(axis=0)]
    for texel in texels.take(easy, axis=1):
        np.maximum.at(lowest, texel, enough[easy])  # not all four at once: numpy 2.4 would mix up the values
    return lowest, highest


def _as_they_are(test: ShadowTest, ranges: Ints, points: tuple[Floats, Floats, Floats], lit: Mask) -> tuple[Ints, Ints]:
    """Bounds [4, N] around the texels [4, N] of each point that keep its answer. points: x, y, range less one step."""
    gap, edge = int(test.gap_steps), int(test.edge_steps)
    nearest, farthest = ranges.min(axis=0), ranges.max(axis=0)
    limit = np.ceil(points[2]).astype(np.int32) - edge
    # An edge: each texel stays on its side of the limit, and nearest and farthest stay far enough from each other.
    behind = ranges >= limit
    low = np.where(behind, np.minimum(ranges, limit + _MARGIN), 0)
    high = np.where(behind, _EMPTY, np.maximum(ranges, limit - 1 - _MARGIN))
    between = np.clip(limit - 1 - _MARGIN, nearest, np.maximum(farthest - edge, nearest))
    high = np.where(ranges == nearest, np.minimum(high, between), high)
    low = np.where(ranges == farthest, np.maximum(low, between + edge), low)
    # One surface: the four stay one surface, which stays on its side of the point.
    x, y = points[0] - np.floor(points[0]), points[1] - np.floor(points[1])
    upper, lower = ranges[0] + x * (ranges[1] - ranges[0]), ranges[2] + x * (ranges[3] - ranges[2])
    spare = np.abs(upper + y * (lower - upper) - (points[2] - gap)) - _MARGIN
    flat = (edge - 1 - (farthest - nearest)) // 2
    tight = np.minimum(np.maximum(spare, 0).astype(np.int32), flat)
    one = np.flatnonzero(farthest - nearest < edge)
    low[:, one] = (ranges - np.where(lit, tight, flat))[:, one]
    high[:, one] = np.minimum(ranges + np.where(lit, flat, tight), _EMPTY)[:, one]
    # All four so far in front of the point that it is dark by either rule.
    dark = np.flatnonzero(farthest < limit - _MARGIN)
    low[:, dark], high[:, dark] = 0, (limit - 1 - _MARGIN)[dark]
    return low, high


def _simplest(image: Range, lowest: Ints, highest: Ints) -> Range:
    """The multiples of the largest step within the bounds, nearest to the ranges; 0 where the bounds include empty."""
    indices = np.flatnonzero(highest < _EMPTY)
    exact = image.ravel()[indices].astype(np.int32)
    low, high = lowest[indices] + 1, highest[indices] + 1  # stored ranges are one step more than the test's
    chosen, step = exact.copy(), COARSEST_STEP
    missing = np.ones(len(indices), np.bool_)
    while step > 1:
        rounded = np.clip((exact + step // 2) // step * step, -(-low // step) * step, high // step * step)
        fits = missing & (rounded >= low) & (rounded <= high)
        chosen[fits] = rounded[fits]
        missing &= ~fits
        step //= 2
    chosen[missing] = np.clip(exact, low, high)[missing]
    coarse: Range = np.zeros(image.shape, np.uint16)
    coarse.ravel()[indices] = chosen
    return coarse
