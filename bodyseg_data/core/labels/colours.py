"""Colours of classes: hues for pairs, the left one of a pair lighter, and every class another grey."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.parts import Side

_DARKEST: Final = 70.0
_LIGHTEST: Final = 225.0
_SATURATION: Final = 0.75
_LUMA: Final = np.array([0.299, 0.587, 0.114])  # of Rec. ITU-R BT.601


def luma(colours: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Grey of colours as they look without colour, float64 [N], 0 to 255.

    colours: sRGB uint8 [N, 3].
    """
    grey: NDArray[np.float64] = colours @ _LUMA
    return grey


def class_colours(sides: Sequence[Side], pairs: Sequence[int]) -> NDArray[np.uint8]:
    """Colours of classes, sRGB uint8 [N, 3].

    sides: of each class, "middle" for one that is its own mirror image. pairs: a number for each class, equal for the
    two classes of a pair.

    Hues are spread evenly over the pairs, and each is as far from the one before as can be. Greys are spread evenly
    over the classes: those of the right are the darkest, those of the left the lightest, so that no two classes look
    alike without colour, and exchanged sides show most.
    """
    hues = {pair: place for place, pair in enumerate(dict.fromkeys(pairs))}
    order = sorted(
        range(len(sides)),
        key=lambda at: (("right", "middle", "left").index(sides[at]), _scattered(hues[pairs[at]])),
    )
    greys = np.linspace(_DARKEST, _LIGHTEST, len(sides))
    colours = np.zeros((len(sides), 3), np.uint8)
    for place, at in enumerate(order):
        colours[at] = _of_grey(_golden(hues[pairs[at]]), float(greys[place]))
    return colours


def _golden(place: int) -> float:
    """Hue number `place` of a sequence that is spread evenly wherever it ends: steps of the golden ratio."""
    return place * 0.6180339887 % 1


def _scattered(place: int) -> float:
    """Sort key that puts neighbouring numbers apart: steps of the square root of two."""
    return place * 0.41421356237 % 1


def _of_grey(hue: float, grey: float) -> NDArray[np.uint8]:
    """The colour of a hue, 0 to 1, whose luma is nearest to `grey`: it grows with lightness, which is bisected."""
    low, high = 0.0, 1.0
    for _ in range(12):
        middle = (low + high) / 2
        if float(255 * np.asarray(colorsys.hls_to_rgb(hue, middle, _SATURATION)) @ _LUMA) < grey:
            low = middle
        else:
            high = middle
    colour: NDArray[np.uint8] = np.rint(255 * np.asarray(colorsys.hls_to_rgb(hue, low, _SATURATION))).astype(np.uint8)
    return colour
