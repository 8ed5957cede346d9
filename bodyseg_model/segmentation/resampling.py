"""A body in one camera's frame -> the same body as the camera that the network knows would see it, and labels back.

That camera aims at the body from a fixed distance. So, first, the view is turned about the vertical axis towards the
body, as if the frame's camera had been turned where it stands: what it sees stays the same. Then the view is scaled: to
a camera of focal length f, what stands at range Z has f / Z pixels a metre, and the body's middle gets as many as it
has for the known camera at the known distance. Both are exact where only focal length and direction differ; where
distances differ, a body keeps the perspective that it was seen in. Ranges are picked, never blended: between a body and
what is behind it there is nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.rig import Camera, Rig
from bodyseg_data.core.sample import RANGE_STEP_M

LARGEST_SIDE: Final = 2048
"""Pixels of a view along one side: 6.7 m to the paper's rig."""

MARGIN: Final = 64
"""Empty pixels at least that a view has around its body, so that a network sees where the body ends."""

Floats = NDArray[np.float64]

_RANGES_M: Final = (RANGE_STEP_M, 65535 * RANGE_STEP_M)


@dataclass(frozen=True)
class BodyView:
    """One body as the known camera would see it from its stand-off.

    range_m: float32 [h, w], metres, 0 where nothing was measured: as large as that camera's image, or larger where the
    body needs it, and with the body in the middle. corner: its first row and column in that image, which may be
    negative. places: int64 [N], for every pixel of the body in the frame the pixel of the view that holds its centre,
    row * w + column; nothing is missing there. turn_rad: how far the view is turned to the frame's right. middle_m: the
    median range after the turn, which becomes the stand-off. scale: view pixels a frame pixel, where the frame's axis
    was.
    """

    range_m: NDArray[np.float32]
    corner: tuple[int, int]
    places: NDArray[np.intp]
    turn_rad: float
    middle_m: float
    scale: float

    def back(self, image: NDArray[Any]) -> NDArray[Any]:
        """What an image [h, w] of this view has at every pixel of the body in the frame, [N]."""
        return image.ravel()[self.places]


def view_body(
    range_m: NDArray[np.float32],
    pixels: NDArray[np.intp],
    camera: Camera,
    rig: Rig,
    mirrored: bool = False,
    turn_rad: float | None = None,
) -> BodyView:
    """One body of a frame as `rig.camera` would see it at `rig.stand_off_m`.

    range_m: [H, W], metres, taken by `camera`, whose poses do not matter. pixels: the body's, int64 [N], at least one,
    row * W + column, ascending; ranges there are not 0. mirrored: whether the frame shows left for right.
    turn_rad: how far to turn, at most 1.5 either way; None turns to the middle of the body's outline.

    A pixel of the view has the range of the frame's pixel in which its centre falls. If that is not the body's but
    centres of the body's pixels fall in the view's, it has the range of the nearest of those: where the view is
    coarser, nothing thin is lost. Raises BadConfig if the view would be larger than `LARGEST_SIDE`.
    """
    rows, columns = np.divmod(pixels, range_m.shape[1])
    depths = range_m.ravel()[pixels].astype(np.float64)
    sides = (columns + 0.5 - camera.centre_px[0]) * depths
    turn = turn_rad
    if turn is None:
        turn = math.atan2((sides.min() + sides.max()) / 2, float(np.median(depths)) * camera.focal_px)
    ranges = depths * _Turn(camera, rig.camera, 1.0, turn, False).ahead(columns + 0.5)
    middle = float(np.median(ranges))
    turned = _Turn(camera, rig.camera, rig.camera.focal_px / rig.stand_off_m * middle, turn, mirrored)

    down, across = turned.to_view(rows + 0.5, columns + 0.5)
    scale = turned.focal_px / camera.focal_px
    top, bottom = math.floor(down.min() - scale / 2), math.ceil(down.max() + scale / 2)
    left, right = math.floor(across.min() - scale / 2), math.ceil(across.max() + scale / 2)
    height = max(rig.camera.rows, bottom - top + 2 * MARGIN)
    width = max(rig.camera.columns, right - left + 2 * MARGIN)
    if max(height, width) > LARGEST_SIDE:
        raise BadConfig(
            f"a body's view must be at most {LARGEST_SIDE} pixels wide and high, found {width} x {height} "
            f"for {len(pixels)} pixels at {middle:.3g} m"
        )
    corner = (top + bottom - height) // 2, (left + right - width) // 2

    own = np.zeros(range_m.shape)
    own.ravel()[pixels] = ranges
    view = np.zeros((height, width))
    box = slice(top - corner[0], bottom - corner[0]), slice(left - corner[1], right - corner[1])
    view[box] = _pick(own, *turned.to_frame(np.arange(top, bottom)[:, None] + 0.5, np.arange(left, right) + 0.5))

    flat = view.ravel()
    places = (np.floor(down).astype(np.intp) - corner[0]) * width + np.floor(across).astype(np.intp) - corner[1]
    lost = np.flatnonzero(flat[places] == 0)
    off_centre = np.hypot(across[lost] % 1 - 0.5, down[lost] % 1 - 0.5)
    nearest_last = lost[np.argsort(-off_centre, kind="stable")]
    flat[places[nearest_last]] = ranges[nearest_last]
    moved = np.where(view > 0, np.clip(view + (rig.stand_off_m - middle), *_RANGES_M), 0)
    return BodyView(moved.astype(np.float32), corner, places, turn, middle, scale)


