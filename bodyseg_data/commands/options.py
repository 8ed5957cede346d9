"""Command lines from frozen dataclasses: one a command, which alone holds the defaults, for shell and code."""

from __future__ import annotations

import contextlib
import dataclasses
import inspect
import io
import os
import re
import sys
import types
import typing
from collections.abc import Sequence
from dataclasses import MISSING
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar

import bodyseg_data
from bodyseg_data.core import BadConfig
from bodyseg_data.files import last_name

if TYPE_CHECKING:
    from cyclopts import App

Options = TypeVar("Options")

OCCLUDER_HELP: Final = "projector's range to use: the stored one, or one made of what the camera sees"
WHERE_HELP: Final = "conditions that samples must all meet, like 'distance_cm<=255' 'subject=B,C'"
"""Help of `--where`, the option of commands that read a set."""

_NEGATIVE_RANGE: Final = re.compile(r"-[0-9]+\.\.[+-]?[0-9]+")


def option(
    text: str,
    default: Any = MISSING,
    positional: bool = False,
    address: bool = False,
    flag: str | None = None,
    heading: str | None = None,
) -> Any:
    """Declare a field of an options class: its help text and its default (none: required).

    positional: given without a flag. address: its text is a path or an address. flag: its name on the command line if
    that differs from the field's, as `lr` for `learning_rate`. heading: in the help, above this and later options.
    """
    metadata = {"help": text, "positional": positional, "address": address, "flag": flag, "heading": heading}
    return dataclasses.field(default=default, metadata=metadata)


def parse(kind: type[Options], arguments: Sequence[str], program: str, summary: str, example: str) -> Options | None:
    """Read a command line into `kind`, a dataclass whose fields are made by `option`; None after printing `--help`.

    Fields may be str, int, float, Path, bool (a switch), a Literal, any of them or None, or a tuple of one kind
    (several values). Raises BadConfig with one line for a bad argument.
    """
    from cyclopts import CycloptsError, MissingArgumentError

    if os.environ.get("COLUMNS") in ("0", "1", "2"):  # a terminal of unknown width: cyclopts would wrap without end
        del os.environ["COLUMNS"]
    parser = command_parser(kind, program, summary, example)
    page = io.StringIO()  # written below: rich would end a program whose output is closed with its own exit status
    try:
        with contextlib.redirect_stdout(page):
            options: Options | None = parser(
                _with_ranges(arguments), result_action="return_value", exit_on_error=False, print_error=False
            )
    except CycloptsError as error:
        wrong = str(error).rstrip(".").replace("Unused Tokens:", "no option takes")
        if isinstance(error, MissingArgumentError) and error.keyword is None:  # the option was not given at all
            taken = "" if "--" in wrong or not arguments else ", or taken by an option before it: give it first"
            wrong = wrong.replace("requires an argument", f"is missing{taken}")
        raise BadConfig(f"{wrong} (see {program} --help)") from None
    sys.stdout.write("".join(f"{line.rstrip()}\n" for line in page.getvalue().splitlines()))
    return options


def _with_ranges(arguments: Sequence[str]) -> list[str]:
    """`--pitch -30..10` as `--pitch=-30..10`: cyclopts takes a word with a hyphen for a flag unless it is a number."""
    words: list[str] = []
    for word in arguments:
        if _NEGATIVE_RANGE.fullmatch(word) and words and words[-1].startswith("--"):
            word = f"{words.pop()}={word}"
        words.append(word)
    return words


