"""The 33 body parts, their colours, and label maps that join them to fewer classes, as other data sets name them.

A part is the surface nearest to one anatomical landmark. Landmark names are spelled as the CAESAR survey spells
them; a part's index in `PARTS` is its label. "Rt." and "Lt." are the subject's own right and left. Colours are hues for
pairs, the left one of a pair lighter, and every class another grey.
"""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module, resources
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_data.files import Table, TomlFiles
from bodyseg_data.machine import use_compiled

Side = Literal["left", "right", "middle"]
Face = Literal["front", "back", "both"]

BACKGROUND: Final = 255
"""The label of a pixel that sees no body; ignored by every loss and score."""

_PAIR_HUES: Final = (2, 10, 5, 12, 8, 4, 11, 7, 0, 3, 9, 6, 1)

_DARKEST: Final = 70.0
_LIGHTEST: Final = 225.0
_STRONG: Final = 0.9
_PALE: Final = 0.4
"""Saturation of pairs, and of classes of the middle."""

_ORDER: Final = ("right", "middle", "left")
_GOLDEN: Final = 0.6180339887
_ROOT: Final = 0.4142135624
_LUMA: Final = np.array([0.299, 0.587, 0.114])  # of Rec. ITU-R BT.601

LABEL_MAP_FORMAT: Final = "bodyseg labels 1"


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

MIRRORED_LABELS: Final[NDArray[np.uint8]] = np.array(
    [*(part.mirror for part in PARTS), *range(PART_COUNT, 256)], np.uint8
)
"""Label -> label in the mirror image (`Part.mirror`), uint8 [256]; `BACKGROUND` and other values stay as they are."""


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


def colour_labels(
    labels: NDArray[np.uint8],
    background: tuple[int, int, int] = (24, 26, 32),
    colours: NDArray[np.uint8] = COLOURS,
) -> NDArray[np.uint8]:
    """Draw a label image: uint8 [H, W] -> sRGB uint8 [H, W, 3]; `background` where a label has no colour.

    colours: sRGB of every label from 0 on, uint8 [N, 3]; by default those of the 33 parts.
    """
    table = np.empty((256, 3), np.uint8)
    table[:] = background
    table[: len(colours)] = colours
    return table[labels]


