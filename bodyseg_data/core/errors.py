"""Errors that users meet, all derived from `BodysegError`, and checks of arguments' types.

Every message is one line: the rule that was broken, the value found, and where. Commands print that line and exit with
status 2; code that uses the library can catch `BodysegError` or one of its subclasses.
"""

import math
import traceback
import types
import typing
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields
from functools import cache
from numbers import Integral, Real
from typing import Any, Final, Literal, TypeVar

_LONGEST: Final = 1000

Choice = TypeVar("Choice")


def one_line(text: str) -> str:
    """Return `text` with unprintable characters escaped and, beyond 1000 characters, without its middle."""
    if len(text) > _LONGEST:
        text = f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


class BodysegError(Exception):
    """Base of every error that this project raises on purpose; its text is always one printable line."""

    def __str__(self) -> str:
        return one_line(super().__str__())

    @staticmethod
    def words_of(error: BaseException) -> str:
        """Type and text of an error of any code, in one line; the type alone where asking for the text fails."""
        with suppress(Exception):
            return " ".join(f"{type(error).__name__}: {error}".split())
        return type(error).__name__

    @classmethod
    @contextmanager
    def named(cls, where: str, passes: "type[BodysegError] | None" = None) -> Iterator[None]:
        """Raise whatever a user's code raises as this class, with `where` before the words and the traceback as a note;
        errors of this package, or those of the kind `passes` alone, stay as they are.
        """
        try:
            yield
        except Exception as error:
            if isinstance(error, passes or BodysegError):
                raise
            failed = cls(f"{where}: {cls.words_of(error)}")
            failed.add_note("".join(traceback.format_exception(error)))
            raise failed from error


class BadConfig(BodysegError):
    """An option, a rig file or a combination of arguments breaks a rule."""


class BadMesh(BodysegError):
    """A body cannot be used as a surface: empty, not finite, not human-sized, inside out."""


class BadLandmarks(BodysegError):
    """A landmark set does not give 33 usable points on its mesh."""


class BadSample(BodysegError):
    """One sample's bytes or arrays break the format."""


class BadShard(BodysegError):
    """A shard or its manifest is cut, altered, or of another format."""


class MissingLibrary(BodysegError, ImportError):
    """An optional package or a system library that the chosen feature needs is not installed."""


@contextmanager
def reported(where: object, raises: type[Exception], *caught: type[Exception]) -> Iterator[None]:
    """Raise exceptions of the kinds `caught`, else of that of `raises`, as `raises`, their words after `where`, if any.

    Named as a kind, OSError loses its number and file.
    """
    kinds = caught or (raises,)
    try:
        yield
    except kinds as error:
        words = error.strerror if isinstance(error, OSError) and OSError in kinds else None
        raise raises(f"{where}: {words or str(error) or type(error).__name__}" if where else str(error)) from error


def check_int(name: str, value: Any, least: int, most: float = math.inf) -> int:
    """Return `value` as an int. Raises BadConfig, calling it `name`, unless it is a whole number, `least` to `most`.

    A bool is refused; NumPy's integers are accepted.
    """
    if isinstance(value, bool) or not isinstance(value, Integral) or not least <= int(value) <= most:
        rule = f"of at least {least}" if most == math.inf else f"from {least} to {most}"
        raise BadConfig(f"{name} must be a whole number {rule}, found {value!r}")
    return int(value)


def check_choice(name: str, value: Any, choices: Iterable[Choice], raises: type[Exception] = BadConfig) -> Choice:
    """Return the one of `choices` that `value` is. Raises an error of the kind `raises`, calling it `name`, if none."""
    known = tuple(choices)
    if value not in known:
        raise raises(f"{name} must be one of {', '.join(map(str, known)) or 'none'}, found {value!r}")
    return known[known.index(value)]


def check_class(name: str, value: object, *classes: type) -> None:
    """Raise BadConfig, calling it `name`, unless `value` is of one of `classes`."""
    if not isinstance(value, classes):
        raise BadConfig(f"{name} must be {' or '.join(map(_in_words, classes))}, found {value!r:.100}")


