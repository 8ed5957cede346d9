"""Docstrings, plain text with backticks and indented code, as reStructuredText for Sphinx; and signatures."""

from __future__ import annotations

import inspect
import re
from collections.abc import Collection, Iterator, Sequence
from typing import Any, Final

_QUOTED: Final = re.compile(r"(`[^`]*`)")
_SPECIAL: Final = re.compile(r"[\\*|]|_(?!\w)")


def as_rst(lines: Sequence[str], names: Collection[str] = ()) -> list[str]:
    """Return a docstring's lines as reStructuredText: code stays as it is, parameters of these names stand in bold.

    Code is what follows an empty line with an indentation of four and belongs to no list.
    """
    named = re.compile(rf"(?<![\w.])({'|'.join(map(re.escape, names))}): ") if names else None
    return [*_converted(lines, named)]


def _converted(lines: Sequence[str], named: re.Pattern[str] | None) -> Iterator[str]:
    code = in_list = False
    before = ""
    for line in lines:
        indented = line.startswith("    ")
        if indented and not before and not code and not in_list:
            yield from ("::", "")
            code = True
        elif line and not indented:
            if code and before:
                yield ""  # text follows code at once
            code, in_list = False, line.startswith(("- ", "  "))
        yield line if code else _escaped(line, named)
        before = line


def _escaped(line: str, named: re.Pattern[str] | None) -> str:
    parts = _QUOTED.split(line)
    for index in range(0, len(parts), 2):
        plain = _SPECIAL.sub(r"\\\g<0>", parts[index])
        parts[index] = named.sub(r"**\1**: ", plain) if named else plain
    return "".join(parts)


def parameters(value: Any) -> list[str]:
    """Return the names of the parameters of a function or class; empty for anything else."""
    if not callable(value):
        return []
    try:
        return [name for name in inspect.signature(value).parameters if name != "self"]
    except (TypeError, ValueError):  # built in, or a class that cannot be called
        return []


_NO_PYTHON: Final = re.compile(r"= (<[^<>]*>|\w+\('\w+', \d+ classes\))")


def with_defaults(signature: str) -> str:
    """Return a signature in which `...` stands for defaults that are no Python.

    Sphinx shows the types of a signature that it cannot parse with all their modules.
    """
    return _NO_PYTHON.sub("= ...", signature)