def looked_up(labels: NDArray[np.uint8], table: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return table[labels] in an array of its own, uint8 [...], contiguous; table: uint8 [256].

    By `bytearray.translate`, which needs a quarter of the time of NumPy's indexing.
    """
    found = bytearray(np.ascontiguousarray(labels)).translate(table.tobytes())
    return np.frombuffer(found, np.uint8).reshape(labels.shape)


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


@dataclass(frozen=True)
class LabelMap:
    """Classes that take the place of the 33 parts.

    name: of the map. classes: (name, landmarks of its parts) of each class; a class's label is its index. Parts of no
    class are labelled as background. Raises BadConfig for a map without classes, a class without landmarks, an unknown
    landmark, a landmark in two classes, a name given twice, or classes that the mirror image splits: the mirrored parts
    of a class must make up one class.
    """

    name: str
    classes: tuple[tuple[str, tuple[str, ...]], ...]

    def __post_init__(self) -> None:
        where = f"labels {self.name!r}"
        names, landmarks = [name for name, _ in self.classes], [each for _, parts in self.classes for each in parts]
        if not names:
            raise BadConfig(f"{where}: there must be 1 to {PART_COUNT} classes, found none")
        for what, found in (("class", names), ("landmark", landmarks)):
            for each in found:
                if found.count(each) > 1:
                    raise BadConfig(f"{where}: a {what} is named once, found {each!r} twice")
        for landmark in landmarks:
            if landmark not in LANDMARKS:
                raise BadConfig(f"{where}: {landmark!r} is none of the 33 landmarks")
        for name, parts in self.classes:
            if not parts:
                raise BadConfig(f"{where}: the class {name!r} must have a landmark, found none")
            opposite = {int(self.table[part.mirror]) for part in _parts(parts)}
            if len(opposite) != 1 or BACKGROUND in opposite:
                raise BadConfig(f"{where}: the mirror image of the class {name!r} must be one class")

    def __repr__(self) -> str:
        return f"LabelMap({self.name!r}, {len(self)} classes)"

    def __len__(self) -> int:
        return len(self.classes)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the classes in the order of their labels."""
        return tuple(name for name, _ in self.classes)

    @cached_property
    def parts(self) -> tuple[tuple[Part, ...], ...]:
        """Parts of each class."""
        return tuple(_parts(parts) for _, parts in self.classes)

    @cached_property
    def table(self) -> NDArray[np.uint8]:
        """Part label -> class label, uint8 [256]; `BACKGROUND` for all else."""
        found = np.full(256, BACKGROUND, np.uint8)
        for label, parts in enumerate(self.parts):
            found[[part.label for part in parts]] = label
        return found

    @cached_property
    def _wide(self) -> NDArray[np.uint64]:
        return self.table.astype(np.uint64)

    def write(self, labels: NDArray[np.uint8], edges: NDArray[np.int32] | None = None) -> None:
        """Replace part labels by class labels in place; parts of no class become `BACKGROUND`.

        labels: uint8 [H, W], contiguous. edges: int32 [2 N], flat indices in reading order where foreground begins,
        ends, begins ...; all else must be background. None: not known.
        """
        flat = labels.reshape(-1)
        if edges is not None and use_compiled():
            _loops().join_runs(flat, edges, self.table)
            return
        if not use_compiled():
            flat[:] = looked_up(flat, self.table)
            return
        first = min(-flat.__array_interface__["data"][0] % 8, flat.size)  # words must be aligned
        words = flat[first : first + (flat.size - first) // 8 * 8].view(np.uint64)
        _loops().join(flat, words, first, self._wide)

    def prepare(self) -> None:
        """Compile or load the loops of `write`, so that workers forked from this process have them too."""
        for edges in (None, np.zeros(2, np.int32)):
            self.write(np.zeros((1, 1), np.uint8), edges)

    @cached_property
    def mirrored(self) -> NDArray[np.uint8]:
        """Class label -> class label in the mirror image, uint8 [256]; other values stay as they are."""
        found = np.arange(256, dtype=np.uint8)
        for label, parts in enumerate(self.parts):
            found[label] = self.table[parts[0].mirror]
        return found

    @cached_property
    def sides(self) -> tuple[Side, ...]:
        """Side of each class: "middle" for one that is its own mirror image, else that of its parts.

        Of a pair of classes that both have parts of either side, the one with the smaller label is "right".
        """
        found: list[Side] = []
        for label, parts in enumerate(self.parts):
            opposite = int(self.mirrored[label])
            own = {part.side for part in parts} - {"middle"}
            if opposite == label:
                found.append("middle")
            elif len(own) == 1:
                found.append(own.pop())
            else:
                found.append("right" if label < opposite else "left")
        return tuple(found)

    @cached_property
    def colours(self) -> NDArray[np.uint8]:
        """Colours of the classes, sRGB, uint8 [len(self), 3]; those of the 33 parts are `COLOURS`."""
        if self.classes == PARTS33.classes:
            return COLOURS
        return class_colours(self.sides, [min(label, int(self.mirrored[label])) for label in range(len(self))])

    def joined_to(self, coarser: LabelMap) -> NDArray[np.uint8]:
        """Class label of this map -> that of a map whose classes are unions of this one's, uint8 [256].

        Values that are no label become `BACKGROUND`. Raises BadConfig if `coarser` splits a class or leaves parts of it
        out, for then a class has no counterpart.
        """
        found = np.full(256, BACKGROUND, np.uint8)
        for label, parts in enumerate(self.parts):
            targets = {int(coarser.table[part.label]) for part in parts}
            if len(targets) != 1:
                raise BadConfig(
                    f"labels {self.name!r} cannot be joined to {coarser.name!r}, which splits the class "
                    f"{self.names[label]!r}"
                )
            if BACKGROUND in targets:
                raise BadConfig(
                    f"labels {self.name!r} cannot be joined to {coarser.name!r}, in which the class "
                    f"{self.names[label]!r} has no counterpart"
                )
            found[label] = targets.pop()
        return found

    def to_json(self) -> dict[str, Any]:
        """Convert to a JSON object; its classes are a list, since their order matters."""
        return {"name": self.name, "classes": [{"name": name, "landmarks": [*parts]} for name, parts in self.classes]}


def _loops() -> Any:
    """The compiled loops, in a module that needs numba."""
    return import_module("bodyseg_data.labels.label_loops")


def _parts(landmarks: tuple[str, ...]) -> tuple[Part, ...]:
    return tuple(PARTS[LANDMARKS.index(landmark)] for landmark in landmarks)


PARTS33: Final = LabelMap("parts33", tuple((landmark, (landmark,)) for landmark in LANDMARKS))
"""The 33 parts themselves."""

_FILES: Final = TomlFiles("label map", resources.files(__package__), LABEL_MAP_FORMAT, (PARTS33.name,))


def label_map_names() -> tuple[str, ...]:
    """Names of the label maps that ship with the package."""
    return _FILES.names()


def label_map_from_json(tree: Any, where: str) -> LabelMap:
    """Read a label map from what `LabelMap.to_json` gave. Raises BadConfig, naming `where`."""
    table = _table(tree, where)
    name, rows = table.text("name"), tree.get("classes")
    if not isinstance(rows, list):
        raise BadConfig(f"{where}: 'classes' must be a list, found {type(rows).__name__}")
    classes = []
    for row in rows:
        each = _table(row, f"{where}, a class")
        classes.append((each.text("name"), row.get("landmarks")))
    return _map(name, classes, where)


def load_label_map(labels: str | Path | LabelMap) -> LabelMap:
    """Return a label map: as given, one that ships by its name, or that of a TOML file. Raises BadConfig."""
    if isinstance(labels, LabelMap):
        return labels
    if not isinstance(labels, str | Path):
        raise BadConfig(f"labels must be a LabelMap, a name, or the path of a .toml file, found {labels!r}")
    if str(labels) == PARTS33.name:
        return PARTS33
    where = f"label map {labels}"
    tree = _FILES.parse(_FILES.read(labels), str(labels))
    classes = tree.pop("classes", None)
    if not isinstance(classes, dict):
        raise BadConfig(f"{where}: the table [classes] is missing")
    table = Table(tree, where)
    name = table.text("name")
    table.finish()
    return _map(name, list(classes.items()), where)


def _table(tree: Any, where: str) -> Table:
    if not isinstance(tree, dict):
        raise BadConfig(f"{where}: labels must be an object, found {type(tree).__name__}")
    return Table(tree, where)


def _map(name: str, classes: list[tuple[str, Any]], where: str) -> LabelMap:
    """Make a label map of (name, landmarks) read from a file. Raises BadConfig, naming `where`."""
    for each, parts in classes:
        if not isinstance(parts, list) or not all(isinstance(part, str) for part in parts):
            raise BadConfig(f"{where}: the class {each!r} must be a list of landmarks, found {parts!r}")
    try:
        return LabelMap(name, tuple((each, tuple(parts)) for each, parts in classes))
    except BadConfig as error:
        raise BadConfig(f"{where}: {error}") from error