def command_parser(kind: type[Any], program: str, summary: str, example: str) -> App:
    """Return the parser of one command: called with words, it returns a `kind`.

    cyclopts is imported here, not above: streaming and the list of commands do not need its 70 ms.
    """
    from cyclopts import App, Group
    from cyclopts.help import DefaultFormatter, PanelSpec
    from rich.box import Box

    hints, above = typing.get_type_hints(kind), headings(kind)
    groups = {text: Group(text, sort_key=number) for number, text in enumerate(filter(None, above.values()))}
    fields = sorted(dataclasses.fields(kind), key=lambda field: not field.metadata["positional"])

    def read(*values: Any, **named: Any) -> Any:
        return kind(**{field.name: value for field, value in zip(fields, values, strict=False)}, **named)

    # A function stands for the dataclass, none of whose fields could be positional only.
    parameters = [_parameter(field, hints[field.name], groups.get(above[field.name] or "")) for field in fields]
    read.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    columns = DefaultFormatter(panel_spec=PanelSpec(box=Box("    \n" * 8), padding=0))  # without lines around them
    app = App(
        program,
        summary,
        help_epilogue=f"example:\n  {example}",
        help_format="plaintext",
        help_formatter=columns,
        version=version_line,
        suppress_keyboard_interrupt=False,
    )
    for name in ("--help", "--version"):
        app[name].show = False
    app.default(read)
    return app


def version_line() -> str:
    """Return the line that `--version` prints."""
    return f"bodyseg {bodyseg_data.__version__}"


def command_line(program: str, options: Any) -> str:
    """Return the command line that gives these options, to be stored with results.

    Paths are shortened to their last names, to keep this machine's folders out of published results; see `last_name`.
    """
    hints = typing.get_type_hints(type(options))
    words = [program]
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if value == field.default:
            continue
        values = value if isinstance(value, tuple) else (value,)
        named = field.metadata["address"] or _kind(hints[field.name])[0] is Path
        texts = [last_name(str(each)) if named else str(each) for each in values]
        if not field.metadata["positional"]:
            words.append(flag_of(field))
        if hints[field.name] is not bool:
            words += texts
    return " ".join(words)


def flag_of(field: dataclasses.Field[Any]) -> str:
    """Return the field's flag on the command line."""
    return "--" + (field.metadata["flag"] or field.name.replace("_", "-"))


def headings(kind: type[Any]) -> dict[str, str | None]:
    """Return the heading of the help under which each field stands, by name; None above the first heading."""
    found, heading = dict[str, str | None](), None
    for field in dataclasses.fields(kind):
        found[field.name] = heading = field.metadata["heading"] or heading
    return found


def _parameter(field: dataclasses.Field[Any], hint: Any, group: Any) -> inspect.Parameter:
    from cyclopts import Parameter, convert

    kind, many = _kind(hint)
    positional, default = field.metadata["positional"], field.default
    shown = " ".join(map(str, default)) if isinstance(default, tuple) else str(default)
    settings = Parameter(
        name=None if positional else flag_of(field),
        help=field.metadata["help"],
        **({} if group is None else {"group": group}),
        converter=partial(convert, converter=_value),
        consume_multiple=(1, None),
        allow_repeating=True,  # the last one counts
        negative=(),
        show_default=False if default is False or default in (None, ()) else shown,
    )
    return inspect.Parameter(
        field.name,
        inspect.Parameter.POSITIONAL_ONLY if positional else inspect.Parameter.KEYWORD_ONLY,
        default=inspect.Parameter.empty if default is MISSING else default,
        annotation=Annotated[types.GenericAlias(tuple, (kind, ...)) if many else kind, settings],
    )


def _value(kind: Any, text: str) -> Any:
    """Convert one value. cyclopts alone would round 2.7 to a whole number, and take an empty path for this folder."""
    if kind is Path and not text:
        raise ValueError
    if kind is Path and "://" in text:  # it would be a folder "s3:" here
        raise BadConfig(f"a file or folder of this machine is needed, found the address {last_name(text)}")
    return kind(text)


def _kind(hint: Any) -> tuple[Any, bool]:
    """Return the type of one value, and True if several may be given."""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        (hint,) = (part for part in typing.get_args(hint) if part is not type(None))
    if typing.get_origin(hint) is tuple:
        return typing.get_args(hint)[0], True
    return hint, False
