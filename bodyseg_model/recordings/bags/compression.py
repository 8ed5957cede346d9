"""Decompression of pieces of bags, up to a limit of bytes whatever they claim."""

from __future__ import annotations

import bz2
from collections.abc import Callable
from typing import Final

import zstandard

from bodyseg_model.recordings.bags.messages import LARGEST_MESSAGE, missing

_BZ2: Final = b"BZh"
_LZ4: Final = b"\x04\x22\x4d\x18"
_PIECE: Final = 1 << 16
_ZSTD: Final = b"\x28\xb5\x2f\xfd"


def decompressed(data: bytes) -> bytes:
    """Decompress bzip2, LZ4 frames or zstd, told by their first bytes; others are returned as they are.

    Records of a plain chunk cannot begin so: they would be larger than any chunk. Raises ValueError for more than
    `LARGEST_MESSAGE` bytes, MissingLibrary, and what the libraries raise for damaged data.
    """
    if data.startswith(_BZ2):
        bzip2 = bz2.BZ2Decompressor()
        return _joined(data, bzip2.decompress, lambda: bzip2.eof or bzip2.needs_input)
    if data.startswith(_LZ4):
        try:
            from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
        except ImportError as error:
            raise missing(error) from error
        lz4 = LZ4FrameDecompressor()
        return _joined(data, lz4.decompress, lambda: lz4.eof or lz4.needs_input)
    if data.startswith(_ZSTD):
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            done = False

            def read(_: bytes, size: int) -> bytes:
                nonlocal done
                piece = reader.read(size)
                done = not piece
                return piece

            return _joined(b"", read, lambda: done)
    return bytes(data)


def _joined(data: bytes, decompress: Callable[[bytes, int], bytes], done: Callable[[], bool]) -> bytes:
    """Decompress in pieces, because libraries allocate all that they may return. Raises ValueError beyond the limit."""
    pieces = [decompress(data, _PIECE)]
    size = len(pieces[0])
    while not done() and size <= LARGEST_MESSAGE:
        pieces.append(decompress(b"", _PIECE))
        size += len(pieces[-1])
    if size > LARGEST_MESSAGE:
        raise ValueError(f"a piece must have at most {LARGEST_MESSAGE} bytes")
    return b"".join(pieces)
