"""Label maps: the 33 parts joined to fewer classes, as other data sets and applications name them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.parts import BACKGROUND, COLOURS, LANDMARKS, PART_COUNT, PARTS
from bodyseg_data.core.tables import Table, toml_names, toml_text, toml_tree

LABEL_MAP_FORMAT: Final = "bodyseg labels 1"

_FOLDER: Final = resources.files(__package__)


@dataclass(frozen=True)
class LabelMap:
    """Classes that take the place of the 33 parts.

    name: of the map. classes: (name, landmarks of its parts) of each class; a class's label is its index. Parts of no
    class are labelled as background. Raises BadConfig for an unknown landmark, a landmark in two classes, a name given
    twice, or classes that the mirror image splits: the mirrored parts of a class must make up one class.
    """

    name: str
    classes: tuple[tuple[str, tuple[str, ...]], ...]

    def __post_init__(self) -> None:
        names, landmarks = [name for name, _ in self.classes], [each for _, parts in self.classes for each in parts]
        for what, found in (("class", names), ("landmark", landmarks)):
            for each in found:
                if found.count(each) > 1:
                    raise BadConfig(f"labels {self.name!r}: a {what} is named once, found {each!r} twice")
        for landmark in landmarks:
            if landmark not in LANDMARKS:
                raise BadConfig(f"labels {self.name!r}: {landmark!r} is none of the 33 landmarks")
        for name, parts in self.classes:
            found_labels = {int(self.table[PARTS[LANDMARKS.index(each)].mirror]) for each in parts}
            if len(found_labels) != 1 or BACKGROUND in found_labels:
                raise BadConfig(f"labels {self.name!r}: the mirror image of {name!r} must be one class")

    def __repr__(self) -> str:
        return f"LabelMap({self.name!r}, {len(self)} classes)"

    def __len__(self) -> int:
        return len(self.classes)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the classes in the order of their labels."""
        return tuple(name for name, _ in self.classes)

    @cached_property
    def table(self) -> NDArray[np.uint8]:
        """Part label -> class label, uint8 [256]; `BACKGROUND` for all else."""
        found = np.full(256, BACKGROUND, np.uint8)
        for label, (_, parts) in enumerate(self.classes):
            found[[LANDMARKS.index(landmark) for landmark in parts]] = label
        return found

    @cached_property
    def mirrored(self) -> NDArray[np.uint8]:
        """Class label -> class label in the mirror image, uint8 [256]; other values stay as they are."""
        found = np.arange(256, dtype=np.uint8)
        for label, (_, parts) in enumerate(self.classes):
            found[label] = self.table[PARTS[LANDMARKS.index(parts[0])].mirror]
        return found

    @cached_property
    def colours(self) -> NDArray[np.uint8]:
        """Colours of the classes, sRGB, uint8 [len(self), 3]: each that of its first part."""
        return COLOURS[[LANDMARKS.index(parts[0]) for _, parts in self.classes]]

    def to_json(self) -> dict[str, Any]:
        """Convert to a JSON object."""
        return {"name": self.name, "classes": {name: list(parts) for name, parts in self.classes}}


PARTS33: Final = LabelMap("parts33", tuple((landmark, (landmark,)) for landmark in LANDMARKS))
"""The 33 parts themselves."""


def label_map_names() -> tuple[str, ...]:
    """Names of the label maps that ship with the package."""
    return (PARTS33.name, *toml_names(_FOLDER))


def label_map_from_json(tree: Any, where: str) -> LabelMap:
    """Read a label map from what `LabelMap.to_json` gave. Raises BadConfig, naming `where`."""
    if not isinstance(tree, dict):
        raise BadConfig(f"{where}: labels must be an object, found {type(tree).__name__}")
    table = Table(tree, where)
    name, rows = table.text("name"), tree.get("classes")
    if not isinstance(rows, dict) or not 1 <= len(rows) <= PART_COUNT:
        raise BadConfig(f"{where}: 'classes' must be a table of 1 to {PART_COUNT} classes")
    for each, parts in rows.items():
        if not isinstance(parts, list) or not parts or not all(isinstance(part, str) for part in parts):
            raise BadConfig(f"{where}: the class {each!r} must be a list of landmarks, found {parts!r}")
    return LabelMap(name, tuple((each, tuple(parts)) for each, parts in rows.items()))


def load_label_map(labels: str | Path | LabelMap) -> LabelMap:
    """Return a label map: as given, one that ships by its name, or that of a TOML file. Raises BadConfig."""
    if isinstance(labels, LabelMap):
        return labels
    if labels == PARTS33.name:
        return PARTS33
    tree = toml_tree(toml_text("label map", labels, _FOLDER), f"label map {labels}", LABEL_MAP_FORMAT)
    return label_map_from_json(tree, f"label map {labels}")
