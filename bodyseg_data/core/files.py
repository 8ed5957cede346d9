"""Atomic writes, and reads of untrusted files up to a limit of bytes."""

from __future__ import annotations

import contextlib
import errno
import gzip
import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from bodyseg_data.core.errors import BadConfig

_CHUNK_BYTES: Final = 1 << 20


def write_atomically(path: Path, data: bytes, flushed: bool = True) -> None:
    """Write `data` beside `path`, then rename: `path` never holds a part of it, even after a power cut.

    flushed: False does not wait for the disk, which may take longer than all else; until `flush` is called, a power cut
    may then leave an empty file.
    """
    write_chunks_atomically(path, (data,), flushed)


def write_chunks_atomically(path: Path, chunks: Iterable[bytes], flushed: bool = True) -> None:
    """Write chunks of bytes one after the other, as `write_atomically`; an error of their iterator leaves no file."""
    aside = path.with_name(f".{path.name}.part")
    try:
        with aside.open("wb") as file:
            for chunk in chunks:
                file.write(chunk)
            if flushed:
                file.flush()
                os.fsync(file.fileno())
        aside.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            aside.unlink(missing_ok=True)
        raise
    if flushed:
        sync(path.parent)


def flush(paths: Sequence[Path]) -> None:
    """Wait until the disk holds these files, written before, and their folders' entries. Raises OSError."""
    for path in (*paths, *dict.fromkeys(path.parent for path in paths)):
        sync(path)


def write_result(path: Path, data: bytes, flushed: bool = True) -> None:
    """Write a file that a user requested, as `write_atomically`. Raises BadConfig, naming it, if it cannot be
    written.
    """
    try:
        write_atomically(path, data, flushed)
    except OSError as error:
        raise BadConfig(f"cannot write {path}: {error.strerror or error}") from error


def make_folder(path: Path) -> None:
    """Make a folder and those above it, unless they are there. Raises BadConfig, naming it, if that fails."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadConfig(f"cannot make the folder {path}: {error.strerror or error}") from error


def sync(path: Path) -> None:
    """Wait until the disk holds a file, or a folder's entries, so that renames within it survive a power cut."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def refuse_special(path: Path) -> None:
    """Raise OSError for a pipe, which a reader would wait for without end, a device and the like."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, "not a regular file", str(path))


def parse_json(data: bytes, where: str) -> dict[str, Any]:
    """The object in JSON text; `where` names its origin in messages. Raises BadConfig."""
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise BadConfig(f"{where} is not JSON: {error}") from error
    if not isinstance(content, dict):
        raise BadConfig(f"{where} must hold a JSON object, found {type(content).__name__}")
    return content


def contents(path: Path, packed: bool, limit: int) -> bytes | None:
    """Read a file, decompressed if it is `packed` with gzip; None if it holds more than `limit` bytes.

    Raises OSError if it cannot be read, gzip.BadGzipFile, EOFError or zlib.error if it is no complete gzip file.
    """
    refuse_special(path)
    data = bytearray()
    with gzip.open(path) if packed else path.open("rb") as file:
        while len(data) <= limit and (chunk := file.read(_CHUNK_BYTES)):
            data += chunk
    return bytes(data) if len(data) <= limit else None
