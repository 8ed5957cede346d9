"""Label maps: the 33 parts joined to fewer classes, as other data sets and applications name them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from importlib import import_module, resources
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.kernels import use_compiled
from bodyseg_data.core.labels.colours import class_colours
from bodyseg_data.core.labels.lookup import looked_up
from bodyseg_data.core.parts import BACKGROUND, COLOURS, LANDMARKS, PART_COUNT, PARTS, Part, Side
from bodyseg_data.core.tables import Table, toml_names, toml_text, toml_tree

LABEL_MAP_FORMAT: Final = "bodyseg labels 1"

_FOLDER: Final = resources.files(__package__)


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
    return import_module("bodyseg_data.core.labels.loops")


def _parts(landmarks: tuple[str, ...]) -> tuple[Part, ...]:
    return tuple(PARTS[LANDMARKS.index(landmark)] for landmark in landmarks)


PARTS33: Final = LabelMap("parts33", tuple((landmark, (landmark,)) for landmark in LANDMARKS))
"""The 33 parts themselves."""


def label_map_names() -> tuple[str, ...]:
    """Names of the label maps that ship with the package."""
    return (PARTS33.name, *toml_names(_FOLDER))


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
    tree = toml_tree(toml_text("label map", labels, _FOLDER, (PARTS33.name,)), where, LABEL_MAP_FORMAT)
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
