"""The projector's stored range: only texels that can shade a pixel which the camera sees.

The shadow test (`artifacts/occlusion.py`) reads four texels for each camera pixel whose surface faces the projector;
only those are rendered. If none of the four lies in front of the point by more than the gap that the test
allows, the test answers "lit" whether they are there or empty. So a texel is kept only if a pixel reads it that has
such a texel among its four; the test then gives the same bits as from a whole image. What is kept is rounded as far
as no answer changes (`coarsening.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.occlusion import Floats, ShadowTest, framed
from bodyseg_data.core.sample import FARTHEST_STEPS
from bodyseg_data.packing.coarsening import coarsened

_MARGIN: Final = np.float32(1)  # the test interpolates in single precision, which is off by far less than a step

Ranges = Callable[[NDArray[np.intp]], NDArray[np.uint16]]
"""Texels [N], row * columns + column, ascending -> projector ranges, uint16 [N], in steps."""


def occluder_range(
    test: ShadowTest, camera_range: NDArray[np.uint16], faces_projector: NDArray[np.bool_], ranges: Ranges
) -> NDArray[np.uint16]:
    """The projector's range where it shades a view, as coarse as the shadows permit, 0 elsewhere, uint16 [Hp, Wp], in
    steps. The shadow test gives the same bits from it as from the whole exact image. Arguments as `exact_range`'s.
    """
    image, *points = exact_range(test, camera_range, faces_projector, ranges)
    return coarsened(test, image, *points)


def exact_range(
    test: ShadowTest, camera_range: NDArray[np.uint16], faces_projector: NDArray[np.bool_], ranges: Ranges
) -> tuple[NDArray[np.uint16], Floats, Floats, Floats]:
    """The projector's exact range where it can shade, 0 elsewhere, and the points that it may shade (`reached`).

    camera_range: uint16 [H, W], in steps. faces_projector: bool [H, W], False on background. ranges: called once, for
    the texels that the shadow test reads.
    """
    projector = test.rig.projector
    image = np.zeros((projector.rows, projector.columns), np.uint16)
    _, x, y, away = test.project(camera_range, np.flatnonzero(faces_projector))
    width = projector.columns + 2
    start = (np.floor(y).astype(np.int32) + 1) * np.int32(width) + np.floor(x).astype(np.int32) + np.int32(1)
    start = start.astype(np.intp)
    read = np.flatnonzero(_footprint(start, image.shape))
    image.ravel()[read] = ranges(read)

    texels = framed(image).ravel()
    nearest = texels.take(start)
    for shift in (1, width, width + 1):
        np.minimum(nearest, texels[shift:].take(start), out=nearest)
    behind = np.minimum(away - np.float32(1), FARTHEST_STEPS) - nearest
    image[~_footprint(start[behind > test.gap_steps - _MARGIN], image.shape)] = 0
    return image, x, y, away


def _footprint(start: NDArray[np.intp], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """The texels that points read, bool [Hp, Wp]; start: upper left ones, as flat indices into the framed image."""
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
