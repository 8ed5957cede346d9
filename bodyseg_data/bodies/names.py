"""Names that files have on disk, as sample keys and in messages."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator, Sequence
from typing import Final
from urllib.parse import quote_from_bytes

_NUMBERED: Final = re.compile(r"(.*?)(\d+)(\D*)", re.DOTALL)
_HASH_LETTERS: Final = 10


def key_name(path: str, longest: int) -> str:
    """A file's relative path, with / between folders, as part of a sample key: letters, digits, _, + and - only.

    Different paths give different names: "/" becomes "++" and any other byte "+" and two hexadecimal digits. A name
    longer than `longest` ends in ten digits of a hash of the whole in place of the rest.
    """
    quoted = quote_from_bytes(os.fsencode(path), safe="/").replace(".", "%2E").replace("~", "%7E")
    name = quoted.replace("%", "+").replace("/", "++")
    if len(name) <= longest:
        return name
    return f"{name[: longest - _HASH_LETTERS - 1]}-{hashlib.sha256(name.encode()).hexdigest()[:_HASH_LETTERS]}"


def collapsed(names: Sequence[str]) -> list[str]:
    """Runs of names whose last number counts up by one, as one: "meshes/mesh_0001.obj to mesh_0004.obj"."""
    return [first if first == last else f"{first} to {last.rpartition('/')[2]}" for first, last in _runs(names)]


def _runs(names: Sequence[str]) -> Iterator[tuple[str, str]]:
    """(first, last) of every run."""
    first = last = None
    for name in names:
        if first is None or last is None:
            first = last = name
        elif _follows(name, last):
            last = name
        else:
            yield first, last
            first = last = name
    if first is not None and last is not None:
        yield first, last


def _follows(name: str, before: str) -> bool:
    this, that = _parts(name), _parts(before)
    if this is None or that is None or (this[0], this[2]) != (that[0], that[2]) or len(this[1]) != len(that[1]):
        return False
    return int(this[1]) == int(that[1]) + 1


def _parts(name: str) -> tuple[str, str, str] | None:
    """What stands before, in and after the last number of a name."""
    match = _NUMBERED.fullmatch(name)
    return (match[1], match[2], match[3]) if match else None
