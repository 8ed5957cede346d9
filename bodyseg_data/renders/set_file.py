"""The file `set.toml` of a folder of renders, which says what its images mean, and its table of samples.

    format = "bodyseg renders 1"
    classes = ["floor", "table", "arm"]   # or [[classes]] with name, label, colour, mirror, within
    first_label = 1                       # the number of the first class in label images
    background = [0]                      # numbers or colours of pixels without a class
    rig = "rig.toml"                      # a rig file in this folder, the name of a rig, or a table [rig]
    unit_m = 0.001                        # metres of one step of range images of integers

Further keys are those of `SetFile`.
"""

import contextlib
import csv
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, BadSample, check_choice, reported
from bodyseg_data.files import Table, TomlFiles, parse_json, read_bytes
from bodyseg_data.labels import BACKGROUND, Classes, classes_from_json
from bodyseg_data.rigs import Rig, load_rig, rig_from_json
from bodyseg_data.samples import SPLITS, SampleInfo, Split, Value, kind_of

SET_NAME: Final = "set.toml"
SET_FORMAT: Final = "bodyseg renders 1"
TABLES: Final = ("samples.jsonl", "samples.csv")

Along = Literal["axis", "ray"]

_FILES: Final = TomlFiles("set", Path(), SET_FORMAT)
_NUMBERED: Final = re.compile("[+-]?0[0-9]+")  # a name, as of subject 007
_COLOUR: Final = re.compile(r"#[0-9a-fA-F]{6}")
_SMALL: Final = 1 << 16
_BORDER: Final = 0.05  # share of pixels of unknown colours up to which they are taken for blended borders


@dataclass(frozen=True)
class LabelTable:
    """Numbers and colours (0xrrggbb) of label images -> label; `BACKGROUND` for those without a class.

    said_by: the file that gives them.
    """

    numbers: Mapping[int, int] = field(default_factory=dict)
    colours: Mapping[int, int] = field(default_factory=dict)
    said_by: str = SET_NAME

    def labels(self, image: NDArray[Any], where: str) -> NDArray[np.uint8]:
        """Labels of an image, uint8 [H, W]. Raises BadSample for a number or colour that stands for nothing."""
        if image.ndim == 3 and not self.colours and (image[..., :3] == image[..., :1]).all():
            image = image[..., 0]  # grey that was saved as a picture in colours
        in_colours = image.ndim == 3
        if in_colours and not self.colours:
            raise BadSample(f"{where}: the image is in colours, and no class of {self.said_by} has a colour")
        table, values = (self.colours, _packed(image, where)) if in_colours else (self.numbers, _whole(image, where))
        small = values.min() >= 0 and values.max() < _SMALL
        found = np.flatnonzero(np.bincount(values.ravel())) if small else np.unique(values)
        if not table.keys() >= set(found.tolist()):
            strange, counts = np.unique(values[~np.isin(values, list(table))], return_counts=True)
            most = f"#{strange[counts.argmax()]:06x}" if in_colours else str(strange[counts.argmax()])
            blended = in_colours and len(strange) > 2 and counts.sum() < _BORDER * values.size
            why = ": borders are blended, labels need rendering without antialiasing" if blended else ""
            raise BadSample(
                f"{where}: {counts.sum()} pixels have {len(strange)} {'colours' if in_colours else 'numbers'} that are "
                f"neither a class nor background in {self.said_by}, most of them {most} ({counts.max()}){why}"
            )
        labels = np.array([table[value] for value in found.tolist()], np.uint8)
        return labels[np.searchsorted(found, values)]


def _whole(image: NDArray[Any], where: str) -> NDArray[np.int64]:
    with np.errstate(invalid="ignore"):  # of NaN, which the next lines refuse
        whole = image.astype(np.int64)
    if image.dtype.kind == "f" and not np.array_equal(whole, image):
        raise BadSample(f"{where}: a label must be a whole number, found {image[whole != image][0]:.6g}")
    return whole


def _packed(image: NDArray[Any], where: str) -> NDArray[np.int64]:
    """Colours of 8 bits a channel as numbers 0xrrggbb."""
    if image.dtype != np.uint8 or image.shape[2] not in (3, 4):
        raise BadSample(f"{where}: a label image in colours must be of 8 bits, found {image.dtype} {image.shape}")
    channels = image.astype(np.int64)
    return channels[..., 0] << 16 | channels[..., 1] << 8 | channels[..., 2]


