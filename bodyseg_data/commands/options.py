"""One frozen dataclass a command drives both the command line and code; no default value is written anywhere else."""

from __future__ import annotations

import argparse
import dataclasses
import types
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn, TypeVar

from bodyseg_data.core.errors import BadConfig

Options = TypeVar("Options")


def option(text: str, default: Any = dataclasses.MISSING, positional: bool = False, address: bool = False) -> Any:
    """A field of an options class: its help text, its default (none: required), and whether it has no dashes.

    address: whether its text is a path or an address.
    """
    return dataclasses.field(default=default, metadata={"help": text, "positional": positional, "address": address})


def parse(kind: type[Options], arguments: Sequence[str], program: str, summary: str, example: str) -> Options:
    """Read a command line into `kind`, a dataclass whose fields are made by `option`.

    Fields may be str, int, float, Path, bool (a switch), a Literal, any of them or None, or a tuple of one kind
    (several values). Raises BadConfig with one line for a bad argument; `--help` prints and exits with status 0.
    """
    parser = _Parser(
        prog=program,
        description=summary,
        epilog=f"example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    hints = typing.get_type_hints(kind)
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]  # the caller gives a dataclass
        _add(parser, field, hints[field.name])
    return kind(**vars(parser.parse_args(list(arguments))))


def command_line(program: str, options: Any) -> str:
    """The command line that gives these options, for what stands beside results.

    Of paths on this machine it has the names only: where they lie is nobody's business and would help nobody.
    """
    hints = typing.get_type_hints(type(options))
    words = [program]
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if value == field.default:
            continue
        values = value if isinstance(value, tuple) else (value,)
        named = field.metadata["address"] or _kind(hints[field.name])[0] is Path
        texts = [place_name(str(each)) if named else str(each) for each in values]
        if not field.metadata["positional"]:
            words.append(_flag(field.name))
        if hints[field.name] is not bool:
            words += texts
    return " ".join(words)


def place_name(path: str) -> str:
    """An address, or the last name of a path."""
    return path if "://" in path else Path(path).name


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage block."""

    def error(self, message: str) -> NoReturn:
        raise BadConfig(f"{message} (see {self.prog} --help)")


def _add(parser: argparse.ArgumentParser, field: dataclasses.Field[Any], hint: Any) -> None:
    required = field.default is dataclasses.MISSING
    settings: dict[str, Any] = {"help": field.metadata["help"]}
    if hint is bool:
        settings["action"] = "store_true"
    else:
        kind, many = _kind(hint)
        if typing.get_origin(kind) is typing.Literal:
            settings["choices"] = typing.get_args(kind)
            settings["metavar"] = "|".join(typing.get_args(kind))
        else:
            settings["type"] = _path if kind is Path else kind
            settings["metavar"] = {Path: "PATH", int: "N", float: "X", str: "TEXT"}[kind]
        if many:
            settings["nargs"] = "+"
            settings["action"] = _Tuple
        if not required:
            settings["default"] = field.default
            default: Any = field.default
            if default not in (None, ()):
                shown = " ".join(map(str, default)) if many else default
                settings["help"] += f" (default: {shown})"
    if field.metadata["positional"]:
        settings["metavar"] = field.name.upper()
        parser.add_argument(field.name, **settings)
    else:
        if required:
            settings["required"] = True
        parser.add_argument(_flag(field.name), dest=field.name, **settings)


def _flag(name: str) -> str:
    """A field's option; an underscore at the end is not part of it, for words that Python keeps to itself: `in_`."""
    return "--" + name.removesuffix("_").replace("_", "-")


def _path(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError("a path must not be empty")
    return Path(text)


def _kind(hint: Any) -> tuple[Any, bool]:
    """The type of one value, and whether there may be several."""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        (hint,) = (part for part in typing.get_args(hint) if part is not type(None))
    if typing.get_origin(hint) is tuple:
        return typing.get_args(hint)[0], True
    return hint, False


class _Tuple(argparse.Action):
    """Keeps several values as a tuple, so that options stay frozen."""

    def __call__(
        self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: str | None = None
    ) -> None:
        setattr(namespace, self.dest, tuple(values))
