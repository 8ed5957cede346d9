"""The shadow test of the loader alone, compiled, for a whole image."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts import ShadowTest
from bodyseg_data.artifacts.scratch import BLOCK, scratch_for
from bodyseg_data.artifacts.shadow_loops import (
    find_runs,
    forget_occupied,
    mark_lit,
    mark_occupied,
    shadow_of,
    take_pieces,
)
from bodyseg_data.machine import compiled

_kernel = partial(compiled, feature="bench occlusion")


@_kernel
def lit_image(shadow: Any, scratch: Any, answer: Any) -> None:
    """Mark the pixels that are lit in `answer`, flat."""
    runs = find_runs(shadow.camera_range, scratch.changes, scratch.edges)
    mark_occupied(shadow, scratch)
    answer[:] = False
    run, taken, row = np.int64(0), np.int64(0), np.int64(0)
    pieces = scratch.pieces
    while run < runs:
        run, taken, row, found, _ = take_pieces(scratch.edges, runs, run, taken, row, shadow.width, BLOCK, pieces)
        mark_lit(shadow, found, scratch, scratch.marks, None)
        for piece in range(np.uint64(found)):
            first, point = np.uint64(pieces[0, piece]), np.uint64(pieces[3, piece])
            for i in range(np.uint64(pieces[1, piece])):
                answer[first + i] = scratch.marks[point + i] != 0
    forget_occupied(shadow, scratch)


def lit(
    test: ShadowTest,
    camera_range: NDArray[np.uint16],
    projector_range: NDArray[np.uint16],
    faces_projector: NDArray[np.bool_],
    texels: NDArray[np.int32] | None = None,
) -> NDArray[np.bool_]:
    """As `ShadowTest.lit`, with the same bits and errors; texels: as of `shadow_of`."""
    shadow = shadow_of(test, camera_range, projector_range, faces_projector, texels)
    answer = np.empty(camera_range.shape, np.bool_)
    lit_image(shadow, scratch_for(camera_range.size, *projector_range.shape), answer.ravel())
    return answer
