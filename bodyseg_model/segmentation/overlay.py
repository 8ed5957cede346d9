"""Overlays of labelled frames: parts in their colours, shaded by range; and an animation of them."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.labels.label_map import PARTS33, LabelMap
from bodyseg_data.drawing.style import draw_legend

_EMPTY: Final = (24, 26, 32)
_ROOM_GREYS: Final = (96, 44)
_UNKNOWN_GREYS: Final = (235, 140)
_DARKEST: Final = 0.55
_LEVELS: Final = 6
_LEGEND_WIDTH: Final = 900
_PREVIEW_SIDE: Final = 320
MOST_FRAMES: Final = 900
"""Greatest number of frames in a preview, all of which are held in memory."""

FRAMES_PER_SECOND: Final = (0.1, 50.0)
"""Limits of a GIF: delays are hundredths of a second, and players replace very short ones by long ones."""


def draw_overlay(
    range_m: NDArray[np.float32],
    labels: NDArray[np.uint8],
    bodies: Sequence[NDArray[np.intp]],
    label_map: LabelMap = PARTS33,
) -> NDArray[np.uint8]:
    """Draw one frame, sRGB uint8 [H, W, 3].

    range_m: [H, W], metres. labels: uint8 [H, W], classes of `label_map`; any other value on a body is drawn grey.
    bodies: flat indices of each body's pixels. Near surfaces are light and far ones dark, for every body by itself and
    for the room, which is darker than any body; pixels that were not measured are nearly black.
    """
    picture = np.empty((range_m.size, 3), np.uint8)
    picture[:] = _EMPTY
    room = np.flatnonzero(range_m)
    picture[room] = _between(_ROOM_GREYS, _depth(range_m.ravel()[room]))[:, None]
    for pixels in bodies:
        depth, label = _depth(range_m.ravel()[pixels]), labels.ravel()[pixels]
        is_part = label < len(label_map)
        colours = label_map.colours[np.where(is_part, label, 0)] * _between((1, _DARKEST), depth)[:, None]
        picture[pixels] = np.where(is_part[:, None], colours, _between(_UNKNOWN_GREYS, depth)[:, None]).astype(np.uint8)
    return picture.reshape(*range_m.shape, 3)


class Preview:
    """An animation of overlays, subsampled so that hundreds of frames fit into memory.

    label_map: the classes, whose colours the animation has. Raises BadConfig for a rate outside `FRAMES_PER_SECOND`.
    """

    def __init__(self, frames_per_second: float, label_map: LabelMap = PARTS33) -> None:
        if not FRAMES_PER_SECOND[0] <= frames_per_second <= FRAMES_PER_SECOND[1]:
            slowest, fastest = FRAMES_PER_SECOND
            raise BadConfig(
                f"a preview shows {slowest:g} to {fastest:g} frames per second, found {frames_per_second:g}"
            )
        self._hundredths = round(100 / frames_per_second)
        self._palette = Image.new("P", (1, 1))
        self._palette.putpalette(_palette(label_map).ravel().tolist())
        self._frames: list[Image.Image] = []

    @property
    def frames_per_second(self) -> float:
        """Frame rate of the file: delays of a GIF are whole hundredths of a second."""
        return 100 / self._hundredths

    def __len__(self) -> int:
        return len(self._frames)

    def __repr__(self) -> str:
        return f"Preview({len(self)} frames, {self.frames_per_second:g} per second)"

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Append an overlay, sRGB uint8 [H, W, 3], all of one size; it is ignored once there are `MOST_FRAMES`."""
        if len(self._frames) < MOST_FRAMES:
            step = -(-max(picture.shape[:2]) // _PREVIEW_SIDE)
            small = Image.fromarray(np.ascontiguousarray(picture[::step, ::step]))
            self._frames.append(small.quantize(palette=self._palette, dither=Image.Dither.NONE))

    def to_gif(self) -> bytes:
        """Encode the animation as a GIF that repeats; there must be at least one frame."""
        buffer = io.BytesIO()
        first, *others = self._frames
        first.save(buffer, "GIF", save_all=True, append_images=others, duration=10 * self._hundredths, loop=0)
        return buffer.getvalue()


def draw_parts_legend(label_map: LabelMap = PARTS33) -> Image.Image:
    """Draw the colours of the classes with their names."""
    return draw_legend(_LEGEND_WIDTH, label_map)


def _depth(range_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Depth from 0 at the 2 % quantile of ranges [N] to 1 at the 98 % quantile, so that outliers do not matter."""
    if not len(range_m):
        return range_m
    near, far = np.quantile(range_m, (0.02, 0.98))
    return np.asarray(np.clip((range_m - near) / max(far - near, 1e-3), 0, 1), np.float32)


def _between(ends: tuple[float, float], depth: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(np.interp(depth, (0, 1), ends), np.float32)


def _palette(label_map: LabelMap) -> NDArray[np.uint8]:
    """The 256 colours of a preview: every class in `_LEVELS` brightnesses, and greys; uint8 [256, 3]."""
    brightness = np.linspace(1, _DARKEST, _LEVELS)
    parts = (label_map.colours[:, None] * brightness[:, None]).reshape(-1, 3)
    greys = np.linspace(_ROOM_GREYS[1], _UNKNOWN_GREYS[0], 256 - len(parts) - 1)[:, None].repeat(3, axis=1)
    return np.concatenate([parts, greys, [_EMPTY]]).astype(np.uint8)