@dataclass(frozen=True)
class SetFile:
    """The content of `set.toml`; what it does not say is None or empty.

    rigs: by the name that the table of samples gives them, "" for the set's only one. unit_m, no_range: as of
    `as_metres`. along: what ranges are measured along. camera, projector: folders of the two. range_step_mm,
    stand_off_m: of a rig that the renders' own files describe.
    """

    path: Path
    layout: str | None = None
    classes: Classes | None = None
    table: LabelTable = field(default_factory=LabelTable)
    rigs: Mapping[str, Rig] = field(default_factory=dict)
    unit_m: float | None = None
    along: Along = "axis"
    no_range: tuple[float, ...] | None = None
    split: Split = "train"
    camera: str = ""
    projector: str = "projector"
    stand_off_m: float = 1.0
    range_step_mm: float | None = None


def read_set(folder: Path) -> SetFile:
    """Read the `set.toml` of a folder; an empty one if there is none. Raises BadConfig, naming file and key."""
    path = folder / SET_NAME
    if not path.exists():
        return SetFile(path)
    tree = _FILES.parse(_FILES.read(path), str(path))
    rows, lists = tree.pop("classes", None), {name: tree.pop(name, None) for name in ("background", "no_range")}
    rigs = _rigs(tree.pop("rig", None), tree.pop("rigs", None), path)
    table = Table(tree, str(path))
    name = table.text("name") if "name" in table else "classes"
    first = table.whole("first_label") if "first_label" in table else 0
    found: dict[str, Any] = {
        key: table.text(key) for key in ("layout", "along", "split", "camera", "projector") if key in table
    }
    found |= {key: table.positive(key) for key in ("unit_m", "stand_off_m", "range_step_mm") if key in table}
    table.finish()
    for key, allowed in (("along", get_args(Along)), ("split", SPLITS)):
        check_choice(f"{path}: {key!r}", found.get(key, allowed[0]), allowed)
    if "projector" in found and not (folder / found["projector"]).is_dir():
        raise BadConfig(f"{path}: 'projector' must be a folder beside it, found {found['projector']!r}")
    background = [BACKGROUND] if lists["background"] is None else _list(lists["background"], "background", path)
    classes, numbers = (None, LabelTable()) if rows is None else _classes(rows, name, first, background, path)
    if lists["no_range"] is not None:
        values = _list(lists["no_range"], "no_range", path)
        if not all(type(value) in (int, float) for value in values):
            raise BadConfig(f"{path}: 'no_range' must be a list of numbers, found {values!r:.60}")
        found["no_range"] = tuple(map(float, values))
    return SetFile(path, classes=classes, table=numbers, rigs=rigs, **found)


def _list(value: Any, key: str, path: Path) -> list[Any]:
    if not isinstance(value, list):
        raise BadConfig(f"{path}: {key!r} must be a list, found {value!r:.60}")
    return value


def _classes(rows: Any, name: str, first: int, background: Sequence[Any], path: Path) -> tuple[Classes, LabelTable]:
    """Classes, and the numbers and colours of images that stand for them. Raises BadConfig."""
    numbers: dict[int, int] = {}
    colours: dict[int, int] = {}

    def stands_for(value: Any, label: int, what: str) -> None:
        is_colour = isinstance(value, str) and _COLOUR.fullmatch(value) is not None
        if not is_colour and type(value) is not int:
            raise BadConfig(f"{path}: {what} must be a whole number or a colour like '#1e90ff', found {value!r:.60}")
        table, key = (colours, int(value[1:], 16)) if is_colour else (numbers, value)
        if table.setdefault(key, label) != label:
            raise BadConfig(f"{path}: {value!r:.60} stands for two classes, or for one and 'background'")

    for value in background:
        stands_for(value, BACKGROUND, "an entry of 'background'")
    rows = [{"name": row} if isinstance(row, str) else row for row in _list(rows, "classes", path)]
    for label, row in enumerate(rows):
        if not isinstance(row, dict):
            raise BadConfig(f"{path}: a class is a name or a table, found {row!r:.60}")
        values = row.pop("label", first + label)
        for value in values if isinstance(values, list) else [values]:
            stands_for(value, label, f"'label' of class {label}")
        if "colour" in row:
            stands_for(row["colour"], label, f"'colour' of class {label}")
            row["colour"] = str(row["colour"]).lower()
    classes = classes_from_json({"name": name, "classes": rows}, str(path), of_pairs=True)
    return classes, LabelTable(numbers, colours)


def _rigs(one: Any, several: Any, path: Path) -> dict[str, Rig]:
    if one is not None and several is not None:
        raise BadConfig(f"{path}: a set has 'rig' or [rigs], found both")
    if several is not None and not (isinstance(several, dict) and several):
        raise BadConfig(f"{path}: [rigs] must give names to rig files, found {several!r:.60}")
    named = {"": one} if one is not None else several or {}
    return {name: _rig(value, path) for name, value in named.items()}


