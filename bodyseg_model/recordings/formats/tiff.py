"""Recordings in TIFF files: a page a frame, whole numbers or floating point."""

import io
from pathlib import Path
from typing import IO, Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from bodyseg_data.core import BadConfig, reported
from bodyseg_data.machine import opened_picture
from bodyseg_model.recordings.recording import LARGEST_SIDE, MOST_FRAMES, Frame, FrameSource, stored_recording

_MODES: Final = {"I;16": np.uint16, "I;16B": np.uint16, "I;16L": np.uint16, "I": np.int32, "F": np.float32}

_UNREAD: Final = 65533  # in all pixels of a page that was not read
_BIG: Final = 43  # version of a TIFF with offsets of 64 bits


def open_tiff(path: Path, topic: str | None, step_m: float | None) -> tuple[Frame, ...]:
    """Open a TIFF of whole numbers, steps, or floating point, metres (step_m: metres that 1.0 is). Raises BadConfig."""
    if topic is not None:
        raise BadConfig(f"--topic is for recordings that hold several, found a TIFF: {path}")
    pages = _Pages(path)
    with reported(str(path), BadConfig):
        floating = pages.read(0).dtype.kind == "f"
    return stored_recording(path, pages, len(pages.starts), floating, step_m)


class _Pages(FrameSource):
    """Pages of a TIFF, listed once. The file is opened for every page, so that no handle outlives a call."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with reported(f"{path} must be a whole TIFF", BadConfig, OSError, ValueError), path.open("rb") as file:
            self.starts = _pages(file)

    def read(self, index: int) -> NDArray[Any]:
        with (
            reported(f"page {index} of the TIFF cannot be read", BadConfig, Exception),  # whatever Pillow raises
            _FromPage(self._path, self.starts[index]) as file,
            opened_picture(file, ("TIFF",), strict=True) as image,
        ):
            mode, size = image.mode, image.size
            tile = [int(image.tag_v2.get(tag, 1)) for tag in (322, 323)]  # its sides, by TIFF 6.0
            if mode in _MODES and max(*size, *tile) <= LARGEST_SIDE:
                image.im = Image.new(mode, size, _UNREAD).im  # Pillow leaves it so where libtiff cannot read the page
                pixels = np.asarray(image).astype(_MODES[mode])
                if not (pixels == _UNREAD).all():
                    return pixels
                raise ValueError("its directory is damaged")
        raise BadConfig(
            f"a page must be grey of 16 or 32 bits or floating point, at most {LARGEST_SIDE} a side, found {mode!r} of "
            f"{size[1]} x {size[0]}"
        )


def _pages(file: IO[bytes]) -> list[bytes]:
    """For each page of a TIFF, the header that names it as the first. Raises ValueError."""

    def number(offset: int, count: int) -> int:
        file.seek(offset)
        return int.from_bytes(file.read(count), order)

    start, size = file.read(8), file.seek(0, io.SEEK_END)
    order: Literal["little", "big"] = "little" if start[:2] == b"II" else "big"
    many, entry, link = (8, 20, 8) if number(2, 2) == _BIG else (2, 12, 4)
    found, offset = dict[int, bytes](), number(link, link) or size
    while offset and offset not in found:  # some writers end with a link to an earlier page
        end = offset + many + entry * number(offset, many)
        if end + link > size:
            raise ValueError(f"page {len(found)} lies beyond its end: byte {offset}")
        if len(found) == MOST_FRAMES:
            raise ValueError(f"it has more than {MOST_FRAMES} pages")
        found[offset] = start[:link] + offset.to_bytes(link, order)
        offset = number(end, link)
    return list(found.values())


class _FromPage(io.FileIO):
    """A TIFF whose header names another page as the first: Pillow would load all pages before the one that it seeks."""

    def __init__(self, path: Path, head: bytes) -> None:
        super().__init__(path)
        self._head = head

    def read(self, size: int | None = -1, /) -> bytes:
        start = self.tell()
        data = super().read(-1 if size is None else size) or b""
        return self._head[start : start + len(data)] + data[max(len(self._head) - start, 0) :]
