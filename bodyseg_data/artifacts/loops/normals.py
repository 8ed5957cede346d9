"""Standard normals from random words, compiled: the bits of `noise.normals`."""

from __future__ import annotations

from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.constants import FIRST_SEGMENT, OFFSET_MASK, SEGMENT_SHIFT, SEGMENTS
from bodyseg_data.artifacts.loops.philox import raw_words
from bodyseg_data.artifacts.loops.scratch import CHUNK
from bodyseg_data.core.kernels import compiled
from bodyseg_data.core.randomness import Stream

_HALF: Final = np.float32(0.5)
_kernel = partial(compiled, feature="the compiled form of the artifacts")


@_kernel
def draw_normals(halves: Any, count: Any, segments: Any, segment_of: Any, normals: Any) -> None:
    """As `noise.normals`; segment_of: int32, room for as many."""
    for point in range(np.uint64(count)):
        quantile = np.float32(np.int32(halves[point] & np.uint32(0x7FFFFFFF))) + _HALF
        bits = np.float32(quantile).view(np.int32)
        segment_of[point] = np.int32(bits >> SEGMENT_SHIFT) - np.int32(FIRST_SEGMENT)
        normals[point] = np.float32(bits & np.int32(OFFSET_MASK))
    constant, linear, bend = segments[0], segments[1], segments[2]
    for point in range(np.uint64(count)):
        segment, along = np.uint64(segment_of[point]), normals[point]
        size = constant[segment] + along * (linear[segment] + along * bend[segment])
        normals[point] = size if halves[point] >> np.uint32(31) else -size


@_kernel
def _fill(key_0: Any, key_1: Any, segments: Any, words: Any, segment_of: Any, normals: Any) -> None:
    """Draw as many normals as the array has room for; words, segment_of: room for those of a chunk."""
    halves = words.view(np.uint32)
    first: Any = np.int64(0)
    while first < normals.size:
        count = min(np.int64(CHUNK), normals.size - first)
        raw_words(key_0, key_1, first // 2, (count + 1) // 2, words)
        draw_normals(halves, count, segments, segment_of, normals[first : first + count])
        first += count


def normals_of(stream: Stream, count: int) -> NDArray[np.float32]:
    """`count` standard normals of a stream, float32 [N], as `noise.normals` makes of its 32-bit draws."""
    drawn = np.empty(count, np.float32)
    _fill(stream[0], stream[1], SEGMENTS, np.empty(CHUNK // 2, np.uint64), np.empty(CHUNK, np.int32), drawn)
    return drawn
