"""Pixels lost together, as sensors lose them: whole patches, stripes, and surfaces seen at grazing angles.

Missing data as in the paper (`missing_data.py`) is lost pixel by pixel. Here neighbouring pixels are lost: dark cloth
that returns no light, bands of a body that moved between two fringe patterns, and flanks that lie almost along the
camera's ray. Each function loses exactly the given share, to the nearest pixel, and a larger share of the same image
and draws loses the same pixels and more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from importlib import import_module
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene
from bodyseg_data.artifacts.surface import Box, box_of, slants
from bodyseg_data.core.errors import BadConfig, bounded, check_fields
from bodyseg_data.core.kernels import use_compiled
from bodyseg_data.core.randomness import Draws, units
from bodyseg_data.core.rig import Camera

SHAPES: Final = ("patches", "stripes", "grazing")

MOST_PATCHES: Final = 4
LONGEST: Final = 2.0
"""How many times as long as wide a patch may be, or as wide as long."""
FEWEST_STRIPES: Final = 2
MOST_STRIPES: Final = 12


@dataclass(frozen=True)
class Losses(Artifact):
    """Patches, stripes, grazing surfaces or nothing lost, each as likely; the paper has none of it.

    most: the largest share of the foreground that is lost; each image's share is uniform from 0 to it.
    """

    name = "losses"
    kind = "missing_data"
    purposes = ("losses",)

    most: float = bounded(0.0, 0, 1)

    def __post_init__(self) -> None:
        check_fields(self)

    def lost(
        self, range_image: NDArray[np.uint16], camera: Camera, generator: np.random.Generator
    ) -> NDArray[np.bool_]:
        """Mark the pixels that one image loses, bool [H, W].

        range_image: the clean one, uint16 [H, W], 0 is background. camera: the one that sees it. generator: draws the
        shape, the share and the positions. Raises BadConfig for an image that is not the camera's.
        """
        chances = units(generator, 2)
        shapes, share = (None, *SHAPES), self.most * float(chances[1])
        shape = shapes[int(chances[0] * len(shapes))]
        if shape is None:
            return np.zeros(range_image.shape, np.bool_)
        return lost(shape, range_image, share, camera, generator)

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        """As `Artifact.apply`. Raises BadConfig for a sample that is not the rig's."""
        image.range[self.lost(scene.sample.range, scene.rig.camera, draws.generator("losses"))] = 0


def lost(
    shape: str, range_image: NDArray[np.uint16], share: float, camera: Camera, generator: np.random.Generator
) -> NDArray[np.bool_]:
    """Mark the pixels lost in one of `SHAPES`, bool [H, W]; other arguments as of `lost_patches` and `lost_grazing`."""
    if shape == "patches":
        return lost_patches(range_image, share, generator)
    if shape == "stripes":
        return lost_stripes(range_image, share, generator)
    if shape == "grazing":
        return lost_grazing(range_image, share, camera)
    raise BadConfig(f"pixels are lost in one of {', '.join(SHAPES)}, found {shape!r}")


def lost_patches(range_image: NDArray[np.uint16], share: float, generator: np.random.Generator) -> NDArray[np.bool_]:
    """Mark one to four ellipses around random pixels of the foreground, lost whole, bool [H, W].

    range_image: uint16 [H, W], 0 is background. share: of the foreground, 0 to 1; the ellipses grow together until
    they hold it. Raises BadConfig for another share.
    """
    _check_share(share)
    box = box_of(range_image)
    if box is None:
        return np.zeros(range_image.shape, np.bool_)
    inside = range_image[box]
    pixels = np.flatnonzero(inside != 0)  # of bools: five times faster
    count, *chances = units(generator, 1 + 3 * MOST_PATCHES)
    down, along = [], []
    for centre, length, size in np.reshape(chances, (MOST_PATCHES, 3))[: 1 + int(count * MOST_PATCHES)]:
        row, column = divmod(int(pixels[int(centre * len(pixels))]), inside.shape[1])
        half = np.exp2(size) * LONGEST ** (length - 0.5)  # of its height; its width is the other way round
        other = np.exp2(size) / LONGEST ** (length - 0.5)
        down.append((((np.arange(inside.shape[0]) - row) / half) ** 2).astype(np.float32))
        along.append((((np.arange(inside.shape[1]) - column) / other) ** 2).astype(np.float32))
    return _lose_first(range_image.shape, box, pixels, _least_sums(pixels, down, along), share)


