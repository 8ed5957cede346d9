"""All artifacts of a sample in one compiled call: the bits of the NumPy forms, which `variants.py` puts together."""

from __future__ import annotations

from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from bodyseg_data.artifacts.missing_data import threshold
from bodyseg_data.artifacts.noise import FIRST_SEGMENT, PLACE_MASK, SEGMENT_SHIFT, SEGMENTS, steps_of
from bodyseg_data.artifacts.occlusion import ShadowTest
from bodyseg_data.artifacts.occlusion_compiled import Shadow, find_runs, mark_lit, shadow_of
from bodyseg_data.artifacts.philox_compiled import raw_words
from bodyseg_data.artifacts.scratch import constant, copy_unless_same, scratch_for
from bodyseg_data.core.kernels import compiled
from bodyseg_data.core.randomness import Stream
from bodyseg_data.core.sample import Sample

_HALF: Final = np.float32(0.5)
_NEAREST, _FARTHEST = np.float32(1), np.float32(65535)
_kernel = partial(compiled, feature="the compiled form of the artifacts")


class Draws(NamedTuple):
    """The streams of noise and missing data, and how strong they are; steps: sigma; threshold: 0 loses no pixel."""

    noise_0: np.uint64
    noise_1: np.uint64
    steps: np.float32
    missing_0: np.uint64
    missing_1: np.uint64
    threshold: np.uint32


@_kernel
def draw_normals(halves: Any, count: Any, segments: Any, place: Any, normals: Any) -> None:
    """As `noise.normals`; place: int32, room for as many."""
    for point in range(np.uint64(count)):
        quantile = np.float32(np.int32(halves[point] & np.uint32(0x7FFFFFFF))) + _HALF
        bits = np.float32(quantile).view(np.int32)
        place[point] = np.int32(bits >> SEGMENT_SHIFT) - np.int32(FIRST_SEGMENT)
        normals[point] = np.float32(bits & np.int32(PLACE_MASK))
    constant, linear, bend = segments[0], segments[1], segments[2]
    for point in range(np.uint64(count)):
        segment, along = np.uint64(place[point]), normals[point]
        size = constant[segment] + along * (linear[segment] + along * bend[segment])
        normals[point] = size if halves[point] >> np.uint32(31) else -size


@_kernel
def alter(image: Any, labels: Any, runs: Any, scratch: Any, noisy: Any, steps: Any) -> None:
    """Leave the kept foreground, with noise if asked, in a flat image and its labels."""
    edges, marks, normals = scratch.edges, scratch.marks, scratch.floats[0]
    point = np.uint64(0)
    for run in range(np.uint64(runs)):
        first = np.uint64(edges[np.uint64(2) * run])
        length = np.uint64(edges[np.uint64(2) * run + np.uint64(1)]) - first
        if noisy:
            for i in range(length):
                value = np.rint(np.float32(image[first + i]) + normals[point + i] * steps)
                value = min(max(value, _NEAREST), _FARTHEST)
                image[first + i] = np.uint16(np.int32(value)) * np.uint16(marks[point + i])
        else:
            for i in range(length):
                image[first + i] *= np.uint16(marks[point + i])
        for i in range(length):
            # A mark less one is 0 for kept pixels and all bits, which is background, for the others.
            labels[first + i] |= np.uint8(marks[point + i] - np.uint8(1))
        point += length


@_kernel
def apply(
    shadow: Any,
    occluded: Any,
    draws: Any,
    noisy: Any,
    segments: Any,
    runs: Any,
    scratch: Any,
    image: Any,
    labels: Any,
) -> None:
    """Give a sample's flat range and labels occlusion and noise, if asked, and missing data.

    runs: how many of foreground `edges` holds, -1 if they are still to be found.
    """
    if runs < 0:
        runs = find_runs(shadow.camera_range, scratch.changes, scratch.edges)
    count = np.int64(0)
    for run in range(np.uint64(runs)):
        count += scratch.edges[np.uint64(2) * run + np.uint64(1)] - scratch.edges[np.uint64(2) * run]
    if occluded:
        mark_lit(shadow, runs, scratch)
    else:
        scratch.marks[:count] = 1
    if draws.threshold:
        raw_words(draws.missing_0, draws.missing_1, (count + 3) // 4, scratch.words)
        for point in range(np.uint64(count)):
            scratch.marks[point] &= np.uint8(np.uint32(scratch.quarters[point]) >= draws.threshold)
    if noisy:
        raw_words(draws.noise_0, draws.noise_1, (count + 1) // 2, scratch.words)
        draw_normals(scratch.halves, count, segments, scratch.start, scratch.floats[0])
    alter(image, labels, runs, scratch, noisy, draws.steps)


_NO_FACING, _NO_TEXELS = constant(np.zeros(0, np.uint8)), constant(np.zeros(0, np.uint16))
_NO_PLACES: Final = constant(np.zeros(0, np.int32))
_NO_SLOPES: Final = constant(np.zeros(0, np.float32))
_NO_OFFSETS: Final = (np.float32(0),) * 3


def apply_artifacts(sample: Sample, test: ShadowTest | None, streams: tuple[Stream, Stream], made: Any) -> None:
    """Occlusion if there is a test, and the noise and missing data that `made`, a RangeImage, names, into its arrays.

    streams: of noise and missing data. Raises BadSample for a sample that does not fit the test's rig.
    """
    known = sample.known
    if test is not None:
        images = sample.range, sample.occluder_range(), sample.faces_projector
        shadow = shadow_of(test, *images, None if known is None else known.texels)
    else:
        shadow = Shadow(
            constant(sample.range), _NO_FACING, _NO_TEXELS, _NO_PLACES, 0, 0, *(_NO_SLOPES,) * 3, *_NO_OFFSETS
        )
    sigma_mm, rate = made.sigma_mm or 0.0, made.missing_rate or 0.0
    (noise_0, noise_1), (missing_0, missing_1) = streams
    draws = Draws(noise_0, noise_1, steps_of(sigma_mm), missing_0, missing_1, np.uint32(threshold(rate)))
    scratch = scratch_for(sample.range.size, shadow.projector_range.size)
    runs = -1
    if known is not None and known.edges is not None:
        scratch, runs = scratch._replace(edges=known.edges), len(known.edges) // 2
    copy_unless_same(sample.range, made.range)
    copy_unless_same(sample.labels, made.labels)
    apply(
        shadow,
        test is not None,
        draws,
        made.sigma_mm is not None,
        SEGMENTS,
        runs,
        scratch,
        made.range.reshape(-1),
        made.labels.reshape(-1),
    )


def compile_all() -> None:
    """Make or load the machine code, by applying it to one pixel."""
    texel, facing, slope = (constant(np.zeros(1, kind)) for kind in (np.uint16, np.uint8, np.float32))
    shadow = Shadow(texel, facing, texel, _NO_PLACES, 1, 1, slope, slope, slope, *_NO_OFFSETS)
    word = np.uint64(0)
    draws = Draws(word, word, np.float32(0), word, word, np.uint32(0))
    image, labels = np.zeros(1, np.uint16), np.zeros(1, np.uint8)
    apply(shadow, True, draws, True, SEGMENTS, -1, scratch_for(1, 1), image, labels)
