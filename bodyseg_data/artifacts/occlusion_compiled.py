"""The shadow test compiled with numba: the operations of `occlusion.py` in the same order, so the same bits.

Passes over lists of foreground pixels, each so plain that the compiler makes it many pixels wide. Indices are
unsigned, so that no code is made for those that count from the end.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.occlusion import ShadowTest
from bodyseg_data.artifacts.scratch import constant, scratch_for
from bodyseg_data.core.kernels import compiled
from bodyseg_data.core.sample import FARTHEST_STEPS

_NONE: Final = np.float32(0)
_HALF: Final = np.float32(0.5)
_ONE: Final = np.float32(1)
_kernel = partial(compiled, feature="the compiled form of the artifacts")


class Shadow(NamedTuple):
    """The input of `mark_lit`: flat constant arrays, and the rig's constants."""

    camera_range: NDArray[np.uint16]
    facing: NDArray[np.uint8]
    projector_range: NDArray[np.uint16]
    texels: NDArray[np.int32]
    rows: int
    columns: int
    across: NDArray[np.float32]
    down: NDArray[np.float32]
    forward: NDArray[np.float32]
    offset_x: np.float32
    offset_y: np.float32
    offset_z: np.float32
    gap_steps: np.float32
    edge_steps: np.float32


@_kernel
def find_runs(camera_range: Any, changes: Any, edges: Any) -> Any:
    """Find where foreground begins, ends, begins ... in reading order, into `edges`; returns the number of runs.

    changes: zeros behind the image.
    """
    size = np.uint64(camera_range.size)
    changes[0] = camera_range[0] != 0
    for pixel in range(np.uint64(1), size):
        changes[pixel] = (camera_range[pixel] != 0) != (camera_range[pixel - np.uint64(1)] != 0)
    words = changes.view(np.uint64)  # most of the image is alike: look at eight pixels at once
    count: Any = 0
    for word in range(np.uint64(words.size)):
        if words[word] != 0:
            for offset in range(np.uint64(8)):
                edges[count] = word * np.uint64(8) + offset
                count += np.int64(changes[word * np.uint64(8) + offset])
    if camera_range[size - np.uint64(1)] != 0:
        edges[count] = size
        count += 1
    return count // 2


@_kernel
def find_texels(x: Any, y: Any, away: Any, count: Any, rows: Any, columns: Any, marks: Any, start: Any) -> None:
    """The texel to the upper left of each point, moved into the image; points outside the frame lose their mark."""
    last_x, last_y = np.float32(columns) - _HALF, np.float32(rows) - _HALF
    for point in range(np.uint64(count)):
        inside = (away[point] > _NONE) & (x[point] >= -_HALF) & (x[point] < last_x)
        inside &= (y[point] >= -_HALF) & (y[point] < last_y)
        left = np.int32(max(np.floor(x[point]), _NONE)) if inside else np.int32(0)
        top = np.int32(max(np.floor(y[point]), _NONE)) if inside else np.int32(0)
        start[point] = top * np.int32(columns) + left
        marks[point] &= np.uint8(inside)


@_kernel
def mark_near(texels: Any, columns: Any, mark: Any, near: Any) -> None:
    """Set `near` to `mark` where one of the four texels that begin here holds anything: elsewhere all points are lit.

    texels: flat indices of those that do. To the left of the first column is the last one of the row above, where
    points are then looked at in vain.
    """
    width: Any = np.int64(columns)
    for i in range(np.uint64(texels.size)):
        texel: Any = np.int64(texels[i])
        near[np.uint64(texel)] = mark
        near[np.uint64(max(texel - 1, 0))] = mark
        near[np.uint64(max(texel - width, 0))] = mark
        near[np.uint64(max(texel - width - 1, 0))] = mark


@_kernel
def read_texels(
    projector_range: Any, rows: Any, columns: Any, start: Any, candidates: Any, hits: Any, floats: Any
) -> None:
    """Move the candidates to the front of `floats` 0 to 2 and write their four texels, less one step, into 3 to 6."""
    x, y, away, a, b, c, d = floats[0], floats[1], floats[2], floats[3], floats[4], floats[5], floats[6]
    last_x, last_y = np.float32(columns - 1), np.float32(rows - 1)
    for hit in range(np.uint64(hits)):
        point = np.uint64(candidates[hit])
        x[hit], y[hit], away[hit] = x[point], y[point], away[point]
        # Beyond the border, the texel beside is the same one.
        right = np.uint64((x[point] >= _NONE) & (x[point] < last_x))
        below = np.uint64(columns if (y[point] >= _NONE) & (y[point] < last_y) else 0)
        texel = np.uint64(start[point])
        # One step off, an empty texel wraps round to 65535, which is behind every point, as it should be.
        a[hit] = np.float32(np.uint16(projector_range[texel] - np.uint16(1)))
        b[hit] = np.float32(np.uint16(projector_range[texel + right] - np.uint16(1)))
        c[hit] = np.float32(np.uint16(projector_range[texel + below] - np.uint16(1)))
        d[hit] = np.float32(np.uint16(projector_range[texel + below + right] - np.uint16(1)))