def _least_sums(
    pixels: NDArray[np.intp], down: Sequence[NDArray[np.float32]], along: Sequence[NDArray[np.float32]]
) -> NDArray[np.float32]:
    """The least sum at each pixel, [N], of a `down` [h] at its row and of the `along` [w] at its column."""
    if use_compiled():
        values = np.empty(len(pixels), np.float32)
        _loops().least_sums(pixels, len(along[0]), np.stack(down), np.stack(along), values)
        return values
    sums = (rows[:, None] + columns for rows, columns in zip(down, along, strict=True))
    least: NDArray[np.float32] = reduce(np.minimum, sums)
    return least.ravel()[pixels]


def lost_stripes(range_image: NDArray[np.uint16], share: float, generator: np.random.Generator) -> NDArray[np.bool_]:
    """Mark two to twelve horizontal bands of one width, evenly over the foreground's height, lost whole, bool [H, W].

    As `lost_patches`; of a row that is lost in part, pixels are lost from the left.
    """
    _check_share(share)
    lost = np.zeros(range_image.shape, np.bool_)
    box = box_of(range_image)
    if box is None:
        return lost
    inside = range_image[box] != 0
    chances = units(generator, 2)
    stripes = FEWEST_STRIPES + int(chances[0] * (MOST_STRIPES - FEWEST_STRIPES + 1))
    rows = np.arange(inside.shape[0])
    from_middle = np.abs((rows * stripes / inside.shape[0] + chances[1]) % 1 - 0.5)
    order = np.argsort(from_middle, kind="stable")
    pixels = inside.sum(axis=1)[order]
    left = _rounded(share, int(pixels.sum()))
    before = np.cumsum(pixels) - pixels
    whole = before + pixels <= left
    gone = lost[box]
    gone[order[whole]] = inside[order[whole]]
    if not whole.all():
        last = int(np.argmin(whole))
        gone[order[last], np.flatnonzero(inside[order[last]])[: left - int(before[last])]] = True
    return lost


def lost_grazing(range_image: NDArray[np.uint16], share: float, camera: Camera) -> NDArray[np.bool_]:
    """Mark the pixels whose surface lies most nearly along the camera's ray, bool [H, W]; see `slants`.

    As `lost_patches`. Raises BadConfig as well for an image that is not the camera's.
    """
    _check_share(share)
    if range_image.shape != (camera.rows, camera.columns):
        raise BadConfig(
            f"a range image must be as large as its camera's, {camera.rows} x {camera.columns}, "
            f"found {' x '.join(map(str, range_image.shape))}"
        )
    box = box_of(range_image)
    if box is None:
        return np.zeros(range_image.shape, np.bool_)
    pixels = np.flatnonzero(range_image[box] != 0)
    order = -slants(range_image, camera, box)
    return _lose_first(range_image.shape, box, pixels, order.ravel()[pixels], share)


def _lose_first(
    shape: tuple[int, ...], box: Box, pixels: NDArray[np.intp], values: NDArray[np.float32], share: float
) -> NDArray[np.bool_]:
    """Mark the share of the foreground with the lowest values, bool [H, W]; of equal pixels the first ones.

    pixels: those of the foreground, flat indices in the box, [N]; values: of each.
    """
    lost = np.zeros(shape, np.bool_)
    count = _rounded(share, len(pixels))
    if count:
        limit = np.partition(values, count - 1)[count - 1]
        if use_compiled():
            _loops().mark_below(pixels, values, limit, count, lost[box])
            return lost
        gone = values < limit
        gone[np.flatnonzero(values == limit)[: count - np.count_nonzero(gone)]] = True
        rows, columns = np.divmod(pixels[gone], lost[box].shape[1])
        lost[box][rows, columns] = True
    return lost


def _rounded(share: float, pixels: int) -> int:
    return math.floor(share * pixels + 0.5)


def _loops() -> Any:
    """The compiled forms; they load numba, so not before they are used."""
    return import_module("bodyseg_data.artifacts.loops.lost_pixels")


def _check_share(share: float) -> None:
    if not 0 <= share <= 1:
        raise BadConfig(f"the share of lost pixels must be from 0 to 1, found {share}")