def _rig(value: Any, path: Path) -> Rig:
    """A rig from a file beside `path`, by its name, or from a table in it. Raises BadConfig."""
    if isinstance(value, str):
        return load_rig(path.parent / value if value.endswith(".toml") else value)
    if not isinstance(value, dict):
        raise BadConfig(f"{path}: 'rig' must be a file, a name or a table, found {value!r:.60}")
    tree = {key: each for key, each in value.items() if key != "title"}
    if isinstance(tree.get("camera"), dict):
        tree["camera"] = {"position_m": [0.0, 0.0, 0.0], "aims_at_m": [0.0, 0.0, 1.0], **tree["camera"]}
    with reported(f"{path}, [rig]", BadConfig):
        return rig_from_json({"format": "bodyseg rig 1", "name": "renders", **tree})


@dataclass(frozen=True)
class SampleRows:
    """Descriptions of samples by key, in the table's order; empty without a table.

    infos: split and fields. rigs: names of those that have one. default: split of samples without.
    """

    path: Path | None
    default: Split
    infos: Mapping[str, SampleInfo] = field(default_factory=dict)
    rigs: Mapping[str, str] = field(default_factory=dict)

    def info(self, key: str) -> SampleInfo:
        """Split and fields of a sample."""
        return self.infos.get(key) or SampleInfo(self.default)

    def kinds(self) -> dict[str, str]:
        """Name -> kind of all fields; whole numbers are floats where other samples have floats."""
        found: dict[str, str] = {}
        for info in self.infos.values():
            for name, value in info.fields.items():
                kind = kind_of(value, name)
                if found.setdefault(name, kind) == "int":
                    found[name] = kind
        return found


def read_rows(folder: Path, content: SetFile) -> SampleRows:
    """Read samples.jsonl or samples.csv of a folder, if there is one. Raises BadConfig, naming file and line."""
    there = [folder / name for name in TABLES if (folder / name).exists()]
    if not there:
        return SampleRows(None, content.split)
    if len(there) > 1:
        raise BadConfig(f"{folder}: a set has one table of samples, found {' and '.join(TABLES)}")
    path, infos, rigs = there[0], dict[str, SampleInfo](), dict[str, str]()
    with reported(f"{path} is not UTF-8", BadConfig, UnicodeDecodeError):
        text = read_bytes(path).decode("utf-8-sig")  # spreadsheets write a mark of byte order
    for line, row in _json_rows(text, path) if path.suffix == ".jsonl" else _csv_rows(text, path):
        if "key" not in row:
            raise BadConfig(f"{path}, line {line}: a row must have a 'key', found {', '.join(map(repr, row))}")
        key, split, rig = row.pop("key"), row.pop("split", content.split), row.pop("rig", "")
        if not isinstance(key, str) or key in infos or not isinstance(rig, str):
            raise BadConfig(f"{path}, line {line}: 'key' and 'rig' are text, each key once, found {key!r}, {rig!r}")
        with reported(f"{path}, line {line}", BadConfig, BadSample, TypeError, ValueError):
            values = {
                name: tuple(map(float, v)) if isinstance(v, list) else v for name, v in row.items() if v is not None
            }
            infos[key] = SampleInfo(split, values)
        rigs[key] = rig
    return SampleRows(path, content.split, infos, rigs)


def _json_rows(text: str, path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    for line, words in enumerate(text.split("\n"), 1):  # within a text JSON allows other separators of lines
        if words.strip():
            yield line, parse_json(words.encode(), f"{path}, line {line}")


def _csv_rows(text: str, path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Rows of CSV, with their lines: a column holds whole numbers, numbers, flags or text; empty cells are left out."""
    rows = csv.DictReader(io.StringIO(text.lstrip("\r\n")), strict=True)
    with reported(f"{path} is not CSV", BadConfig, csv.Error):
        cells, header = list(rows), rows.fieldnames or []
    for line, row in enumerate(cells, 2):
        if None in row or None in row.values() or len(row) < len(header):
            raise BadConfig(f"{path}, line {line}: a row has a cell for each of {len(header)} different columns")
    as_text = ("key", "split", "rig")
    columns = {name: [row[name] for row in cells] for name in header}
    typed = {name: words if name in as_text else _typed(words) for name, words in columns.items()}
    for at in range(len(cells)):
        yield at + 2, {name: values[at] for name, values in typed.items() if values[at] not in (None, "")}


def _typed(column: Sequence[str]) -> Sequence[Value | None]:
    named = any("_" in word or _NUMBERED.fullmatch(word) for word in column)  # int reads 1_1 as 11, and 007 as 7
    numbers = () if named else (int, float)
    for read in (*numbers, lambda word: {"true": True, "false": False}[word.lower()], str):
        with contextlib.suppress(ValueError, KeyError):
            return [read(word) if word else None for word in column]
    return []
