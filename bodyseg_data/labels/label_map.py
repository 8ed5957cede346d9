"""Label maps: classes that take the place of a set's own, such as the 33 parts joined as other data sets name them.

Classes are unions of the set's own, or of regions of the template of the body (`OnTemplate`), which need no set of
these classes: its column `TEMPLATE` tells where on the template every pixel lies.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import cached_property
from importlib import resources
from itertools import zip_longest
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, check_fields, reported
from bodyseg_data.files import Table, TomlFiles
from bodyseg_data.labels.classes import (
    BACKGROUND,
    MOST_CLASSES,
    REST,
    UNLABELLED,
    Classes,
    Side,
    class_colours,
    classes_from_json,
    classes_of,
    looked_up,
)
from bodyseg_data.labels.parts import COLOURS, PART_CLASSES
from bodyseg_data.machine import if_ready, loops

Bytes = NDArray[np.uint8]

LABEL_MAP_FORMAT: Final = "bodyseg labels 1"
TEMPLATE: Final = "template"
"""Name of the column of a set that tells where on the template of the body each pixel lies."""
NOWHERE: Final = 65535
"""What the column `TEMPLATE` has for a pixel that does not see the body: background, furniture, a held thing."""
_LOOPS: Final = "bodyseg_data.labels.label_loops"
_REGIONS: Final = ("parts33", "bones", "landmarks")
_OF_REGIONS: Final = "regions"  # name of the classes of maps of the template, which cards hold without its points


def colour_labels(labels: Bytes, background: tuple[int, int, int] = (24, 26, 32), colours: Bytes = COLOURS) -> Bytes:
    """Draw a label image: uint8 [H, W] -> sRGB uint8 [H, W, 3].

    background: colour where a label has none. colours: of all labels from 0 on, uint8 [N, 3]; default: the 33 parts'.
    Raises BadConfig for colours that are no whole numbers: those from 0 to 1 of other programs would all be black.
    """
    if (kind := np.asarray(colours).dtype).kind not in "iu":
        raise BadConfig(f"colours must be whole numbers from 0 to 255, found {kind}")
    table = np.empty((256, 3), np.uint8)
    table[:] = background
    table[: len(colours)] = colours
    return table[labels]


@dataclass(frozen=True)
class OnTemplate:
    """Regions of the template of the body that a label map joins in place of a set's classes.

    kind: "parts33"; "bones", names or patterns of them, with front, back, left or right for a half; "landmarks", each
    region the points nearest to a landmark along the surface; or the path of a .npy file with a number for each vertex.
    numbers: of each region, the vertex of its landmark, or its number in the file.
    """

    kind: str
    numbers: tuple[int, ...] = ()


@dataclass(frozen=True)
class LabelMap:
    """Classes that take the place of a set's own, each a union of some of them.

    name: of the map. classes: name of each class, and names of the set's classes that it joins; its label is its index.
    The set's classes that are in none become background, unless a class joins `REST`, as for a network that tells
    people from the room. of: the set's own classes. template: None unless these are regions of the template.
    Raises BadConfig for a map without classes or with more than 254, an empty class, an unknown class, one in two
    classes, or a name given twice.
    """

    name: str
    classes: tuple[tuple[str, tuple[str, ...]], ...]
    of: Classes = PART_CLASSES
    template: OnTemplate | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        check_fields(self)
        where, kind = f"labels {self.name!r}", "landmark" if self.of == PART_CLASSES else "class"
        names, joined = [name for name, _ in self.classes], [each for _, members in self.classes for each in members]
        most = min(MOST_CLASSES, len(self.of) + (REST in joined))
        if not 1 <= len(names) <= MOST_CLASSES:
            raise BadConfig(f"{where}: there must be 1 to {most} classes, found {len(names) or 'none'}")
        for what, found in (("class", names), (kind, joined)):
            for each in found:
                if found.count(each) > 1:
                    raise BadConfig(f"{where}: a {what} is named once, found {each!r} twice")
        for name, members in self.classes:
            if REST in members and len(members) > 1:
                raise BadConfig(f"{where}: {REST!r} must be alone in its class, found {members!r} in {name!r}")
        for each in joined:
            if each not in self.of.names and each != REST:
                landmarks = "the 33 landmarks (for a set of other classes, give of=images.manifest.classes)"
                known = landmarks if self.of == PART_CLASSES else f"the classes {self.of.name!r}"
                raise BadConfig(f"{where}: {each!r} is none of {known}")
        for name, members in self.classes:
            if not members:
                raise BadConfig(f"{where}: the class {name!r} must have a {kind}, found none")

    def __repr__(self) -> str:
        return f"LabelMap({self.name!r}, {len(self)} classes)"

    def __len__(self) -> int:
        return len(self.classes)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the classes in the order of their labels."""
        return tuple(name for name, _ in self.classes)

    @cached_property
    def members(self) -> tuple[tuple[int, ...], ...]:
        """The set's labels that each class joins; for the class of the rest, those of classes that are in no other."""
        named = {each for _, members in self.classes for each in members}
        rest = tuple(label for label, each in enumerate(self.of.names) if each not in named)
        return tuple(
            rest if members == (REST,) else tuple(map(self.of.names.index, members)) for _, members in self.classes
        )

    @property
    def has_rest(self) -> bool:
        """True if surfaces of no class have a class of this map."""
        return any(members == (REST,) for _, members in self.classes)

    @cached_property
    def table(self) -> Bytes:
        """Label of the set -> label of a class, uint8 [256]; `BACKGROUND` for all else."""
        found = np.full(256, BACKGROUND, np.uint8)
        for label, (members, (_, names)) in enumerate(zip(self.members, self.classes, strict=True)):
            found[[*members, *([UNLABELLED] if names == (REST,) else [])]] = label
        return found

    @cached_property
    def _tables(self) -> dict[int, Bytes]:
        """The table of `write` by what surfaces of no class get."""
        kept = self.table.copy()
        kept[:BACKGROUND][kept[:BACKGROUND] == BACKGROUND] = UNLABELLED
        return {BACKGROUND: self.table, UNLABELLED: kept}

    def write(self, labels: Bytes, edges: NDArray[np.int32] | None = None, unlabelled: int = BACKGROUND) -> None:
        """Replace a set's labels by class labels in place.

        labels: uint8 [H, W]. unlabelled: label for surfaces of no class, 254 or 255.
        edges: int32 [2 N], flat indices in reading order where foreground begins and ends, by turns, of contiguous
        labels; None: not known.
        """
        table = self._tables[unlabelled]
        if edges is not None:
            with if_ready:
                loops(_LOOPS).join_runs(labels.reshape(-1), edges, table)
                return
        labels[...] = looked_up(labels, table)

    @cached_property
    def mirrored(self) -> Bytes:
        """Class label -> class label in the mirror image, uint8 [256]; other values stay as they are.

        Raises BadConfig if the mirror images of a class's members are not the members of one class.
        """
        table, lopsided = self._opposites
        if lopsided is not None:
            raise BadConfig(f"labels {self.name!r}: the mirror image of the class {lopsided!r} must be one class")
        return table

    @property
    def has_mirror_image(self) -> bool:
        """True if images may be flipped: see `mirrored`."""
        return self._opposites[1] is None

    @property
    def unpaired(self) -> tuple[str, str] | None:
        """The first two classes, each its own mirror image, whose names differ by a capital L and R alone, as `FL` and
        `FR`: names of no word for a side, which pair no classes. None without any.
        """
        own = [name for label, name in enumerate(self.names) if self.mirrored[label] == label]
        letters = ((name, found) for name in own for found in re.finditer("L(?![a-z])", name))
        pairs = ((name, f"{name[: found.start()]}R{name[found.end() :]}") for name, found in letters)
        return next((pair for pair in pairs if pair[1] in own), None)

    @cached_property
    def _opposites(self) -> tuple[Bytes, str | None]:
        """As `mirrored`, and None; where the mirror image of a class is not one class, a table in which all stay as
        they are, and the name of the first such class.
        """
        found = np.arange(256, dtype=np.uint8)
        for label, members in enumerate(self.members):
            opposite = {int(self.table[self.of.mirrored[member]]) for member in members} or {label}
            if len(opposite) != 1 or BACKGROUND in opposite:
                return np.arange(256, dtype=np.uint8), self.names[label]
            found[label] = opposite.pop()
        return found, None

    @cached_property
    def sides(self) -> tuple[Side, ...]:
        """Side of each class: "middle" for one that is its own mirror image, else that of its members.

        Of a pair of classes that both have members of either side, the one with the smaller label is "right".
        """
        found: list[Side] = []
        for label, members in enumerate(self.members):
            opposite = int(self._opposites[0][label])
            own = {self.of.sides[member] for member in members} - {"middle"}
            if opposite == label:
                found.append("middle")
            elif len(own) == 1:
                found.append(own.pop())
            else:
                found.append("right" if label < opposite else "left")
        return tuple(found)

    @cached_property
    def colours(self) -> Bytes:
        """Colours of the classes, sRGB, uint8 [len(self), 3]; a map that changes nothing has those of the set."""
        if self.is_whole:
            return self.of.colours
        return class_colours(self.sides, self._opposites[0])

    @property
    def of_bodies(self) -> bool:
        """True if the classes are parts of people: of the 33 parts, or of regions of the template."""
        return self.of == PART_CLASSES or self.of.name == _OF_REGIONS

    @property
    def is_whole(self) -> bool:
        """True if labels stay as they are: the classes are the set's own, perhaps by other names."""
        return not self.has_rest and self.members == tuple((label,) for label in range(len(self.of)))

    def joined_to(self, coarser: LabelMap) -> Bytes:
        """Class label of this map -> that of a map whose classes are unions of this one's, uint8 [256].

        Values that are no label become `BACKGROUND`. Raises BadConfig if `coarser` splits a class or leaves out some of
        its members, since the class then has no counterpart, or if it is a map of another set's classes.
        """
        if differing := whole_map(self.of).difference(whole_map(coarser.of)):
            raise BadConfig(f"labels {self.name!r} and {coarser.name!r} are of other classes: found {differing}")
        found = np.full(256, BACKGROUND, np.uint8)
        for label, members in enumerate(self.members):
            targets = {int(coarser.table[member]) for member in members or (UNLABELLED,)}
            if len(targets) != 1 or BACKGROUND in targets:
                fault = f"{'splits' if len(targets) > 1 else 'lacks'} the class {self.names[label]!r}"
                raise BadConfig(f"labels {self.name!r} cannot be joined to {coarser.name!r}, which {fault}")
            found[label] = targets.pop()
        return found

    def difference(self, other: LabelMap) -> str | None:
        """Return the first difference between the classes of two label maps in words, None if labels mean the same.

        They do if the classes have the same names in the same order, of whatever sets' classes they are made.
        """
        for label, (own, others) in enumerate(zip_longest(self.names, other.names)):
            if own != others:
                shown = " and ".join("no class" if name is None else repr(name) for name in (own, others))
                return f"the labels {self.name!r} and {other.name!r}: {label} is {shown}"
        (own_table, own_fault), (other_table, other_fault) = self._opposites, other._opposites
        if (own_fault is None) == (other_fault is None) and np.array_equal(own_table, other_table):
            return None
        return f"the labels {self.name!r} and {other.name!r}, whose classes have other mirror images"

    def to_json(self) -> dict[str, Any]:
        """Convert to a JSON object; its classes are a list, since their order matters."""
        tree: dict[str, Any] = {"name": self.name}
        if self.of != PART_CLASSES:
            tree["of"] = self.of.to_json()
        return {**tree, "classes": [{"name": name, _listed(self.of): [*members]} for name, members in self.classes]}


