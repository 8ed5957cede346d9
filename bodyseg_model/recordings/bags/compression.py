"""Decompression of pieces of bags, up to a limit of bytes whatever they claim."""

from __future__ import annotations

import bz2
from typing import Final

import zstandard

from bodyseg_model.recordings.bags.messages import LARGEST_MESSAGE, missing

_BZ2: Final = b"BZh"
_LZ4: Final = b"\x04\x22\x4d\x18"
_ZSTD: Final = b"\x28\xb5\x2f\xfd"


def decompressed(data: bytes) -> bytes:
    """Decompress bzip2, LZ4 frames or zstd, told by their first bytes; others are returned as they are.

    Records of a plain chunk cannot begin so: they would be larger than any chunk. Raises ValueError for more than
    `LARGEST_MESSAGE` bytes, MissingLibrary, and what the libraries raise for damaged data.
    """
    most = LARGEST_MESSAGE + 1
    if data.startswith(_BZ2):
        plain = bz2.BZ2Decompressor().decompress(data, most)
    elif data.startswith(_LZ4):
        try:
            from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
        except ImportError as error:
            raise missing(error) from error
        plain = LZ4FrameDecompressor().decompress(data, most)
    elif data.startswith(_ZSTD):
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            plain = reader.read(most)
    else:
        plain = data
    if len(plain) > LARGEST_MESSAGE:
        raise ValueError(f"a piece must have at most {LARGEST_MESSAGE} bytes")
    return bytes(plain)
