"""The 33 body parts and their colours: the classes of the sets that this package packs from bodies.

A part is the surface nearest to one anatomical landmark. Landmark names are spelled as the CAESAR survey spells
them; a part's index in `PARTS` is its label. "Rt." and "Lt." are the subject's own right and left. Colours are hues for
pairs, the left one of a pair lighter.
"""

import colorsys
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.labels.classes import Classes, LabelClass, Side

Face = Literal["front", "back", "both"]

_PAIR_HUES: Final = (2, 10, 5, 12, 8, 4, 11, 7, 0, 3, 9, 6, 1)


@dataclass(frozen=True)
class Part:
    """One body part.

    label: value of its pixels in a label image. landmark: name of its landmark. location: where the landmark lies, in
    words. side: of the subject's own body. face: whether it lies on the front or the back of trunk, head and knees.
    mirror: label of its counterpart on the other side, its own label if it lies in the middle.
    """

    label: int
    landmark: str
    location: str
    side: Side
    face: Face
    mirror: int


def _part(label: int, landmark: str, location: str, face: Face) -> Part:
    return Part(label, landmark, location, "middle", face, label)


def _pair(label: int, landmark: str, location: str, face: Face) -> tuple[Part, Part]:
    return (
        Part(label, f"Rt. {landmark}", location, "right", face, label + 1),
        Part(label + 1, f"Lt. {landmark}", location, "left", face, label),
    )


PARTS: Final[tuple[Part, ...]] = (
    _part(0, "Sellion", "deepest point of the bridge of the nose", "front"),
    _part(1, "Nuchale", "back of the head, lowest point of the occipital bone", "back"),
    _part(2, "Supramenton", "below the lower lip", "front"),
    _part(3, "Suprasternale", "notch at the top of the breastbone", "front"),
    *_pair(4, "Thelion/Bustpoint", "nipple", "front"),
    _part(6, "Substernale", "lower end of the breastbone", "front"),
    *_pair(7, "ASIS", "front tip of the pelvic crest", "front"),
    _part(9, "Cervicale", "seventh neck vertebra", "back"),
    _part(10, "10th Rib Midspine", "on the spine at the height of the tenth rib", "back"),
    *_pair(11, "PSIS", "dimple at the back of the pelvis", "back"),
    *_pair(13, "Axilla, Post.", "rear fold of the armpit", "back"),
    *_pair(15, "Acromion", "tip of the shoulder", "both"),
    *_pair(17, "Olecranon", "point of the elbow", "both"),
    *_pair(19, "Radial Styloid", "thumb side of the wrist", "both"),
    *_pair(21, "Dactylion", "tip of the middle finger", "both"),
    *_pair(23, "Trochanterion", "side of the hip", "both"),
    *_pair(25, "Femoral Lateral Epicn", "outer side of the knee", "front"),
    *_pair(27, "Knee Crease", "back of the knee", "back"),
    *_pair(29, "Lateral Malleolus", "outer ankle bone", "both"),
    *_pair(31, "Digit II", "tip of the second toe", "both"),
)
"""The 33 parts in the order of their labels."""

PART_COUNT: Final = len(PARTS)
LANDMARKS: Final[tuple[str, ...]] = tuple(part.landmark for part in PARTS)


def _part_colours() -> NDArray[np.uint8]:
    """Colours of the parts, sRGB, uint8 [33, 3].

    The 13 pairs have 13 hues, assigned so that adjacent parts are at least three hues apart. Left and right of a pair
    share the hue, the left one lighter: exchanged sides show as a change of lightness, which is also visible in grey
    and to the colour-blind. The 7 parts of the middle have a third lightness.
    """
    colours = np.zeros((PART_COUNT, 3), np.uint8)
    pairs = middles = 0
    for part in PARTS:
        if part.side == "middle":
            hls = ((middles * 3 % 7) / 7 + 0.1, 0.55, 0.95)
            middles += 1
        else:
            hls = (_PAIR_HUES[pairs] / 13, 0.4 if part.side == "right" else 0.7, 0.9)
            pairs += part.side == "left"
        colours[part.label] = np.rint(255 * np.asarray(colorsys.hls_to_rgb(*hls)))
    return colours


COLOURS: Final = _part_colours()
"""sRGB of every part, uint8 [33, 3]."""


def _as_class(part: Part) -> LabelClass:
    red, green, blue = COLOURS[part.label].tolist()
    mirror = None if part.side == "middle" else LANDMARKS[part.mirror]
    return LabelClass(part.landmark, mirror, f"#{red:02x}{green:02x}{blue:02x}", side=part.side)


PART_CLASSES: Final = Classes("parts33", tuple(map(_as_class, PARTS)))
"""The 33 parts as the classes of a set."""
