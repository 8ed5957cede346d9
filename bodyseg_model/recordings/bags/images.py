"""Range images in messages: 16UC1, mono16, 32FC1, PNG, and the transport compressedDepth.

compressedDepth (https://github.com/ros-perception/image_transport_plugins): 12 bytes, an int32 and the float32 A and B,
then a 16-bit PNG. Of 16UC1 the PNG holds the steps; of 32FC1 it holds v = A / range + B, rounded, range in metres, 0
where nothing was measured.
"""

from __future__ import annotations

import math
import struct
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_model.recordings.bags.messages import COMPRESSED, IMAGE
from bodyseg_model.recordings.frame_png import parse_frame
from bodyseg_model.recordings.recording import LARGEST_SIDE, Stamp

_STEPS: Final = ("16UC1", "mono16")
_METRES: Final = "32FC1"
_HEADER: Final = struct.Struct("<iff")

ENCODINGS: Final = (*_STEPS, _METRES)
"""Encodings of pixels that range images have."""


def encoding(message: Any, kind: str) -> str:
    """Return the encoding of an image message's pixels, such as "16UC1" or "rgb8"."""
    if kind == IMAGE:
        return str(message.encoding)
    return str(message.format).partition(";")[0].strip()


def is_range_image(message: Any, kind: str) -> bool:
    """True for an image message whose pixels may be ranges."""
    return encoding(message, kind) in ENCODINGS


def is_floating(message: Any, kind: str) -> bool:
    """True for an image message whose pixels are metres in floating point."""
    return encoding(message, kind) == _METRES


def pixels(message: Any, kind: str) -> NDArray[Any]:
    """Decode an image message: uint16 or float32 [H, W], steps or metres. Raises BadConfig."""
    return _compressed(message) if kind == COMPRESSED else _plain(message)


def stamp(message: Any) -> Stamp:
    """Return time and coordinate frame of a message's header."""
    time = message.header.stamp
    return Stamp(int(time.sec) * 10**9 + int(time.nanosec), str(message.header.frame_id))


def _plain(message: Any) -> NDArray[Any]:
    if message.encoding not in ENCODINGS:
        raise BadConfig(f"an image must have one of the encodings {', '.join(ENCODINGS)}, found {message.encoding!r}")
    kind = np.dtype(np.float32 if message.encoding == _METRES else np.uint16)
    kind = kind.newbyteorder(">" if message.is_bigendian else "<")
    rows, columns, step = int(message.height), int(message.width), int(message.step)
    if not (1 <= rows <= LARGEST_SIDE and 1 <= columns <= LARGEST_SIDE):
        raise BadConfig(f"an image's side must be 1 to {LARGEST_SIDE} pixels, found {rows} x {columns}")
    data = np.asarray(message.data, np.uint8)
    if step < columns * kind.itemsize or len(data) != rows * step:
        raise BadConfig(
            f"an image of {rows} x {columns} {message.encoding} in rows of {step} bytes cannot have {len(data)} bytes"
        )
    row = data.reshape(rows, step)[:, : columns * kind.itemsize]
    return np.ascontiguousarray(row).view(kind).astype(kind.newbyteorder("="))


def _compressed(message: Any) -> NDArray[Any]:
    data, text = bytes(message.data), str(message.format)
    found = encoding(message, COMPRESSED)
    if found not in ENCODINGS:
        raise BadConfig(f"an image must have one of the encodings {', '.join(ENCODINGS)}, found {text!r}")
    if "compressedDepth" not in text:
        if found == _METRES or "png" not in text:
            raise BadConfig(f"a compressed image must be a 16-bit PNG or compressedDepth, found {text!r}")
        return parse_frame(data, f"format {text!r}")
    if "rvl" in text.lower():
        raise BadConfig(f"compressedDepth must be in PNG, found {text!r}")
    if len(data) < _HEADER.size:
        raise BadConfig(f"compressedDepth must begin with {_HEADER.size} bytes of header, found {len(data)} in all")
    _, a, b = _HEADER.unpack_from(data)
    stored = parse_frame(data[_HEADER.size :], f"format {text!r}")
    if found != _METRES:
        return stored
    if not (math.isfinite(a) and math.isfinite(b) and a > 0):
        raise BadConfig(f"compressedDepth of 32FC1 must have finite A above 0 and B, found {a:g} and {b:g}")
    with np.errstate(divide="ignore", invalid="ignore"):
        metres = np.float32(a) / (stored.astype(np.float32) - np.float32(b))
    metres[stored == 0] = 0
    return metres