@_kernel
def decide(floats: Any, hits: Any, gap_steps: Any, edge_steps: Any) -> None:
    """Write 1 into `floats` 0 where light gets to, else 0."""
    for hit in range(np.uint64(hits)):
        a, b, c, d = floats[3, hit], floats[4, hit], floats[5, hit], floats[6, hit]
        along, below = floats[0, hit] - np.floor(floats[0, hit]), floats[1, hit] - np.floor(floats[1, hit])
        away = min(floats[2, hit] - _ONE, FARTHEST_STEPS)
        upper, lower = a + along * (b - a), c + along * (d - c)
        surface = away - (upper + below * (lower - upper)) <= gap_steps
        limit = away - edge_steps
        votes = (_ONE - below) * (_ONE - along) if a >= limit else _NONE
        votes += (_ONE - below) * along if b >= limit else _NONE
        votes += below * (_ONE - along) if c >= limit else _NONE
        votes += below * along if d >= limit else _NONE
        torn = max(max(a, b), max(c, d)) - min(min(a, b), min(c, d)) >= edge_steps
        floats[0, hit] = _ONE if (votes >= _HALF if torn else surface) else _NONE


@_kernel
def mark_lit(shadow: Any, runs: Any, scratch: Any) -> Any:
    """Set `marks` to 1 for lit foreground pixels and to 0 for the others, in reading order; returns their number."""
    camera_range, projector_range, rows, columns = (
        shadow.camera_range,
        shadow.projector_range,
        shadow.rows,
        shadow.columns,
    )
    across, down, forward = shadow.across, shadow.down, shadow.forward
    edges, marks, near, start = scratch.edges, scratch.marks, scratch.near, scratch.start
    candidates, floats = scratch.candidates, scratch.floats
    x, y, away = floats[0], floats[1], floats[2]
    count = np.uint64(0)
    for run in range(np.uint64(runs)):
        first = np.uint64(edges[np.uint64(2) * run])
        length = np.uint64(edges[np.uint64(2) * run + np.uint64(1)]) - first
        for i in range(length):
            away[count + i] = np.float32(camera_range[first + i]) * forward[first + i] + shadow.offset_z
        for i in range(length):
            x[count + i] = (np.float32(camera_range[first + i]) * across[first + i] + shadow.offset_x) / away[count + i]
        for i in range(length):
            y[count + i] = (np.float32(camera_range[first + i]) * down[first + i] + shadow.offset_y) / away[count + i]
        for i in range(length):
            marks[count + i] = shadow.facing[first + i]
        count += length
    find_texels(x, y, away, count, rows, columns, marks, start)
    mark_near(shadow.texels, columns, np.uint8(1), near)
    hits = np.uint64(0)
    for point in range(count):
        candidates[hits] = point
        hits += np.uint64(near[np.uint64(start[point])] & marks[point])
    mark_near(shadow.texels, columns, np.uint8(0), near)
    read_texels(projector_range, rows, columns, start, candidates, hits, floats)
    decide(floats, hits, shadow.gap_steps, shadow.edge_steps)
    for hit in range(hits):
        marks[np.uint64(candidates[hit])] = np.uint8(floats[0, hit])
    return count


@_kernel
def lit_image(shadow: Any, scratch: Any, answer: Any) -> None:
    """Mark the pixels that are lit in `answer`, flat."""
    runs = find_runs(shadow.camera_range, scratch.changes, scratch.edges)
    mark_lit(shadow, runs, scratch)
    answer[:] = False
    point = np.uint64(0)
    for run in range(np.uint64(runs)):
        for pixel in range(scratch.edges[np.uint64(2) * run], scratch.edges[np.uint64(2) * run + np.uint64(1)]):
            answer[pixel] = scratch.marks[point] != 0
            point += np.uint64(1)


def shadow_of(
    test: ShadowTest,
    camera_range: NDArray[np.uint16],
    projector_range: NDArray[np.uint16],
    faces_projector: NDArray[np.bool_],
    texels: NDArray[np.int32] | None = None,
) -> Shadow:
    """Check and gather the input of the compiled test, which checks no length itself.

    Raises BadSample as `ShadowTest.lit`. texels: flat indices of those that hold anything, if they are known.
    """
    test.check(camera_range, projector_range, faces_projector)
    frame = test.rig.projector.rows, test.rig.projector.columns
    if texels is None:
        texels = np.flatnonzero(projector_range).astype(np.int32)
    images = constant(camera_range), constant(faces_projector.view(np.uint8)), constant(projector_range)
    across, down, forward = (constant(slope) for slope in test.slopes)
    return Shadow(
        *images, constant(texels), *frame, across, down, forward, *test.offsets, test.gap_steps, test.edge_steps
    )


def lit(
    test: ShadowTest,
    camera_range: NDArray[np.uint16],
    projector_range: NDArray[np.uint16],
    faces_projector: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """As `ShadowTest.lit`."""
    shadow = shadow_of(test, camera_range, projector_range, faces_projector)
    answer = np.empty(camera_range.shape, np.bool_)
    lit_image(shadow, scratch_for(camera_range.size, projector_range.size), answer.ravel())
    return answer
