"""Sliders of an artifact's strengths, made from its dataclass's fields that hold numbers.

A slider ends where the field's bounds do (`bounded`), or nearer, at a few times the strength. Artifacts of users get
sliders like those that ship.
"""

import math
import typing
from collections.abc import Iterator
from dataclasses import Field, dataclass, fields, replace
from typing import Any, Final, TypeVar

from bodyseg_data.artifacts import Artifact
from bodyseg_data.core import BadConfig, Bounds, reported

_REACH: Final = 3  # A slider without a nearer limit ends at a round number of at least so many times the strength
_STEPS: Final = 200
_LARGEST: Final = 4
_SMALLEST: Final = -4
_UNITS: Final = ("mm", "cm", "m", "px", "deg")

Kind = TypeVar("Kind", bound=Artifact)


@dataclass(frozen=True)
class Slider:
    """A strength from `low` to `high`, by the name of its field. item: of a tuple of numbers, else None."""

    strength: str
    item: int | None
    low: float
    high: float
    step: float
    whole: bool

    @property
    def label(self) -> str:
        """Name of the strength in words, with the number of the item, from 1 on: "high, mm", "rates 2"."""
        name, _, unit = self.strength.rpartition("_")
        words = f"{name.replace('_', ' ')}, {unit}" if name and unit in _UNITS else self.strength.replace("_", " ")
        return words if self.item is None else f"{words} {self.item + 1}"


def sliders_of(artifact: Artifact) -> Iterator[Slider]:
    """Sliders of all strengths of an artifact that are numbers or tuples of them, in the order of its fields."""
    hints = typing.get_type_hints(type(artifact))
    for field in fields(artifact):
        value = getattr(artifact, field.name)
        if _is_number(value):
            yield _slider(artifact, field, None, value, hints[field.name] is int)
        elif isinstance(value, tuple) and all(map(_is_number, value)):
            for item, each in enumerate(value):
                yield _slider(artifact, field, item, each, isinstance(each, int))


def value_of(artifact: Artifact, slider: Slider) -> float:
    """Value that a slider shows."""
    value: Any = getattr(artifact, slider.strength)
    found: float = value if slider.item is None else value[slider.item]
    return found


def moved(artifact: Kind, slider: Slider, value: float) -> Kind:
    """The artifact with the strength of a slider set to a value.

    Where the artifact refuses that beside another of its numbers, as a low above its high, the other one is set to the
    same value. Raises BadConfig for a value that it refuses in any case.
    """
    new: Any = round(value) if slider.whole else float(value)
    if slider.item is not None:
        held = getattr(artifact, slider.strength)
        new = (*held[: slider.item], new, *held[slider.item + 1 :])
    try:
        return _with(artifact, {slider.strength: new})
    except BadConfig:
        for other in fields(artifact):
            if other.name != slider.strength and _is_number(getattr(artifact, other.name)) and _is_number(new):
                try:
                    return _with(artifact, {slider.strength: new, other.name: new})
                except BadConfig:
                    continue
        raise


def _slider(artifact: Artifact, field: Field[Any], item: int | None, value: float, whole: bool) -> Slider:
    # A strength without bounds may still be refused by the artifact.
    bounds: Bounds = field.metadata.get("bounds") or Bounds(-math.inf, math.inf)
    rounds = [digit * 10.0**power for power in range(_SMALLEST, _LARGEST + 1) for digit in (1, 2, 5)]
    wanted = _REACH * (_reference(artifact, field, value) or min(bounds.high, 1.0) / _REACH)
    round_end = next((number for number in rounds if number >= wanted), bounds.high)
    high = max(bounds.high if bounds.high < 2 * round_end else round_end, value)
    step = 1.0 if whole else max((number for number in rounds if number <= high / _STEPS), default=10.0**_SMALLEST)
    low = max(bounds.low, 0.0)
    low = step if bounds.above and low == bounds.low else low
    return Slider(field.name, item, min(low, value), high, step, whole)


def _reference(artifact: Artifact, field: Any, value: float) -> float:
    """A strength, or its default if that is larger; where both are 0, the artifact's largest number in its unit.

    Of a tuple of strengths, the largest.
    """
    own = max(abs(value), abs(field.default) if _is_number(field.default) else 0.0)
    held = getattr(artifact, field.name)
    if isinstance(held, tuple):
        return float(max(map(abs, held)))
    unit = field.name.rpartition("_")[2]
    alike = (getattr(artifact, each.name) for each in fields(artifact) if each.name.rpartition("_")[2] == unit)
    return own or max((abs(each) for each in alike if _is_number(each)), default=0.0)


def _with(artifact: Kind, strengths: dict[str, Any]) -> Kind:
    """The artifact with other strengths. Raises BadConfig for whatever its class raises."""
    with reported(
        f"{artifact.name} refuses {strengths}", BadConfig, TypeError, ValueError, ArithmeticError, LookupError
    ):
        return replace(artifact, **strengths)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