def whole_map(classes: Classes) -> LabelMap:
    """The label map that leaves the classes of a set as they are."""
    return LabelMap(classes.name, tuple((name, (name,)) for name in classes.names), classes)


PARTS33: Final = whole_map(PART_CLASSES)
"""The 33 parts themselves."""

_FILES: Final = TomlFiles("label map", resources.files(__package__), LABEL_MAP_FORMAT, (PARTS33.name,))


def label_map_names() -> tuple[str, ...]:
    """Names of the label maps that ship with the package."""
    return _FILES.names()


def label_map_from_json(tree: Any, where: str) -> LabelMap:
    """Read a label map from what `LabelMap.to_json` gave. Raises BadConfig, naming `where`."""
    table = Table(tree, where)
    name, rows = table.text("name"), tree.get("classes")
    of = classes_from_json(tree["of"], where) if "of" in tree else PART_CLASSES
    if not isinstance(rows, list):
        raise BadConfig(f"{where}: 'classes' must be a list, found {type(rows).__name__}")
    classes = [(Table(row, f"{where}, a class").text("name"), row.get(_listed(of))) for row in rows]
    return _map(name, classes, of, where)


def load_label_map(labels: str | Path | LabelMap, of: Classes = PART_CLASSES) -> LabelMap:
    """Load a label map: one that ships, or `of` itself, by its name, or that of a TOML file; a LabelMap stays as it is.

    of: the set's classes, not needed for regions of the template. Raises BadConfig, also for a map of other classes.
    """
    if not isinstance(of, Classes):
        raise BadConfig(f"label maps are of the classes of a set, found {of!r:.100}")
    if isinstance(labels, LabelMap):
        if labels.template is None and labels.name in _FILES.names()[1:]:
            shipped = load_label_map(labels.name)
            labels = shipped if shipped == labels else labels  # as stored with a network, it lacks its regions
        if labels.template is None and (differing := whole_map(labels.of).difference(whole_map(of))):
            raise BadConfig(f"labels {labels.name!r} are of other classes than the set's: found {differing}")
        return labels
    if str(labels) in (of.name, PARTS33.name):
        return whole_map(of) if str(labels) == of.name else load_label_map(PARTS33, of)
    where = f"label map {labels}"
    tree = _FILES.parse(_FILES.read(labels), str(labels))
    classes, template = tree.pop("classes", None), None
    if "template" in tree:
        template, of = _regions(tree.pop("template"), tree.pop("regions", {}), classes, Path(labels).parent, where)
        classes = {name: [name] for name in of.names} if classes is None else classes
    if not isinstance(classes, dict):
        raise BadConfig(f"{where}: the table [classes] is missing")
    table = Table(tree, where)
    name = table.text("name")
    table.finish()
    return _map(name, list(classes.items()), of, where, template)


