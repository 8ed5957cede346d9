"""Occlusion, noise and missing data in one compiled call, with the bits of their NumPy forms one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene
from bodyseg_data.artifacts.missing_data import MissingData, threshold
from bodyseg_data.artifacts.noise import FIRST_SEGMENT, OFFSET_MASK, SEGMENT_SHIFT, SEGMENTS, Noise, steps_of
from bodyseg_data.artifacts.occlusion import Occlusion, shadow_test
from bodyseg_data.artifacts.occlusion_compiled import Shadow, find_runs, mark_lit, shadow_of
from bodyseg_data.artifacts.philox_compiled import raw_words
from bodyseg_data.artifacts.scratch import constant, copy_unless_same, scratch_for
from bodyseg_data.core.kernels import compiled
from bodyseg_data.core.randomness import Draws
from bodyseg_data.core.sample import FARTHEST_STEPS

COVERED: Final[tuple[type[Artifact], ...]] = (Occlusion, Noise, MissingData)
"""The classes of artifacts that the compiled call applies, in its order."""

_HALF: Final = np.float32(0.5)
_NEAREST: Final = np.float32(1)
_kernel = partial(compiled, feature="the compiled form of the artifacts")


class Strengths(NamedTuple):
    """The streams of noise and missing data, and how strong they are; steps: sigma; threshold: 0 loses no pixel."""

    noise_0: np.uint64
    noise_1: np.uint64
    steps: np.float32
    missing_0: np.uint64
    missing_1: np.uint64
    threshold: np.uint32


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
def alter(image: Any, labels: Any, runs: Any, scratch: Any, noisy: Any, steps: Any) -> None:
    """Leave the kept foreground, with noise if `noisy`, in a flat image and its labels."""
    edges, marks, normals = scratch.edges, scratch.marks, scratch.floats[0]
    point = np.uint64(0)
    for run in range(np.uint64(runs)):
        first = np.uint64(edges[np.uint64(2) * run])
        length = np.uint64(edges[np.uint64(2) * run + np.uint64(1)]) - first
        if noisy:
            for i in range(length):
                value = np.rint(np.float32(image[first + i]) + normals[point + i] * steps)
                value = min(max(value, _NEAREST), FARTHEST_STEPS)
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
    strengths: Any,
    noisy: Any,
    segments: Any,
    runs: Any,
    scratch: Any,
    image: Any,
    labels: Any,
) -> None:
    """Apply occlusion if `occluded`, noise if `noisy`, and missing data to a sample's flat range and labels.

    runs: the number of runs of foreground in `edges`, -1 if they are still to be found.
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
    if strengths.threshold:
        raw_words(strengths.missing_0, strengths.missing_1, (count + 3) // 4, scratch.words)
        for point in range(np.uint64(count)):
            scratch.marks[point] &= np.uint8(np.uint32(scratch.quarters[point]) >= strengths.threshold)
    if noisy:
        raw_words(strengths.noise_0, strengths.noise_1, (count + 1) // 2, scratch.words)
        draw_normals(scratch.halves, count, segments, scratch.start, scratch.floats[0])
    alter(image, labels, runs, scratch, noisy, strengths.steps)


_NO_FACING, _NO_TEXELS = constant(np.zeros(0, np.uint8)), constant(np.zeros(0, np.uint16))
_NO_INDICES: Final = constant(np.zeros(0, np.int32))
_NO_SLOPES: Final = constant(np.zeros(0, np.float32))
_NO_NUMBERS: Final = (np.float32(0),) * 5
_NO_STREAM: Final = constant(np.zeros(2, np.uint64))


def covered(artifacts: Sequence[Artifact]) -> int:
    """The number of artifacts, from the first on, that `apply_covered` may apply: some of `COVERED`, in that order.

    An object of a subclass is not covered: it may do something else.
    """
    order = [COVERED.index(type(artifact)) if type(artifact) in COVERED else -1 for artifact in artifacts]
    count = 0
    while count < len(order) and order[count] > max(order[:count], default=-1):
        count += 1
    return count


def apply_covered(artifacts: Sequence[Artifact], image: RangeImage, scene: Scene, draws: Draws) -> None:
    """Write a clean sample, altered by artifacts that `covered` counts, into the image's arrays, whatever they hold.

    They may be the sample's own. Raises BadSample for a sample that does not fit the shadow test of the rig.
    """
    sample = scene.sample
    occupancy = sample.occupancy
    occluded = noisy = False
    sigma_mm = rate = 0.0
    noise = missing = _NO_STREAM
    for artifact in artifacts:
        if type(artifact) is Occlusion:
            occluded = True
        elif type(artifact) is Noise:
            noisy, sigma_mm, noise = True, image.drawn["sigma_mm"], draws.stream("noise")
        else:
            rate, missing = image.drawn["missing_rate"], draws.stream("missing data")
    if occluded:
        images = sample.range, sample.occluder_range(), sample.faces_projector
        shadow = shadow_of(shadow_test(scene.rig), *images, None if occupancy is None else occupancy.texels)
    else:
        shadow = Shadow(
            constant(sample.range), _NO_FACING, _NO_TEXELS, _NO_INDICES, 0, 0, *(_NO_SLOPES,) * 3, *_NO_NUMBERS
        )
    strengths = Strengths(noise[0], noise[1], steps_of(sigma_mm), missing[0], missing[1], np.uint32(threshold(rate)))
    scratch = scratch_for(sample.range.size, shadow.projector_range.size)
    runs = -1
    if occupancy is not None and occupancy.edges is not None:
        scratch, runs = scratch._replace(edges=occupancy.edges), len(occupancy.edges) // 2
    copy_unless_same(sample.range, image.range)
    copy_unless_same(sample.labels, image.labels)
    apply(
        shadow, occluded, strengths, noisy, SEGMENTS, runs, scratch, image.range.reshape(-1), image.labels.reshape(-1)
    )


def compile_all() -> None:
    """Compile the loops, or load their machine code, by applying them to one pixel."""
    texel, facing, slope = (constant(np.zeros(1, kind)) for kind in (np.uint16, np.uint8, np.float32))
    shadow = Shadow(texel, facing, texel, _NO_INDICES, 1, 1, slope, slope, slope, *_NO_NUMBERS)
    word = np.uint64(0)
    strengths = Strengths(word, word, np.float32(0), word, word, np.uint32(0))
    image, labels = np.zeros(1, np.uint16), np.zeros(1, np.uint8)
    apply(shadow, True, strengths, True, SEGMENTS, -1, scratch_for(1, 1), image, labels)