@dataclass(frozen=True)
class Bounds:
    """Finite numbers from `low` to `high` that a field may hold; above: without `low` itself."""

    low: float
    high: float = math.inf
    above: bool = False

    def take(self, number: float) -> bool:
        """Return whether a number lies within. NaN never does."""
        return (self.low < number if self.above else self.low <= number) and number <= self.high and number < math.inf

    def __str__(self) -> str:
        if self.high == math.inf:
            return f"{'above' if self.above else 'at least'} {self.low:g}"
        return f"{'above' if self.above else 'from'} {self.low:g} {'and at most' if self.above else 'to'} {self.high:g}"


def bounded(
    default: Any, low: float, high: float = math.inf, *, above: bool = False, not_below: str | None = None
) -> Any:
    """Declare a dataclass's field whose number, or each number of a tuple, lies within `Bounds`; None may stand.

    default: `dataclasses.MISSING` for a field that must be given. not_below: name of a field whose number, unless None,
    needs one here that is as large or larger.
    """
    return field(default=default, metadata={"bounds": Bounds(low, high, above), "not_below": not_below})


def check_fields(options: Any) -> None:
    """Raise BadConfig unless every field of a dataclass holds a value of its type, within its bounds (`bounded`).

    Numbers may be of NumPy, a whole number may stand for a float, and a list for a tuple, which the field then holds as
    what its type says, so that they are stored alike; a bool is no number.
    """
    kind: Any = type(options)
    hints = _hints_of(kind)
    for each in fields(options):
        given, bounds = getattr(options, each.name), each.metadata.get("bounds")
        if (value := _as(given, hints[each.name])) is _UNFIT:
            wanted = _in_words(hints[each.name])
            raise BadConfig(f"{kind.__name__}: {each.name} must be {wanted}, found {given!r:.100}")
        numbers = value if isinstance(value, tuple) else () if value is None else (value,)
        if bounds is not None and not all(map(bounds.take, numbers)):
            raise BadConfig(f"{kind.__name__}: {each.name} must be {bounds}, found {given!r:.100}")
        object.__setattr__(options, each.name, value)  # also of a frozen one
    for each in fields(options):
        if (lower := each.metadata.get("not_below")) is not None:
            least, most = getattr(options, lower), getattr(options, each.name)
            if least is not None and (most is None or least > most):
                raise BadConfig(f"{kind.__name__}: {lower} must be at most {each.name}, found {least} and {most}")


@dataclass(frozen=True)
class Checked:
    """Base of frozen dataclasses whose fields `check_fields` checks when one is made."""

    def __post_init__(self) -> None:
        """Raise BadConfig for a value of another type than its field's, or out of its bounds (`bounded`)."""
        check_fields(self)


_hints_of: Final = cache(typing.get_type_hints)
_UNFIT: Final = object()


def _as(value: Any, kind: Any) -> Any:
    """The value converted to a field's type, `_UNFIT` if it does not fit; an int too large for a float stays an int."""
    choices, origin = typing.get_args(kind), typing.get_origin(kind)
    if kind in (float, int):
        is_number = isinstance(value, Real if kind is float else Integral) and not isinstance(value, bool)
        if not is_number:
            return _UNFIT
        return value if type(value) is int and abs(value) > 1e308 else kind(value)
    if origin in (types.UnionType, typing.Union):
        return next((found for choice in choices if (found := _as(value, choice)) is not _UNFIT), _UNFIT)
    if origin is tuple and isinstance(value, tuple | list):
        kinds = choices[:1] * len(value) if choices[1:] == (...,) else choices
        found = tuple(map(_as, value, kinds))
        return _UNFIT if len(value) != len(kinds) or any(each is _UNFIT for each in found) else found
    is_choice = origin is Literal and isinstance(value, str | int) and value in choices
    fits = is_choice or kind is Any or (origin is not Literal and isinstance(value, origin or kind))
    return value if fits else _UNFIT


_WORDS: Final = {float: "a number", int: "a whole number", str: "text", bool: "True or False", types.NoneType: "None"}


def _in_words(kind: Any) -> str:
    choices = typing.get_args(kind)
    if typing.get_origin(kind) is Literal:
        return " or ".join(map(repr, choices))
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        return " or ".join(map(_in_words, choices))
    if typing.get_origin(kind) is tuple:
        inner = [_in_words(choice) for choice in choices if choice is not ...]
        return f"a tuple, each entry {inner[0]}" if choices[1:] == (...,) else f"a tuple of {' and '.join(inner)}"
    return _WORDS.get(kind) or f"of class {getattr(kind, '__name__', kind)}"
