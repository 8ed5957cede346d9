"""Streams of deflate, as PNG files hold them: by isal where it is installed (`bodyseg[fast]`), else by zlib."""

from __future__ import annotations

import zlib
from functools import cache
from importlib import import_module
from typing import Any


def compress(data: Any, level: int) -> bytes:
    """Compress bytes into zlib's format. level: 0 to 3.

    isal and zlib write other streams of the same content, and isal may write another one when it is called again: so
    what must have the same bytes every time, like shards, is compressed elsewhere.
    """
    packed: bytes = library().compress(data, level)
    return packed


def decompress(packed: bytes, size: int) -> bytes:
    """Decompress zlib's format to exactly `size` bytes, however many more there are. Raises ValueError."""
    try:
        data: bytes = library().decompressobj().decompress(packed, size)
    except library().error as error:
        raise ValueError(f"its pixels cannot be decompressed: {error}") from error
    if len(data) != size:
        raise ValueError(f"its pixels must be {size} bytes, found {len(data)}")
    return data


@cache
def library() -> Any:
    """The module that compresses: isal's, whose functions and errors are those of zlib, or zlib."""
    try:
        return import_module("isal.isal_zlib")
    except ImportError:
        return zlib
