"""Classes of a set: what the label of a pixel means, with colours and mirror images.

Files hold 0 to 253 for classes, `UNLABELLED` on a surface that has none, and `BACKGROUND` where nothing was measured.
"""

import colorsys
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, reported

Side = Literal["left", "right", "middle"]

BACKGROUND: Final = 255
"""The label of a pixel that shows nothing, or nothing that has a class; ignored by every loss and score."""

UNLABELLED: Final = 254
"""The label, in files, of a surface without a class. Batches give `BACKGROUND` in its place unless asked otherwise."""

MOST_CLASSES: Final = 254
"""Largest number of classes of a set."""

REST: Final = "*"
"""In label maps, stands alone for all that a class may join which no other class does, and for surfaces of no class."""

_DARKEST: Final = 70.0
_LIGHTEST: Final = 225.0
_STRONG: Final = 0.9
_PALE: Final = 0.4  # saturation of classes of the middle; `_STRONG` is that of pairs

_ORDER: Final = ("right", "middle", "left")
_GOLDEN: Final = 0.6180339887
_ROOT: Final = 0.4142135624
_LUMA: Final = np.array([0.299, 0.587, 0.114])  # of Rec. ITU-R BT.601
_COLOUR: Final = re.compile(r"#[0-9a-f]{6}")
_OTHER_SIDE: Final = {"left": "right", "Left": "Right", "LEFT": "RIGHT", "L": "R", "l": "r", "Lt": "Rt", "lt": "rt"}
_EXCHANGED: Final = {**_OTHER_SIDE, **{right: left for left, right in _OTHER_SIDE.items()}}
_SIDE: Final = re.compile(r"[Ll]eft|LEFT|[Rr]ight|RIGHT|(?:(?<=^)|(?<=[_. -]))[LlRr]t?(?=$|[_. -])")


@dataclass(frozen=True)
class LabelClass:
    """One class of a set.

    mirror: name of the class that this one is in a mirror image, as the left hand is the right one there; None: itself.
    colour: sRGB as "#rrggbb"; None: one is chosen. within: name of a wider class that it is a part of, for readers,
    which need not be a class of the set. side: which of a pair it is; None: found from the order of the names. Classes
    that differ only in colour, within or side are equal: their labels mean the same.
    """

    name: str
    mirror: str | None = None
    colour: str | None = field(default=None, compare=False)
    within: str | None = field(default=None, compare=False)
    side: Side | None = field(default=None, compare=False)


