"""Pages of commands, from the dataclasses that hold their options."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterator
from typing import Any

from bodyseg_data.commands import Commands, flag_of
from bodyseg_data.commands.cli import load_command


def described_commands(commands: Commands) -> str:
    """Return Markdown with a heading, a summary, an example and a table of options for each command."""
    return "\n".join(
        line
        for name, (place, summary) in commands.items()
        for line in _described(f"bodyseg {name}", summary, load_command(place))
    )


def _described(title: str, summary: str, command: Any) -> Iterator[str]:
    yield from (f"## {title}", "", f"{summary[0].upper()}{summary[1:]}.", "")
    yield from ("```text", command.EXAMPLE, "```", "")
    fields = dataclasses.fields(command.Options)
    if not fields:
        return
    yield from ("| option | value | default | meaning |", "| --- | --- | --- | --- |")
    hints = typing.get_type_hints(command.Options)
    for field in sorted(fields, key=lambda field: not field.metadata["positional"]):
        if field.metadata["heading"] is not None:
            yield f"| **{field.metadata['heading']}** |  |  |  |"
        name = field.name.upper() if field.metadata["positional"] else flag_of(field)
        cells = (f"`{name}`", value_text(hints[field.name]), default_text(field), field.metadata["help"])
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"
    yield ""


def value_text(hint: Any) -> str:
    """Return the kind of value that an option takes, as a reader of the site sees it."""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        return value_text(next(part for part in typing.get_args(hint) if part is not types.NoneType))
    if typing.get_origin(hint) is tuple:
        return f"{value_text(typing.get_args(hint)[0])}, one or several"
    if typing.get_origin(hint) is typing.Literal:
        return ", ".join(f"`{choice}`" for choice in typing.get_args(hint))
    names = {"bool": "switch", "int": "whole number", "float": "number", "str": "text", "Path": "path"}
    return names[hint.__name__]


def default_text(field: dataclasses.Field[Any]) -> str:
    """Return an option's default as it would be typed; "required" where there is none, empty where it is nothing."""
    if field.default is dataclasses.MISSING:
        return "required"
    if field.default is False or field.default in (None, ()):
        return ""
    values = field.default if isinstance(field.default, tuple) else (field.default,)
    return f"`{' '.join(map(str, values))}`"
