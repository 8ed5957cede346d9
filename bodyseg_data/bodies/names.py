"""File names as parts of sample keys, and lists of them in messages."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Sequence
from typing import Final
from urllib.parse import quote_from_bytes

_NUMBERED: Final = re.compile(r"(.*?)(\d+)(\D*)", re.DOTALL)
_HASH_LETTERS: Final = 10


def key_name(path: str, longest: int) -> str:
    """Turn a file's relative path, with / between folders, into part of a sample key: letters, digits, _, + and -.

    Different paths give different names: "/" becomes "++" and any other byte "+" and two hexadecimal digits. A name
    longer than `longest` ends in ten digits of a hash of the whole in place of the rest.
    """
    quoted = quote_from_bytes(os.fsencode(path), safe="/").replace(".", "%2E").replace("~", "%7E")
    name = quoted.replace("%", "+").replace("/", "++")
    if len(name) <= longest:
        return name
    return f"{name[: longest - _HASH_LETTERS - 1]}-{hashlib.sha256(name.encode()).hexdigest()[:_HASH_LETTERS]}"


def collapsed(names: Sequence[str]) -> list[str]:
    """Join runs of names whose last number counts up by one: "meshes/mesh_0001.obj to mesh_0004.obj"."""
    runs: list[list[str]] = []
    for name in names:
        if runs and _follows(name, runs[-1][-1]):
            runs[-1].append(name)
        else:
            runs.append([name])
    return [run[0] if len(run) == 1 else f"{run[0]} to {run[-1].rpartition('/')[2]}" for run in runs]


def _follows(name: str, before: str) -> bool:
    this, that = _NUMBERED.fullmatch(name), _NUMBERED.fullmatch(before)
    if this is None or that is None or this[1] != that[1] or this[3] != that[3] or len(this[2]) != len(that[2]):
        return False
    return int(this[2]) == int(that[2]) + 1