@dataclass(frozen=True)
class Classes:
    """Classes of a set, 1 to 254; the label of a class is its index.

    name: of the whole, such as "parts33", which equal ones need not share. Raises BadConfig for too many or none, a
    name that is empty, `REST`, given twice or cannot be printed, a colour that is none, or a mirror image that is no
    class or has another mirror image.
    """

    name: str = field(compare=False)
    entries: tuple[LabelClass, ...]

    def __post_init__(self) -> None:
        where = f"classes {self.name!r}"
        if not _is_name(self.name):
            raise BadConfig(f"classes need a name that can be printed, found {self.name!r}")
        if not 1 <= len(self.entries) <= MOST_CLASSES:
            raise BadConfig(f"{where}: a set has 1 to {MOST_CLASSES} classes, found {len(self.entries)}")
        for entry in self.entries:
            if not _is_name(entry.name) or entry.name == REST:
                raise BadConfig(f"{where}: a class needs a name that can be printed, not '*', found {entry.name!r}")
            if self.names.count(entry.name) > 1:
                raise BadConfig(f"{where}: a class is named once, found {entry.name!r} twice")
            if entry.colour is not None and not (isinstance(entry.colour, str) and _COLOUR.fullmatch(entry.colour)):
                raise BadConfig(f"{where}: the colour of {entry.name!r} must be like '#1e90ff', found {entry.colour!r}")
            if entry.within is not None and not _is_name(entry.within):
                raise BadConfig(f"{where}: 'within' of {entry.name!r} must be a name, found {entry.within!r}")
            if entry.side not in (None, *_ORDER):
                raise BadConfig(f"{where}: {entry.name!r} must be left, right or middle, found {entry.side!r}")
            if entry.mirror is None:
                continue
            if entry.mirror not in self.names:
                raise BadConfig(f"{where}: the mirror image of {entry.name!r}, {entry.mirror!r}, is no class")
            opposite = self.entries[self.names.index(entry.mirror)]
            if (opposite.mirror or opposite.name) != entry.name:
                raise BadConfig(f"{where}: the mirror image of {entry.mirror!r} must be {entry.name!r}")

    def __len__(self) -> int:
        return len(self.entries)

    def __repr__(self) -> str:
        return f"Classes({self.name!r}, {len(self)} classes)"

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the classes in the order of their labels."""
        return tuple(entry.name for entry in self.entries)

    @cached_property
    def mirrored(self) -> NDArray[np.uint8]:
        """Label -> label in the mirror image, uint8 [256]; values that are no class stay as they are."""
        found = np.arange(256, dtype=np.uint8)
        for label, entry in enumerate(self.entries):
            found[label] = label if entry.mirror is None else self.names.index(entry.mirror)
        return found

    @cached_property
    def sides(self) -> tuple[Side, ...]:
        """Side of each class: "middle" for one that is its own mirror image; of a pair, the first is "right"."""

        def side(label: int, entry: LabelClass) -> Side:
            opposite = int(self.mirrored[label])
            return entry.side or ("middle" if opposite == label else "right" if label < opposite else "left")

        return tuple(side(label, entry) for label, entry in enumerate(self.entries))

    @cached_property
    def colours(self) -> NDArray[np.uint8]:
        """Colours of the classes, sRGB, uint8 [N, 3]: as given, else drawn (`class_colours`)."""
        drawn = class_colours(self.sides, self.mirrored)
        for label, entry in enumerate(self.entries):
            if entry.colour is not None:
                drawn[label] = list(bytes.fromhex(entry.colour[1:]))
        return drawn

    def to_json(self) -> dict[str, Any]:
        """Convert to a JSON object; its classes are a list, since their order matters."""
        rows = [
            {field.name: value for field in fields(entry) if (value := getattr(entry, field.name)) is not None}
            for entry in self.entries
        ]
        return {"name": self.name, "classes": rows}


def classes_of(given: Classes | Iterable[str | LabelClass], name: str = "classes") -> Classes:
    """Return `Classes` as given, or made of names and `LabelClass` entries. name: of the whole. Raises BadConfig.

    Of a pair of mirror images, either may state the other; else names that differ in left and right are a pair.
    """
    if isinstance(given, Classes):
        return given
    if isinstance(given, str | set | frozenset | Mapping) or not isinstance(given, Iterable):
        raise BadConfig(f"classes must be a list of names, found {given!r}")
    entries = tuple(LabelClass(each) if isinstance(each, str) else each for each in given)
    for entry in entries:
        if not isinstance(entry, LabelClass):
            raise BadConfig(f"a class must be a name or a LabelClass, found {entry!r}")
    if not all(isinstance(entry.name, str) for entry in entries):
        return Classes(name, entries)  # raises, in the same words as for classes in files
    stated = {entry.name: entry.mirror for entry in entries if isinstance(entry.mirror, str)}
    stated = {other: one for one, other in stated.items()} | stated
    free = {entry.name for entry in entries} - set(stated)
    found = []
    for entry in entries:
        other = _SIDE.sub(lambda side: _EXCHANGED[side[0]], entry.name)
        guessed = other if {entry.name, other} <= free and other != entry.name else None
        own = stated.get(entry.name, guessed) if entry.mirror is None else entry.mirror
        found.append(replace(entry, mirror=own))
    return Classes(name, tuple(found))


def classes_from_json(tree: Any, where: str, of_pairs: bool = False) -> Classes:
    """Read what `Classes.to_json` gave. of_pairs: complete mirror images as `classes_of`. Raises BadConfig."""
    known = {field.name for field in fields(LabelClass)}
    rows = tree.get("classes") if isinstance(tree, dict) else None
    if not isinstance(rows, list) or set(tree) != {"name", "classes"}:
        raise BadConfig(f"{where}: 'classes' must have a name and a list of classes")
    for row in rows:
        if not isinstance(row, dict) or "name" not in row or not set(row) <= known:
            raise BadConfig(f"{where}: a class has a name, and may have {', '.join(sorted(known - {'name'}))}")
    with reported(where, BadConfig):
        entries = tuple(LabelClass(**row) for row in rows)
        return classes_of(entries, tree["name"]) if of_pairs else Classes(tree["name"], entries)


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and bool(value.strip()) and value.isprintable()


def looked_up(labels: NDArray[np.uint8], table: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return table[labels] in an array of its own, uint8 [...], contiguous; table: uint8 [256].

    By `bytearray.translate`, which needs a quarter of the time of NumPy's indexing.
    """
    found = bytearray(np.ascontiguousarray(labels)).translate(table.tobytes())
    return np.frombuffer(found, np.uint8).reshape(labels.shape)


def class_colours(sides: Sequence[Side], mirrored: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Colours of classes, sRGB uint8 [N, 3].

    sides: of each class, "middle" for one that is its own mirror image. mirrored: label -> that of the mirror image.

    Hues are spread evenly over the pairs, and over the classes of the middle, which are paler. Greys are spread evenly
    over all classes: those of the right are the darkest, those of the left the lightest, so that no two classes look
    alike without colour, and exchanged sides show most.
    """
    middle, pairs = [side == "middle" for side in sides], np.minimum(np.arange(len(sides)), mirrored[: len(sides)])
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
