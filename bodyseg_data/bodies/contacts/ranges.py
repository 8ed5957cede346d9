"""Ranges of the joints, and draws within ranges."""

from __future__ import annotations

from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

Name = TypeVar("Name", bound=str)

Ranges = dict[str, tuple[float, float]]
"""Least and most of an angle in degrees, or of a length in metres, by its name."""

ARM: Final[Ranges] = {
    "flex": (-60, 175), "abduct": (-30, 150), "twist": (-70, 90), "elbow": (0, 148), "supinate": (-80, 80),
    "wrist": (-60, 65),
}  # fmt: skip
LOADED_WRIST: Final = (-88.0, 65.0)
"""Of a hand that carries weight on the floor."""

LEG: Final[Ranges] = {
    "flex": (-25, 128), "abduct": (-28, 45), "twist": (-40, 45), "knee": (0, 135), "ankle": (-25, 48),
}  # fmt: skip
"""With those of the arm: ranges of healthy adults (docs/reference/open_bodies.md), a little narrower."""

CROSSED_TWIST: Final = (-40.0, 75.0)
"""Outward turn of the hips of people who sit with crossed legs, which goes beyond that of a straight leg."""

MOST_RAISED: Final = 185.0
"""Sum of an arm's flexion and abduction beyond which the shoulder would have to turn over."""


def within(ranges: Ranges, draws: np.random.Generator) -> dict[str, Any]:
    """Draw every value uniformly within its range."""
    return {name: uniform(draws, low, high) for name, (low, high) in ranges.items()}


def mostly_middle(ranges: Ranges, draws: np.random.Generator) -> dict[str, Any]:
    """Draw every value within its range, from a triangular distribution: the middle most often, the ends least."""
    return {name: uniform(draws, low, high) / 2 + uniform(draws, low, high) / 2 for name, (low, high) in ranges.items()}


def uniform(draws: np.random.Generator, low: float, high: float) -> float:
    """Draw a number from `low` to `high`."""
    return float(low + (high - low) * draws.random())


def one_of(vertices: NDArray[np.int64], draws: np.random.Generator) -> int:
    """Draw one of some vertices, each as likely."""
    return int(vertices[int(draws.random() * len(vertices))])


def chosen(weights: dict[Name, float], draws: np.random.Generator) -> Name:
    """Draw a name with a chance in proportion to its weight."""
    sums = np.cumsum([*weights.values()])
    return [*weights][int(np.searchsorted(sums, draws.random() * sums[-1], side="right"))]
