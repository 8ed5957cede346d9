"""Occlusion, noise and missing data in one compiled call, with the bits of their NumPy forms one after the other."""

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene
from bodyseg_data.artifacts.constants import SEGMENTS
from bodyseg_data.artifacts.missing_data import MissingData, threshold
from bodyseg_data.artifacts.noise import Noise, steps_of
from bodyseg_data.artifacts.occlusion import Occlusion, projector_views
from bodyseg_data.artifacts.random_loops import draw_normals, raw_words
from bodyseg_data.artifacts.scratch import BLOCK, CHUNK, constant, copy_unless_same, scratch_for, second_scratch_for
from bodyseg_data.artifacts.shadow_loops import (
    Shadow,
    find_runs,
    forget_occupied,
    mark_lit,
    mark_occupied,
    shadow_of,
    take_pieces,
)
from bodyseg_data.core import Draws
from bodyseg_data.machine import compiled
from bodyseg_data.samples import FARTHEST_STEPS

COVERED: Final[tuple[type[Artifact], ...]] = (Occlusion, Noise, MissingData)
"""The classes of artifacts that the compiled call applies, in its order."""

_NEAREST: Final = np.float32(1)


class Strengths(NamedTuple):
    """The streams of noise and missing data, and how strong they are; steps: sigma; threshold: 0 loses no pixel."""

    noise_0: np.uint64
    noise_1: np.uint64
    steps: np.float32
    missing_0: np.uint64
    missing_1: np.uint64
    threshold: np.uint32


@compiled
def alter(image: Any, labels: Any, found: Any, scratch: Any, losing: Any, noisy: Any, steps: Any) -> None:
    """Leave the kept points of a chunk, with noise if `noisy`, in a flat image, and in its labels if `losing` any."""
    pieces, marks, normals = scratch.pieces, scratch.marks, scratch.floats
    size, piece = np.int64(image.size), np.uint64(0)
    while piece < np.uint64(found):
        first, length, point = np.uint64(pieces[0, piece]), np.uint64(pieces[1, piece]), np.uint64(pieces[3, piece])
        piece += np.uint64(1)
        while piece < np.uint64(found) and np.uint64(pieces[0, piece]) == first + length:
            length += np.uint64(pieces[1, piece])
            piece += np.uint64(1)
        # Whole blocks are quicker to compute; pixels behind the last point keep their values.
        blocks = (np.int64(length) + BLOCK - 1) // BLOCK
        span = np.uint64(min(size - np.int64(first), blocks * BLOCK))
        if noisy:
            for i in range(span):
                before = image[first + i]
                value = np.rint(np.float32(before) + normals[point + i] * steps)
                value = min(max(value, _NEAREST), FARTHEST_STEPS)
                after = np.uint16(np.int32(value)) * np.uint16(marks[point + i])
                image[first + i] = np.uint16(after) if i < length else before
        else:
            for i in range(span):
                before = image[first + i]
                image[first + i] = np.uint16(before * np.uint16(marks[point + i])) if i < length else before
        if losing:
            for i in range(span):
                # Less one, a kept pixel's mark, 1, is 0, and a lost one's, 0, is 255, the label of background.
                lost = np.uint8(marks[point + i] - np.uint8(1))
                labels[first + i] |= lost if i < length else np.uint8(0)


@compiled
def apply(
    camera_range: Any,
    columns: Any,
    shadow: Any,
    strengths: Any,
    noisy: Any,
    segments: Any,
    runs: Any,
    scratch: Any,
    image: Any,
    labels: Any,
    second: Any,
    second_scratch: Any,
) -> None:
    """Apply occlusion, noise if `noisy`, and missing data to a sample's flat range and labels.

    camera_range, columns: the clean range, flat, and the width of the image. shadow: None without occlusion. runs: the
    number of runs of foreground in `edges`, -1 if they are still to be found. second, second_scratch: shadow and
    scratch of a second projector; None without one. The compiler leaves the branches of what is None out.
    """
    if runs < 0:
        runs = find_runs(camera_range, scratch.changes, scratch.edges)
    # Only the shadow test, which bounds the texels of a piece, needs small pieces that lie in one row each.
    width, block, losing = image.size, CHUNK, strengths.threshold > 0
    if shadow is not None:
        width, block, losing = columns, BLOCK, True
        mark_occupied(shadow, scratch)
    if second is not None:
        mark_occupied(second, second_scratch)
    pieces, marks, normals = scratch.pieces, scratch.marks, scratch.floats
    run, taken, row, before = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    while run < runs:
        run, taken, row, found, count = take_pieces(scratch.edges, runs, run, taken, row, width, block, pieces)
        if shadow is not None:
            mark_lit(shadow, found, scratch, marks, None)
        else:
            marks[:count] = 1
        if second is not None:
            mark_lit(second, found, second_scratch, second_scratch.marks, marks)
            for point in range(np.uint64(count)):
                marks[point] |= second_scratch.marks[point]
        if strengths.threshold:
            raw_words(strengths.missing_0, strengths.missing_1, before // 4, (count + 3) // 4, scratch.words)
            for point in range(np.uint64(count)):
                marks[point] &= np.uint8(np.uint32(scratch.quarters[point]) >= strengths.threshold)
        if noisy:
            raw_words(strengths.noise_0, strengths.noise_1, before // 2, (count + 1) // 2, scratch.words)
            draw_normals(scratch.halves, count, segments, scratch.ints, normals)
        alter(image, labels, found, scratch, losing, noisy, strengths.steps)
        before += count
    if shadow is not None:
        forget_occupied(shadow, scratch)
    if second is not None:
        forget_occupied(second, second_scratch)


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
    sample, shadows = scene.sample, list[Shadow]()
    noisy, sigma_mm, rate = False, 0.0, 0.0
    noise = missing = _NO_STREAM
    for artifact in artifacts:
        if type(artifact) is Occlusion:
            views = projector_views(scene.rig, sample)
            shadows = [shadow_of(view.test, sample.range, *view[1:]) for view in views]
        elif type(artifact) is Noise:
            noisy, sigma_mm, noise = True, image.drawn["sigma_mm"], draws.stream("noise")
        else:
            rate, missing = image.drawn["missing_rate"], draws.stream("missing data")
    first, second = (*shadows, None, None)[:2]
    sigma = steps_of(sigma_mm, scene.step_m)
    strengths = Strengths(noise[0], noise[1], sigma, missing[0], missing[1], np.uint32(threshold(rate)))
    scratch = scratch_for(sample.range.size, scene.rig.projector.rows, scene.rig.projector.columns)
    second_scratch = None if second is None else second_scratch_for(scratch, second.rows, second.columns)
    runs = -1
    if sample.edges is not None:
        scratch, runs = scratch._replace(edges=sample.edges), len(sample.edges) // 2
    clean, columns = constant(sample.range), sample.range.shape[1]
    copy_unless_same(sample.range, image.range)
    copy_unless_same(sample.labels, image.labels)
    into = image.range.reshape(-1), image.labels.reshape(-1)
    apply(clean, columns, first, strengths, noisy, SEGMENTS, runs, scratch, *into, second, second_scratch)
