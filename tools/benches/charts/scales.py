"""Axes of charts: linear or logarithmic, round ticks, and room for a zero where a logarithm has none."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

from benches.charts.fronts import Axis

_LOG_FROM: Final = 10.0  # largest over smallest
_FEW_DECADES: Final = 2.2
_ROOM: Final = 0.09  # of the axis, on either side of the points
_ROOM_OF_ZERO: Final = 0.5  # decades between zero and the smallest value


@dataclass(frozen=True)
class Scale:
    """Division of an axis, in drawn units. least: the smallest value above zero; zero: whether a zero is shown."""

    log: bool
    zero: bool
    least: float
    low: float
    high: float

    def apply(self, axis: Any, which: str) -> None:
        """Give the axis `which`, "x" or "y", this division."""
        from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator

        line = getattr(axis, f"{which}axis")
        if self.log and self.zero:
            getattr(axis, f"set_{which}scale")("symlog", linthresh=self.least, linscale=_ROOM_OF_ZERO)
        elif self.log:
            getattr(axis, f"set_{which}scale")("log")
        line.set_major_locator(FixedLocator(self.round_values()) if self.log else MaxNLocator(6, steps=(1, 2, 5, 10)))
        line.set_major_formatter(FuncFormatter(lambda value, _: shown(value)))
        axis.minorticks_off()
        getattr(axis, f"set_{which}lim")(self.low, self.high)

    def round_values(self) -> list[float]:
        """Ticks of a logarithmic axis: 1, 2, 5, 10 … or, over many decades, powers of ten; and zero."""
        low = self.least if self.zero else self.low
        factors = (1, 2, 5) if math.log10(self.high / low) < _FEW_DECADES else (1,)
        first, last = math.floor(math.log10(low)), math.ceil(math.log10(self.high))
        values = [factor * 10.0**power for power in range(first, last + 1) for factor in factors]
        return [*([0.0] if self.zero else ()), *(value for value in values if low <= value <= self.high)]


def scale_of(values: Iterable[float], axis: Axis) -> Scale:
    """The division that suits values of at least 0: logarithmic where they span more than a factor of ten."""
    drawn = [value * axis.factor for value in values]
    above = [value for value in drawn if value > 0]
    zero = len(above) < len(drawn)
    least, high = (min(above), max(above)) if above else (1.0, 1.0)
    if high / least > _LOG_FROM:
        decades = math.log10(high / least) + (_ROOM_OF_ZERO if zero else 0)
        room = 10 ** (_ROOM * decades)
        return Scale(True, zero, least, -0.3 * least if zero else least / room, high * room)
    low = 0.0 if zero or not above else least
    room = _ROOM * ((high - low) or high)
    return Scale(False, zero, least, low - room, high + room)


def thousands(value: float, decimals: int = 0) -> str:
    """A number with so many decimals, a blank between thousands and a minus sign; never a negative zero."""
    return f"{value:z,.{decimals}f}".replace(",", " ").replace("-", "−")


def shown(value: float) -> str:
    """A number with six digits at most and a blank between thousands."""
    return f"{value:,.6g}".replace(",", " ")


def axis_title(axis: Axis, apart: str = "   ") -> str:
    """The axis' title with an arrow towards better values; beside a vertical axis the text is turned with its arrow."""
    return f"{axis.title}{apart}({'more is better →' if axis.more_is_better else '← less is better'})"
