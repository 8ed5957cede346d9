"""Files of frames: a 16-bit grey PNG, or one clear line for anything else, and the entries of a tar.

A tar's entries and their offsets are listed from its headers alone; nothing is extracted.
"""

import tarfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Final, cast

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_data.files import refuse_special
from bodyseg_data.shards import SIGNATURE, check_checksums, decode_chunks, read_chunks, read_header
from bodyseg_model.recordings.recording import FrameSource, check_pixels

_KINDS: Final = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGB with alpha"}
_NEEDED: Final = (b"IHDR", b"IDAT", b"IEND")

_LARGEST_HEADER: Final = 1 << 14


def parse_frame(data: bytes) -> NDArray[np.uint16]:
    """Decode the pixels of a 16-bit grey PNG, uint16 [H, W]. Raises BadConfig.

    Chunks without pixels are checked but not decoded: ranges need none of them, and the sizes they claim could exhaust
    memory.
    """
    if not data.startswith(SIGNATURE):
        raise BadConfig(f"a frame must be a 16-bit grey PNG, found {'no PNG' if data else 'nothing at all'}")
    try:
        chunks = read_chunks(data)
        check_checksums(chunks)
        needed = [chunk for chunk in chunks if chunk.name in _NEEDED]
        header = read_header(needed[0])
        if (header.bits, header.colour) != (16, 0):
            kind = f"{header.bits}-bit {_KINDS.get(header.colour, header.colour)}"
            raise BadConfig(f"a frame must be a 16-bit grey PNG, found {kind}")
        check_pixels((header.rows, header.columns), np.dtype(np.uint16))
        image: NDArray[np.uint16] = decode_chunks(needed)
    except ValueError as error:
        raise BadConfig(str(error)) from error
    return image


@dataclass(frozen=True)
class PngSource(FrameSource):
    """Reader of one frame, a PNG: `size` bytes from `offset` of the file at `path`, which is the PNG or a tar."""

    path: Path
    offset: int
    size: int

    def read(self, index: int) -> NDArray[np.uint16]:
        return parse_frame(read_part(self.path, self.offset, self.size))


def read_part(path: Path, offset: int, size: int) -> bytes:
    """Read `size` bytes from `offset` of a file. Raises BadConfig without its name."""
    try:
        with path.open("rb") as file:
            file.seek(offset)
            data = file.read(size)
    except OSError as error:
        raise BadConfig(f"the file cannot be read: {error.strerror or error}") from error
    if len(data) != size:
        raise BadConfig(f"the file must still have the {size} bytes it had, found {len(data)}")
    return data


@dataclass(frozen=True)
class Member:
    """One entry: its data are `size` bytes from `offset` of the tar. plain: True for a regular file."""

    name: str
    offset: int
    size: int
    plain: bool


def list_tar(path: Path) -> list[Member]:
    """List the entries of an uncompressed tar, folders aside, in its order.

    Raises BadConfig, naming the tar, if it is not one, is damaged, or has no end-of-archive block: `tarfile` treats a
    header that is cut off or altered as the end.
    """
    members: list[Member] = []
    try:
        refuse_special(path)
        size = path.stat().st_size
        with path.open("rb") as file, tarfile.open(fileobj=cast(Any, _Headers(file, path)), mode="r:") as tar:
            last = -1
            for entry in tar:
                if not last < entry.offset <= entry.offset_data + max(entry.size, 0) <= size or entry.size < 0:
                    raise BadConfig(
                        f"a tar's entries must lie behind one another and within it: {path}, {entry.name!r}"
                    )
                last = entry.offset
                plain = entry.isreg() and not entry.issparse()
                if not entry.isdir():
                    members.append(Member(entry.name, entry.offset_data, entry.size, plain))
            file.seek(tar.offset)
            if file.read(tarfile.BLOCKSIZE) != bytes(tarfile.BLOCKSIZE):
                raise BadConfig(f"a tar must be whole, found it cut off or damaged at byte {tar.offset}: {path}")
    except OSError as error:
        raise BadConfig(f"cannot read {path}: {error.strerror or error}") from error
    except (tarfile.TarError, UnicodeError, ValueError, RecursionError) as error:
        raise BadConfig(f"{path} must be an uncompressed tar: {error}") from error
    return members


class _Headers:
    """A tar's file with limited reads, because `tarfile` reads long names into memory by the size that they claim."""

    def __init__(self, file: BinaryIO, path: Path) -> None:
        self._file, self._path = file, path
        self.seek, self.tell = file.seek, file.tell

    def read(self, size: int) -> bytes:
        if not 0 <= size <= _LARGEST_HEADER:
            raise BadConfig(f"a tar's header must have at most {_LARGEST_HEADER} bytes, found {size}: {self._path}")
        return self._file.read(size)
