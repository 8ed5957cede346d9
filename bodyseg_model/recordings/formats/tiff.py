"""Recordings in TIFF files: a page a frame, whole numbers or floating point."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, TiffImagePlugin

from bodyseg_data.core import BadConfig
from bodyseg_data.machine import silence_libtiff
from bodyseg_model.recordings.recording import LARGEST_SIDE, Frame, FrameSource, stored_recording

_MODES: Final = {"I;16": np.uint16, "I;16B": np.uint16, "I;16L": np.uint16, "I": np.int32, "F": np.float32}

# Pillow decodes 64 bits, and only has no name for them: byte order, grey either way, floating point, bits.
for _order, _raw in ((b"II", "F;64F"), (b"MM", "F;64BF")):
    for _grey in (0, 1):
        TiffImagePlugin.OPEN_INFO.setdefault((_order, _grey, (3,), 1, (64,), ()), ("F", _raw))


def open_tiff(path: Path, topic: str | None, step_m: float | None) -> tuple[Frame, ...]:
    """Open a TIFF whose pages are whole numbers, steps, or floating point, metres (step_m: metres that 1.0 is).

    Raises BadConfig.
    """
    if topic is not None:
        raise BadConfig(f"--topic is for recordings that hold several, found a TIFF: {path}")
    pages = _Pages(path)
    try:
        floating = pages.read(0).dtype.kind == "f"
    except BadConfig as error:
        raise BadConfig(f"{path}: {error}") from error
    return stored_recording(path, pages, [None] * pages.count, floating, step_m)


class _Pages(FrameSource):
    """Pages of a TIFF. The file is opened for every page, so that no handle outlives a call."""

    def __init__(self, path: Path) -> None:
        silence_libtiff()
        self._path = path
        try:
            with warnings.catch_warnings(action="error"), Image.open(path, formats=["TIFF"]) as image:
                count = getattr(image, "n_frames", 1)
        except Exception as error:  # a damaged TIFF raises what Pillow likes
            raise BadConfig(f"{path} must be a whole TIFF: {error}") from error
        self.count: int = count

    def read(self, index: int) -> NDArray[Any]:
        try:
            with warnings.catch_warnings(action="error"), Image.open(self._path, formats=["TIFF"]) as image:
                image.seek(index)
                mode, size = image.mode, image.size
                if mode in _MODES and max(size) <= LARGEST_SIDE:
                    return np.asarray(image).astype(_MODES[mode])
        except Exception as error:  # as above
            raise BadConfig(f"page {index} of the TIFF cannot be read: {error}") from error
        raise BadConfig(
            f"a page must be grey of 16 or 32 bits or floating point, at most {LARGEST_SIDE} a side, found {mode!r} of "
            f"{size[1]} x {size[0]}"
        )