@dataclass(frozen=True)
class _Turn:
    """The image planes of a frame's camera and of one that stands there too, turned to the frame's right by `angle`, of
    another focal length and with the principal point of `known`.

    A ray (x, y, 1) of the frame is (x cos - sin, y, x sin + cos) after the turn.
    """

    camera: Camera
    known: Camera
    focal_px: float
    angle: float
    mirrored: bool

    def ahead(self, across: Floats) -> Floats:
        """Range after the turn, for a range of 1 before it, at places of the frame."""
        x = (across - self.camera.centre_px[0]) / self.camera.focal_px
        return x * math.sin(self.angle) + math.cos(self.angle)

    def to_view(self, down: Floats, across: Floats) -> tuple[Floats, Floats]:
        """From the frame's image plane to the view's, pixels."""
        x = (across - self.camera.centre_px[0]) / self.camera.focal_px
        y = (down - self.camera.centre_px[1]) / self.camera.focal_px
        ahead = self.ahead(across)
        way = -1 if self.mirrored else 1
        return (
            self.known.centre_px[1] + self.focal_px * y / ahead,
            self.known.centre_px[0] + way * self.focal_px * (x * math.cos(self.angle) - math.sin(self.angle)) / ahead,
        )

    def to_frame(self, down: Floats, across: Floats) -> tuple[Floats, Floats]:
        """The inverse; what the frame's camera has beside or behind it falls far out of the frame."""
        x = (across - self.known.centre_px[0]) / self.focal_px * (-1 if self.mirrored else 1)
        y = (down - self.known.centre_px[1]) / self.focal_px
        ahead = np.maximum(math.cos(self.angle) - x * math.sin(self.angle), 1e-9)
        return (
            self.camera.centre_px[1] + self.camera.focal_px * y / ahead,
            self.camera.centre_px[0] + self.camera.focal_px * (x * math.cos(self.angle) + math.sin(self.angle)) / ahead,
        )


def _pick(image: Floats, down: Floats, across: Floats) -> Floats:
    """The pixels in which points (down, across) of the image plane lie, 0 outside the image."""
    rows, columns = image.shape
    inside = (down >= 0) & (down < rows) & (across >= 0) & (across < columns)
    row, column = (np.clip(place, 0, side - 1).astype(np.intp) for place, side in ((down, rows), (across, columns)))
    return np.where(inside, image[row, column], 0)
