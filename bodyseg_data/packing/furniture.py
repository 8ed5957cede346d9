"""Furniture and machines made of cuboids and turned solids: the things that stand around people in a room.

Every thing is drawn from a sequence of raw random words, whose bits NumPy guarantees as it does not those of its
distributions. Its own frame: x to the right, y up, z away from the viewer; it stands on y = 0, around x = z = 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from bodyseg_data.core.randomness import Stream, pixel_draws
from bodyseg_data.meshes.solids import Solid, cuboid, together, turned_solid

_MOST_DRAWS: Final = 1024


class Numbers:
    """Random numbers of one stream, one after another, at most 1024."""

    def __init__(self, stream: Stream) -> None:
        self._words = iter(pixel_draws(stream, _MOST_DRAWS, np.uint32).tolist())

    def between(self, low: float, high: float) -> float:
        """A number, uniform from `low` to `high`."""
        return low + (high - low) * self._word() * 2.0**-32

    def whole(self, low: int, high: int) -> int:
        """A whole number, uniform from `low` to `high`, both included."""
        return low + (self._word() * (high - low + 1) >> 32)

    def _word(self) -> int:
        return int(next(self._words))


def box(numbers: Numbers) -> Solid:
    """A box or a cupboard."""
    width, height, depth = numbers.between(0.3, 1.0), numbers.between(0.3, 1.4), numbers.between(0.25, 0.7)
    return cuboid((width, height, depth), (0.0, height / 2, 0.0))


def table(numbers: Numbers) -> Solid:
    """A table: a top and four legs."""
    width, height, depth = numbers.between(0.7, 1.6), numbers.between(0.45, 1.0), numbers.between(0.5, 0.9)
    return together([_top(width, depth, height, numbers.between(0.02, 0.06)), *_legs(numbers, width, depth, height)])


def chair(numbers: Numbers) -> Solid:
    """A chair: a seat, four legs, and a back that is one board or three."""
    width, height, depth = numbers.between(0.38, 0.6), numbers.between(0.4, 0.52), numbers.between(0.38, 0.55)
    pieces = [_top(width, depth, height, numbers.between(0.03, 0.1)), *_legs(numbers, width, depth, height)]
    rise, boards = numbers.between(0.3, 0.65), (1, 3)[numbers.whole(0, 1)]
    for board in range(boards):
        tall = rise if boards == 1 else rise / 5
        middle = height + rise / 2 if boards == 1 else height + rise * (0.1 + 0.4 * board)
        pieces.append(cuboid((width, tall, 0.04), (0.0, middle, depth / 2 - 0.02)))
    if boards == 3:
        away = width / 2 - 0.02
        pieces += [cuboid((0.04, rise, 0.04), (x, height + rise / 2, depth / 2)) for x in (-away, away)]
    return together(pieces)


def bed(numbers: Numbers) -> Solid:
    """A bed: a mattress on a frame, and a board at its head."""
    width, depth, height = numbers.between(1.6, 2.1), numbers.between(0.8, 1.2), numbers.between(0.4, 0.8)
    under, head = numbers.between(0.0, 0.25), height + numbers.between(0.1, 0.5)
    pieces = [
        cuboid((width, height - under, depth), (0.0, (height + under) / 2, 0.0)),
        cuboid((0.05, head, depth), (-width / 2, head / 2, 0.0)),
    ]
    return together([*pieces, *_legs(numbers, width, depth, under)] if under > 0.05 else pieces)


def machine(numbers: Numbers) -> Solid:
    """A machine: a foot, a column, and two to four boxes, held out to the sides or to the front."""
    height, foot = numbers.between(0.9, 1.8), numbers.between(0.35, 0.7)
    thick = numbers.between(0.08, 0.3)
    pieces = [
        cuboid((foot, 0.12, foot), (0.0, 0.06, 0.0)),
        cuboid((thick, height, thick), (0.0, height / 2, 0.0)),
    ]
    for _ in range(numbers.whole(2, 4)):
        size = numbers.between(0.15, 0.6), numbers.between(0.08, 0.4), numbers.between(0.1, 0.4)
        out, above = numbers.between(-0.3, 0.3), numbers.between(0.3, 1.0) * height
        pieces.append(cuboid(size, (out, above, numbers.between(-0.2, 0.1))))
    return together(pieces)


def plank(numbers: Numbers) -> Solid:
    """A board at some height that hides what is behind it, such as a rail, a tray or the arm of a machine."""
    width, height = numbers.between(0.6, 1.8), numbers.between(0.06, 0.35)
    return cuboid((width, height, 0.04), (0.0, numbers.between(0.2, 1.6), 0.0))


def bin_(numbers: Numbers) -> Solid:
    """A bin, a barrel or a round stool."""
    height, low, high = numbers.between(0.35, 1.1), numbers.between(0.12, 0.35), numbers.between(0.12, 0.35)
    return turned_solid([(low, 0.0), (high, height)])


def plant(numbers: Numbers) -> Solid:
    """A plant or a large ball: an ellipsoid crown on a pot."""
    pot, across, tall = numbers.between(0.15, 0.5), numbers.between(0.2, 0.5), numbers.between(0.25, 0.7)
    angles = [math.pi * step / 12 for step in range(1, 12)]
    crown = [(across * math.sin(angle), pot + tall * (1 - math.cos(angle))) for angle in angles]
    return together([turned_solid([(0.12, 0.0), (0.16, pot)]), turned_solid(crown)])


def lamp(numbers: Numbers) -> Solid:
    """A lamp on a pole, or a stand with a hat or an umbrella."""
    height, shade = numbers.between(1.0, 1.8), numbers.between(0.15, 0.35)
    pole = turned_solid([(0.15, 0.0), (0.15, 0.03), (0.03, 0.05), (0.03, height - 0.1)])
    return together([pole, turned_solid([(shade, height - 0.3), (shade * numbers.between(0.3, 1.0), height)])])


FURNITURE: Final[dict[str, Callable[[Numbers], Solid]]] = {
    "box": box,
    "table": table,
    "chair": chair,
    "bed": bed,
    "machine": machine,
    "bin": bin_,
    "plant": plant,
    "lamp": lamp,
    "plank": plank,
}
"""Name -> a thing of that kind, drawn anew."""


def _top(width: float, depth: float, height: float, thick: float) -> Solid:
    return cuboid((width, thick, depth), (0.0, height - thick / 2, 0.0))


def _legs(numbers: Numbers, width: float, depth: float, height: float) -> list[Solid]:
    thick = numbers.between(0.03, 0.08)
    away = (width - thick) / 2, (depth - thick) / 2
    return [cuboid((thick, height, thick), (x * away[0], height / 2, z * away[1])) for x in (-1, 1) for z in (-1, 1)]
