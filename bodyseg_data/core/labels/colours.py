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
_STRONG: Final = 0.9
_PALE: Final = 0.4
"""Saturation of pairs, and of classes of the middle."""

_ORDER: Final = ("right", "middle", "left")
_GOLDEN: Final = 0.6180339887
_ROOT: Final = 0.4142135624
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

    Hues are spread evenly over the pairs, and over the classes of the middle, which are paler. Greys are spread evenly
    over all classes: those of the right are the darkest, those of the left the lightest, so that no two classes look
    alike without colour, and exchanged sides show most.
    """
    middle = [side == "middle" for side in sides]
    hues = {}
    for among, offset in ((False, 0.0), (True, 0.5)):
        chosen = list(dict.fromkeys(pair for pair, is_middle in zip(pairs, middle, strict=True) if is_middle == among))
        for pair, place in zip(chosen, _scattered(len(chosen), _GOLDEN), strict=True):
            hues[pair] = (place + offset) / len(chosen)
    scatter = dict(zip(hues, _scattered(len(hues), _ROOT), strict=True))
    order = sorted(range(len(sides)), key=lambda at: (_ORDER.index(sides[at]), scatter[pairs[at]]))
    greys = np.linspace(_DARKEST, _LIGHTEST, len(sides))
    colours = np.zeros((len(sides), 3), np.uint8)
    for at, grey in zip(order, greys.tolist(), strict=True):
        colours[at] = _of_grey(hues[pairs[at]], _PALE if middle[at] else _STRONG, grey)
    return colours


def _scattered(count: int, step: float) -> list[int]:
    """Numbers below `count`, neighbours far apart: the ranks of multiples of `step`, modulo 1."""
    multiples = [number * step % 1 for number in range(count)]
    return [sorted(multiples).index(each) for each in multiples]


def _of_grey(hue: float, saturation: float, grey: float) -> NDArray[np.uint8]:
    """The colour of a hue and saturation, 0 to 1, whose luma is nearest to `grey`; luma grows with lightness."""
    low, high = 0.0, 1.0
    for _ in range(12):
        middle = (low + high) / 2
        if float(255 * np.asarray(colorsys.hls_to_rgb(hue, middle, saturation)) @ _LUMA) < grey:
            low = middle
        else:
            high = middle
    colour: NDArray[np.uint8] = np.rint(255 * np.asarray(colorsys.hls_to_rgb(hue, low, saturation))).astype(np.uint8)
    return colour
