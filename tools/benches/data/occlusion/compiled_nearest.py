"""The default's closest baseline, compiled: the nearest texel must not be nearer than the point by over the bias."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.data.occlusion.baselines import Images
from bodyseg_data.artifacts import ShadowTest
from bodyseg_data.artifacts.scratch import scratch_for
from bodyseg_data.artifacts.shadow_loops import find_runs, shadow_of
from bodyseg_data.machine import compiled
from bodyseg_data.samples import FARTHEST_STEPS

_NONE: Final = np.float32(0)
_HALF: Final = np.float32(0.5)
_ONE: Final = np.float32(1)
_kernel = partial(compiled, feature="bench occlusion")


@_kernel
def nearest_image(shadow: Any, slopes: Any, bias: Any, scratch: Any, points: Any, lit_mask: Any) -> None:
    """Write into `lit_mask`, flat, whether each pixel is lit; bias: float32, in steps; points: as `_points` gives."""
    camera_range, projector_range = shadow.camera_range, shadow.projector_range
    edges = scratch.edges
    offset_x, offset_y, offset_z = shadow.projection[0, 0], shadow.projection[1, 0], shadow.projection[2, 0]
    across, down, forward = slopes[0], slopes[1], slopes[2]
    x, y, away, start, marks = points
    runs = find_runs(camera_range, scratch.changes, edges)
    count: Any = np.uint64(0)
    for run in range(np.uint64(runs)):
        first = np.uint64(edges[np.uint64(2) * run])
        length = np.uint64(edges[np.uint64(2) * run + np.uint64(1)]) - first
        for i in range(length):
            away[count + i] = np.float32(camera_range[first + i]) * forward[first + i] + offset_z
        for i in range(length):
            x[count + i] = (np.float32(camera_range[first + i]) * across[first + i] + offset_x) / away[count + i]
        for i in range(length):
            y[count + i] = (np.float32(camera_range[first + i]) * down[first + i] + offset_y) / away[count + i]
        for i in range(length):
            marks[count + i] = shadow.facing[first + i]
        count += length
    last_x, last_y = np.float32(shadow.columns) - _HALF, np.float32(shadow.rows) - _HALF
    for point in range(count):
        inside = (away[point] > _NONE) & (x[point] >= -_HALF) & (x[point] < last_x)
        inside &= (y[point] >= -_HALF) & (y[point] < last_y)
        column = min(np.int32(x[point] + _HALF), np.int32(shadow.columns - 1)) if inside else np.int32(0)
        row = min(np.int32(y[point] + _HALF), np.int32(shadow.rows - 1)) if inside else np.int32(0)
        start[point] = row * np.int32(shadow.columns) + column
        marks[point] &= np.uint8(inside)
    for point in range(count):
        # One step off, an empty texel wraps round to 65535, which is behind every point, as it should be.
        texel = np.float32(np.uint16(projector_range[np.uint64(start[point])] - np.uint16(1)))
        marks[point] &= np.uint8(texel >= min(away[point] - _ONE, FARTHEST_STEPS) - bias)
    lit_mask[:] = False
    index: Any = np.uint64(0)
    for run in range(np.uint64(runs)):
        for pixel in range(edges[np.uint64(2) * run], edges[np.uint64(2) * run + np.uint64(1)]):
            lit_mask[pixel] = marks[index] != 0
            index += np.uint64(1)


@lru_cache(maxsize=2)
def _points(pixels: int) -> tuple[NDArray[Any], ...]:
    """Memory for x, y, range, texel and mark of as many points, kept from view to view, as the loader keeps its own."""
    return tuple(np.empty(pixels, kind) for kind in (np.float32, np.float32, np.float32, np.int32, np.uint8))


def lit(test: ShadowTest, images: Images, texels: NDArray[np.int32], bias_mm: float) -> NDArray[np.bool_]:
    """The mask, bool [H, W], as the NumPy form of the rule with the facing bit gives it; texels: as of `shadow_of`."""
    shadow = shadow_of(test, *images, texels)
    lit_mask = np.empty(images[0].shape, np.bool_)
    scratch, points = scratch_for(images[0].size, *images[1].shape), _points(images[0].size)
    bias = np.float32(round(bias_mm / 1000 / test.rig.range_step_m))
    nearest_image(shadow, test.slopes, bias, scratch, points, lit_mask.ravel())
    return lit_mask
