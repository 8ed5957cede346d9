"""Files that appear whole or not at all, and files of strangers that may be larger than they look."""

from __future__ import annotations

import contextlib
import errno
import gzip
import os
from pathlib import Path
from typing import Final

from bodyseg_data.core.errors import BadConfig

_CHUNK_BYTES: Final = 1 << 20


def write_atomically(path: Path, data: bytes) -> None:
    """Write `data` beside `path`, then rename: whoever sees `path` sees all of it, also after a power cut."""
    aside = path.with_name(f".{path.name}.part")
    try:
        with aside.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        aside.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            aside.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def write_result(path: Path, data: bytes) -> None:
    """`write_atomically` for a file that a user asked for. Raises BadConfig, naming it, if it cannot be written."""
    try:
        write_atomically(path, data)
    except OSError as error:
        raise BadConfig(f"cannot write {path}: {error.strerror or error}") from error


def sync_folder(folder: Path) -> None:
    """Make renames within `folder` survive a power cut."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def refuse_special(path: Path) -> None:
    """Raise OSError for a pipe, which reading would wait at for ever, a device and the like."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, "not a regular file", str(path))


def contents(path: Path, packed: bool, limit: int) -> bytes | None:
    """All bytes of a file, unpacked if it is `packed` with gzip; None if there are more than `limit` of them.

    Raises OSError if it cannot be read, gzip.BadGzipFile, EOFError or zlib.error if it is not a whole gzip file.
    """
    refuse_special(path)
    data = bytearray()
    with gzip.open(path) if packed else path.open("rb") as file:
        while len(data) <= limit and (chunk := file.read(_CHUNK_BYTES)):
            data += chunk
    return bytes(data) if len(data) <= limit else None
