"""Controls of an artifact's strengths, made from its dataclass's fields: sliders, choices and texts.

A slider ends where the field's bounds do (`bounded`), or nearer, at a few times the strength. Artifacts of users get
sliders like those that ship.
"""

import math
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, Final, Literal, TypeVar

from bodyseg_data.artifacts import Artifact, Bounds
from bodyseg_data.core import BadConfig

_REACH: Final = 3  # A slider without a nearer limit ends at a round number of at least so many times the strength
_STEPS: Final = 200
_LARGEST: Final = 4
_SMALLEST: Final = -4
_SEPARATOR: Final = ";"
_UNITS: Final = ("mm", "cm", "m", "px", "deg")

Kind = TypeVar("Kind", bound=Artifact)


@dataclass(frozen=True)
class Labelled:
    """The control of one strength, by the name of its field."""

    strength: str

    @property
    def label(self) -> str:
        """Name of the strength in words."""
        return _words(self.strength)


@dataclass(frozen=True)
class Slider(Labelled):
    """A number from `low` to `high`. item: of a tuple of numbers, else None."""

    item: int | None
    low: float
    high: float
    step: float
    whole: bool

    @property
    def label(self) -> str:
        """Name of the strength in words, with the number of the item, from 1 on: "high, mm", "rates 2"."""
        return super().label if self.item is None else f"{super().label} {self.item + 1}"


@dataclass(frozen=True)
class Choice(Labelled):
    """One of several values."""

    values: tuple[Any, ...]


@dataclass(frozen=True)
class TextEntry(Labelled):
    """A text; empty for None or an empty tuple. several: whether it holds values with semicolons between them."""

    several: bool
    numbers: bool


Control = Slider | Choice | TextEntry


def controls_of(artifact: Artifact) -> tuple[Control, ...]:
    """Controls of all strengths of an artifact, in the order of its fields."""
    hints = typing.get_type_hints(type(artifact))
    return tuple(each for field in fields(artifact) for each in _controls(artifact, field.name, hints[field.name]))


def value_of(artifact: Artifact, control: Control) -> Any:
    """Value that a control shows: a number, one of the choices, or text."""
    value = getattr(artifact, control.strength)
    if isinstance(control, TextEntry):
        if control.several:
            return f"{_SEPARATOR} ".join(f"{each:g}" if control.numbers else str(each) for each in value or ())
        return "" if value is None else f"{value:g}" if control.numbers else str(value)
    return value[control.item] if isinstance(control, Slider) and control.item is not None else value


def moved(artifact: Kind, control: Control, value: Any) -> Kind:
    """The artifact with the strength of a control set to a value, as `value_of` returns it.

    Where the artifact refuses that beside another of its numbers, as a low above its high, the other one is set to the
    same value. Raises BadConfig for a value that it refuses in any case.
    """
    new = _parsed(artifact, control, value)
    try:
        return _with(artifact, {control.strength: new})
    except BadConfig:
        for other in fields(artifact):
            if other.name != control.strength and _is_number(getattr(artifact, other.name)) and _is_number(new):
                try:
                    return _with(artifact, {control.strength: new, other.name: new})
                except BadConfig:
                    continue
        raise


def _controls(artifact: Artifact, name: str, hint: Any) -> Iterator[Control]:
    value = getattr(artifact, name)
    optional = typing.get_origin(hint) in (types.UnionType, typing.Union)
    kinds = typing.get_args(hint) if optional else (hint,)
    kind = next(each for each in kinds if each is not type(None))
    if kind is bool or typing.get_origin(kind) is Literal:
        listed = (False, True) if kind is bool else typing.get_args(kind)
        yield Choice(name, (*listed, None) if optional else listed)
    elif _is_number(value) and not optional:
        yield _number(artifact, name, None, value, kind is int)
    elif isinstance(value, tuple) and value and all(map(_is_number, value)) and not optional:
        for item, each in enumerate(value):
            yield _number(artifact, name, item, each, isinstance(each, int))
    else:
        several = typing.get_origin(kind) is tuple
        held = typing.get_args(kind)[0] if several else kind
        yield TextEntry(name, several, held in (int, float))


def _number(artifact: Artifact, name: str, item: int | None, value: float, whole: bool) -> Slider:
    bounds = _bounds(artifact, name)
    rounds = [digit * 10.0**power for power in range(_SMALLEST, _LARGEST + 1) for digit in (1, 2, 5)]
    wanted = _REACH * (_reference(artifact, name, value) or min(bounds.high, 1.0) / _REACH)
    round_end = next((number for number in rounds if number >= wanted), bounds.high)
    high = max(bounds.high if bounds.high < 2 * round_end else round_end, value)
    step = 1.0 if whole else max((number for number in rounds if number <= high / _STEPS), default=10.0**_SMALLEST)
    low = max(bounds.low, 0.0)
    low = step if bounds.above and low == bounds.low else low
    return Slider(name, item, min(low, value), high, step, whole)


def _bounds(artifact: Artifact, name: str) -> Bounds:
    """Bounds that the artifact declares (`bounded`), or none: it may still refuse to be moved somewhere."""
    found: Bounds | None = next(each for each in fields(artifact) if each.name == name).metadata.get("bounds")
    return found or Bounds(-math.inf, math.inf)


def _reference(artifact: Artifact, name: str, value: float) -> float:
    """A strength, or its default if that is larger; where both are 0, the artifact's largest number in its unit.

    Of a tuple of strengths, the largest.
    """
    default: Any = next(each.default for each in fields(artifact) if each.name == name)
    own = max(abs(value), abs(default) if _is_number(default) else 0.0)
    held = getattr(artifact, name)
    if isinstance(held, tuple):
        return float(max(map(abs, held)))
    unit = name.rpartition("_")[2]
    alike = (getattr(artifact, each.name) for each in fields(artifact) if each.name.rpartition("_")[2] == unit)
    return own or max((abs(each) for each in alike if _is_number(each)), default=0.0)


def _parsed(artifact: Artifact, control: Control, value: Any) -> Any:
    """The value of a field from that of its control. Raises BadConfig for text that is no number where one is due."""
    if isinstance(control, Slider):
        number = round(value) if control.whole else float(value)
        if control.item is None:
            return number
        held = list(getattr(artifact, control.strength))
        held[control.item] = number
        return tuple(held)
    if isinstance(control, Choice):
        return value
    words = [word.strip() for word in str(value).split(_SEPARATOR)] if control.several else [str(value).strip()]
    words = [word for word in words if word]
    try:
        read = tuple(float(word) if control.numbers else word for word in words)
    except ValueError:
        raise BadConfig(f"{control.label} of {artifact.name} must be a number, found {value!r}") from None
    if not read:
        optional = type(None) in typing.get_args(typing.get_type_hints(type(artifact))[control.strength])
        return None if optional or not control.several else ()
    return read if control.several else read[0]


def _with(artifact: Kind, strengths: dict[str, Any]) -> Kind:
    """The artifact with other strengths. Raises BadConfig for whatever its class raises."""
    try:
        return replace(artifact, **strengths)
    except (TypeError, ValueError, ArithmeticError, LookupError) as error:
        raise BadConfig(f"{artifact.name} refuses {strengths}: {error}") from error


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _words(strength: str) -> str:
    name, _, unit = strength.rpartition("_")
    if name and unit in _UNITS:
        return f"{name.replace('_', ' ')}, {unit}"
    return strength.replace("_", " ")
