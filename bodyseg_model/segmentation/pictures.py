"""Pictures of labelled frames: parts in their colours, shaded by range; an animation of them; and their encoding.

PNGs have rows that are not filtered: labels and overlays hold large areas of few values, and filters, whose choice
takes Pillow most of the time, make neither smaller.
"""

import io
import struct
import zlib
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from bodyseg_data.core import BadConfig
from bodyseg_data.drawing import EMPTY
from bodyseg_data.labels import PARTS33, LabelMap
from bodyseg_data.machine import compress
from bodyseg_data.shards import SIGNATURE
from bodyseg_model.segmentation.views import compiled_loops

_ROOM_GREYS: Final = (96, 44)
_UNKNOWN_GREYS: Final = (235, 140)
_DARKEST: Final = 0.55
_LEVELS: Final = 6
_SHADES: Final = 128  # shades of a colour: more than there are bytes between its lightest and its darkest
_ENDS: Final = (0.02, 0.98)
_SAMPLED: Final = 4096  # ranges of a body or of the room that say how near and far it reaches
_PREVIEW_SIDE: Final = 320
MOST_FRAMES: Final = 900
"""Greatest number of frames in a preview, all of which are held in memory."""

FRAMES_PER_SECOND: Final = (0.1, 50.0)
"""Limits of a GIF: delays are hundredths of a second, and players replace very short ones by long ones."""

_LEVEL: Final = 2
"""Level of zlib and isal. With zlib an overlay takes a third of the time of Pillow's level 3, which filters, and has
about as many bytes; with isal a quarter of zlib's time and 7 % more bytes."""

_COLOUR: Final = {2: 0, 3: 2}  # colour type of an image of so many dimensions: grey, RGB

Floats = NDArray[np.float32]


def draw_overlay(
    range_m: Floats, labels: NDArray[np.uint8], bodies: Sequence[NDArray[np.intp]], label_map: LabelMap = PARTS33
) -> NDArray[np.uint8]:
    """Draw one frame, sRGB uint8 [H, W, 3].

    range_m: [H, W], metres. labels: uint8 [H, W], classes of `label_map`; others on a body are drawn grey. bodies: flat
    indices of each body's pixels. Near surfaces are light and far ones dark, for every body by itself and for the room,
    which is darker than any body; pixels that were not measured are nearly black. Raises MissingLibrary without numba.
    """
    loops, table = compiled_loops(), _table(label_map)
    flat, label = np.ascontiguousarray(range_m).ravel(), np.ascontiguousarray(labels).ravel()
    picture = np.empty((flat.size, 3), np.uint8)
    loops.paint_room(flat, *_shading(flat[:: flat.size // _SAMPLED | 1]), table, picture)
    for pixels in bodies:
        shading = _shading(flat[pixels[:: len(pixels) // _SAMPLED | 1]])
        loops.paint_body(flat, label, pixels, *shading, table, picture)
    return picture.reshape(*range_m.shape, 3)


@lru_cache(maxsize=4)
def _table(label_map: LabelMap) -> NDArray[np.uint8]:
    """Colours of an overlay from near to far, uint8 [C + 3, S, 3]: of room, every class, no class, not measured."""
    depth = np.linspace(0, 1, _SHADES)
    room, unknown = (
        np.interp(depth, (0, 1), greys)[:, None].repeat(3, axis=1) for greys in (_ROOM_GREYS, _UNKNOWN_GREYS)
    )
    parts = label_map.colours[:, None] * np.interp(depth, (0, 1), (1, _DARKEST))[:, None]
    return np.stack([room, *parts, unknown, np.tile(EMPTY, (_SHADES, 1))]).astype(np.uint8)


def _shading(some: Floats) -> tuple[np.float32, np.float32]:
    """The range, metres, that gets the first shade, and shades a metre, for some ranges of a body or of the room.

    The first and the last shade are at quantiles, `_ENDS`, so that outliers do not matter.
    """
    some = np.sort(some[(some > 0) & (some < np.inf)])
    near, far = (float(some[min(int(share * len(some)), len(some) - 1)]) if len(some) else share for share in _ENDS)
    return np.float32(near), np.float32((_SHADES - 1) / max(far - near, 1e-3))


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


def _palette(label_map: LabelMap) -> NDArray[np.uint8]:
    """The 256 colours of a preview: every class in up to `_LEVELS` brightnesses, and greys; uint8 [256, 3]."""
    brightness = np.linspace(1, _DARKEST, min(_LEVELS, 254 // len(label_map)))
    parts = (label_map.colours[:, None] * brightness[:, None]).reshape(-1, 3)
    greys = np.linspace(_ROOM_GREYS[1], _UNKNOWN_GREYS[0], 256 - len(parts) - 1)[:, None].repeat(3, axis=1)
    return np.concatenate([parts, greys, [EMPTY]]).astype(np.uint8)


def encode_picture(image: NDArray[Any]) -> bytes:
    """Encode an image as PNG: uint8 or uint16 grey [H, W], or uint8 sRGB [H, W, 3]."""
    rows, columns = image.shape[:2]
    big_endian = np.ascontiguousarray(image, image.dtype.newbyteorder(">"))
    filtered = np.zeros((rows, 1 + big_endian.nbytes // rows), np.uint8)  # each row begins with its filter: 0, none
    filtered[:, 1:] = big_endian.view(np.uint8).reshape(rows, -1)
    header = struct.pack(">IIBBBBB", columns, rows, 8 * image.dtype.itemsize, _COLOUR[image.ndim], 0, 0, 0)
    chunks = (b"IHDR", header), (b"IDAT", compress(filtered.data, _LEVEL)), (b"IEND", b"")
    return SIGNATURE + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(data, zlib.crc32(name)))
        for name, data in chunks
    )