def _regions(kind: Any, numbers: Any, classes: Any, folder: Path, where: str) -> tuple[OnTemplate, Classes]:
    """The regions of the template that a file names. classes: its table, if any. folder: of a file of numbers."""
    is_file = isinstance(kind, str) and kind.endswith(".npy")
    if kind not in _REGIONS and not is_file:
        raise BadConfig(f"{where}: 'template' must be {', '.join(_REGIONS)} or the path of a .npy file, found {kind!r}")
    if kind == PARTS33.name:
        return OnTemplate(kind), PART_CLASSES
    if kind == "bones":
        lists = [each for each in (classes or {}).values() if isinstance(each, list)]
        names = [name for members in lists for name in members if isinstance(name, str) and name != REST]
        numbers = dict.fromkeys(names, 0)
    if not isinstance(numbers, dict) or {*map(type, numbers.values())} != {int}:
        raise BadConfig(f"{where}: the table [regions] must give each region a whole number, found {numbers!r:.60}")
    with reported(where, BadConfig):
        of = classes_of(list(numbers), _OF_REGIONS)
    return OnTemplate(str(folder / kind) if is_file else kind, () if kind == "bones" else tuple(numbers.values())), of


def _listed(of: Classes) -> str:
    """Key of the members of a class in JSON."""
    return "landmarks" if of == PART_CLASSES else "classes"


def _map(
    name: str, classes: list[tuple[str, Any]], of: Classes, where: str, template: OnTemplate | None = None
) -> LabelMap:
    """Make a label map of (name, members) read from a file. Raises BadConfig, naming `where`."""
    for each, members in classes:
        if not isinstance(members, list) or not all(isinstance(member, str) for member in members):
            raise BadConfig(f"{where}: the class {each!r} must be a list of {_listed(of)}, found {members!r}")
    with reported(where, BadConfig):
        return LabelMap(name, tuple((each, tuple(members)) for each, members in classes), of, template)
