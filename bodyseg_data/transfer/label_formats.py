"""Labels in formats of other programs: COCO, COCO panoptic, parts of DensePose, indexed PNGs, LeRobot's data sets.

Formats as their owners describe them: COCO's at cocodataset.org/#format-data; DensePose's charts as detectron2's
DENSEPOSE_DATASETS.md numbers them; Pascal VOC's folders as CVAT's "Segmentation mask" imports them; LeRobot's v3.0 as
the package `lerobot` 0.4 reads it. A new format is a function and an entry of `LABEL_FORMATS`.
"""

from __future__ import annotations

import contextlib
import io
import json
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_data.files import part_beside, read_json, write_json
from bodyseg_data.labels import BACKGROUND, PART_CLASSES, PARTS33, LabelMap

_FORMAT: Final = "bodyseg label export 1"
_NOTE: Final = "export.json"  # of every export: what it is, and that another may replace it
_CLASSES: Final = "classes.json"  # of every export: names and colours, as CVAT's label constructor takes them
_LEVEL: Final = 2  # of zlib, for PNGs

_DEPTH, _LABELS = "observation.images.depth", "observation.images.labels"  # LeRobot's names of images
_FILE_BYTES: Final = 100_000_000  # of a file of LeRobot's, after which another one begins
_BATCH: Final = 64  # frames that are written together
_TASK: Final = "label what the camera sees"

DENSE_POSE: Final = np.zeros(256, np.uint8)
"""Label of the 33 parts -> DensePose's chart, uint8 [256], 0 for all else.

Borders between parts lie half-way between two landmarks; limbs are those of the label map limbs14, which are
DensePose's 14 coarse parts. Its charts 7 and 9, 8 and 10 (back and front of the thighs), 15 and 17 ... 20 and 22
(inside and outside of the arms), 23 and 24 (sides of the head) cannot be told apart: the first of each two stands for
both.
"""
DENSE_POSE[: len(PARTS33)] = [
    *(23, 23, 23, 2, 2, 2, 2, 2, 2, 1, 1, 1, 1, 1, 1),  # head, front and back of the trunk
    *(16, 15, 20, 19, 20, 19, 3, 4),  # Acromion, Olecranon, Radial Styloid, Dactylion: each right, left
    *(7, 8, 13, 14, 11, 12, 6, 5, 6, 5),  # Trochanterion, front and back of the knees, Malleolus, Digit II
]


@dataclass(frozen=True)
class LabelImage:
    """Labels of one image.

    name: of its files, without suffix; it may name folders ("left/1"). number: from 1, the same in every export.
    labels: uint8 [H, W], classes, 255 elsewhere. instances: uint16 [H, W], number, from 1, of the person or thing that
    a pixel belongs to; None where classes are of nothing that is counted. crowds: numbers of instances that are several
    not told apart. range: uint16 [H, W], steps of `step_m` metres, 0 = nothing measured; None if not known. sequence:
    images of one follow each other, as views of a body or frames of a recording.
    """

    name: str
    number: int
    labels: NDArray[np.uint8] = field(repr=False)
    instances: NDArray[np.uint16] | None = field(default=None, repr=False)
    crowds: frozenset[int] = frozenset()
    range: NDArray[np.uint16] | None = field(default=None, repr=False)
    step_m: float = 1e-3
    sequence: str = ""


def segments(image: LabelImage) -> Iterator[tuple[int, int, NDArray[np.int64]]]:
    """Yield instance, class, and pixels of every class of every instance, as runs down the columns: int64 [N, 2], first
    and end of each. Instance 0 is what nobody told apart.
    """
    codes = image.labels.astype(np.int32)
    if image.instances is not None:
        codes |= image.instances.astype(np.int32) << 8
    codes[image.labels == BACKGROUND] = -1
    flat = codes.T.ravel()
    starts = np.flatnonzero(np.diff(flat, prepend=-2))
    runs, kinds = np.stack([starts, np.append(starts[1:], flat.size)], 1), flat[starts]
    for code in np.unique(kinds[kinds >= 0]).tolist():
        yield code >> 8, code & 255, runs[kinds == code]


def box_of(runs: NDArray[np.int64], rows: int) -> list[int]:
    """Column, row, width and height of the smallest box around runs down the columns of an image of so many rows."""
    (left, right), first, last = (runs[0, 0] // rows, (runs[-1, 1] - 1) // rows), runs[:, 0], runs[:, 1] - 1
    whole = (first // rows != last // rows).any()  # a run that goes on at the top of the next column
    top, bottom = (0, rows - 1) if whole else ((first % rows).min(), (last % rows).max())
    return [int(each) for each in (left, top, right - left + 1, bottom - top + 1)]


def run_lengths(runs: NDArray[np.int64], pixels: int) -> NDArray[np.int64]:
    """COCO's run lengths of an image of so many pixels: outside and inside by turns, outside first."""
    counts = np.diff(runs.ravel(), prepend=0, append=pixels)
    return counts if counts[-1] else counts[:-1]


def compressed(counts: NDArray[np.int64]) -> str:
    """COCO's text of run lengths: from the fourth on, less the one before the last; in signed digits of five bits, the
    least first, each a character from "0" on, with 32 added where another follows.
    """
    left = counts.copy()
    left[3:] -= counts[1:-2]
    going, characters, written = np.ones(len(left), bool), [], []
    while going.any():
        digit, left = left & 31, left >> 5
        more = np.where(digit & 16, left != -1, left != 0)
        characters.append((digit + 32 * more + 48).astype(np.uint8))
        written.append(going)
        going = going & more
    return np.stack(characters, 1)[np.stack(written, 1)].tobytes().decode()


def wider_class(label_map: LabelMap, label: int) -> str:
    """What a class is a part of, as the set says (`LabelClass.within`); else "person" for body parts, and the name of
    the set's classes for others.
    """
    own = {label_map.of.entries[member].within for member in label_map.members[label]}
    return (own.pop() if len(own) == 1 else None) or ("person" if label_map.of == PART_CLASSES else label_map.of.name)


def _png(image: NDArray[Any], palette: NDArray[np.uint8] | None = None) -> bytes:
    picture, buffer = Image.fromarray(image), io.BytesIO()
    if palette is not None:
        picture.putpalette(palette.tobytes())
    picture.save(buffer, "PNG", compress_level=_LEVEL)
    return buffer.getvalue()


@dataclass(frozen=True)
class _Export:
    """An export as it is written: its folder, classes and images; counts of COCO as numbers; LeRobot's frame rate."""

    folder: Path
    label_map: LabelMap
    images: Iterable[LabelImage]
    uncompressed: bool = False
    fps: int = 10

    def save(self, name: str, data: bytes) -> str:
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
        return name

    def each(self) -> Iterator[LabelImage]:
        """Write the images' ranges, where they are known, and yield the images."""
        for image in self.images:
            if image.range is not None:
                self.save(f"range/{image.name}.png", _png(image.range))
            yield image


def _coco(export: _Export, panoptic: bool = False) -> None:
    """One annotation for every class of every instance, as run lengths; for `panoptic` one for every image, and a PNG
    of ids R + 256 G + 256^2 B, which are category + 256 instance.
    """
    images, written, things = [], 0, False
    with (export.folder / ("panoptic.json" if panoptic else "annotations.json")).open("w", encoding="utf-8") as file:
        file.write('{"info": {"description": "exported by bodyseg"}, "licenses": [], "annotations": [')
        for image in export.each():
            (rows, columns), things = image.labels.shape, things or image.instances is not None
            size = {"width": columns, "height": rows}
            path = f"range/{image.name}.png"
            images.append({"id": image.number, "file_name": path, **size, "range_step_m": image.step_m})
            found: list[dict[str, Any]] = []
            for instance, label, runs in segments(image):
                counts = run_lengths(runs, image.labels.size)
                facts = {"category_id": label + 1, "area": int(counts[1::2].sum()), "bbox": box_of(runs, rows)}
                facts |= {"iscrowd": int(instance in image.crowds), "instance": instance}
                if panoptic:
                    found.append({"id": label + 1 + 256 * instance, **facts})
                    continue
                told = counts.tolist() if export.uncompressed else compressed(counts)
                runs_told = {"size": [rows, columns], "counts": told}
                number = written + len(found) + 1
                found.append({"id": number, "image_id": image.number, **facts, "segmentation": runs_told})
            if panoptic:
                ids = (image.labels.astype(np.uint32) + 1) * (image.labels != BACKGROUND)
                ids += 256 * (0 if image.instances is None else image.instances.astype(np.uint32)) * (ids > 0)
                colours = np.stack([ids >> shift & 255 for shift in (0, 8, 16)], -1).astype(np.uint8)
                export.save(f"panoptic/{image.name}.png", _png(colours))
                found = [{"image_id": image.number, "file_name": f"{image.name}.png", "segments_info": found}]
            for entry in found:
                file.write(f"{',' if written else ''}\n{json.dumps(entry)}")
                written += 1
        kind = {"isthing": int(things)} if panoptic else {}
        categories = [
            {"id": label + 1, "name": name, "supercategory": wider_class(export.label_map, label), **kind}
            for label, name in enumerate(export.label_map.names)
        ]
        file.write(f'],\n"categories": {json.dumps(categories)},\n"images": {json.dumps(images)}}}\n')


def _panoptic(export: _Export) -> None:
    _coco(export, panoptic=True)


def _indexed(export: _Export) -> None:
    """PNGs of labels with the classes' colours as palette, in the folders of Pascal VOC."""
    palette, names = np.zeros((256, 3), np.uint8), []
    palette[: len(export.label_map)] = export.label_map.colours
    for image in export.each():
        export.save(f"SegmentationClass/{image.name}.png", _png(image.labels, palette))
        names.append(f"{image.name}\n")
    export.save("ImageSets/Segmentation/default.txt", "".join(names).encode())
    rows = zip(export.label_map.names, export.label_map.colours.tolist(), strict=True)
    lines = [f"{name.replace(':', '-')}:{','.join(map(str, colour))}::\n" for name, colour in rows]
    export.save("labelmap.txt", "".join(["# label:color_rgb:parts:actions\nbackground:0,0,0::\n", *lines]).encode())


def _dense_pose(export: _Export) -> None:
    """Images of DensePose's charts, the I of its IUV: uint8, 0 = nobody; see `DENSE_POSE`."""
    differing = export.label_map.difference(PARTS33)
    if differing is not None:
        raise BadConfig(f"DensePose's parts are made of the 33 parts, found {differing}")
    for image in export.each():
        export.save(f"dense_pose/{image.name}.png", _png(DENSE_POSE[image.labels]))


def _lerobot(export: _Export) -> None:
    """Codebase version v3.0: sequences as episodes; ranges and labels as PNGs of 16 and 8 bits in Parquet files."""
    try:
        arrow, parquet = import_module("pyarrow"), import_module("pyarrow.parquet")
    except ImportError as error:
        raise MissingLibrary("LeRobot's format needs the package 'pyarrow': pip install pyarrow") from error
    picture = arrow.struct([("bytes", arrow.binary()), ("path", arrow.string())])
    numbers = {"timestamp": "float32"} | dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")
    features: dict[str, Any] = {}
    episodes: list[dict[str, Any]] = []
    rows: list[dict[str, Any]] = []
    sums: dict[str, NDArray[np.float64]] = {}
    writer, sequence, file, size, frames = None, None, -1, _FILE_BYTES + 1, 0
    with contextlib.ExitStack() as closing:
        for image in export.images:
            held = {_LABELS: image.labels, **({} if image.range is None else {_DEPTH: image.range})}
            found = {name: _image_feature(each, image.step_m) for name, each in held.items()}
            features = features or found
            if found != features:
                raise BadConfig(f"LeRobot's images must have one size and step, and a range or none: not {image.name}")
            if image.sequence != sequence:
                sequence = image.sequence
                if size > _FILE_BYTES:  # an episode is in one file
                    _write_rows(rows, writer)
                    closing.close()
                    file, size = file + 1, 0
                    path = f"data/chunk-{file // 1000:03d}/file-{file % 1000:03d}.parquet"
                    kinds = {**dict.fromkeys(features, picture), **numbers}
                    target = export.folder / export.save(path, b"")
                    writer = closing.enter_context(parquet.ParquetWriter(target, arrow.schema(kinds)))
                places = {"data/chunk_index": file // 1000, "data/file_index": file % 1000}
                places |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0, "dataset_from_index": frames}
                episodes.append({"episode_index": len(episodes), "tasks": [_TASK], "length": 0, **places})
            within = episodes[-1]["length"]
            places = {"frame_index": within, "episode_index": len(episodes) - 1, "index": frames, "task_index": 0}
            rows.append({"timestamp": within / export.fps, **places})
            for name, each in held.items():
                rows[-1][name] = {"bytes": _png(each), "path": f"{image.name}.png"}
                size += len(rows[-1][name]["bytes"])
                sums[name] = _summed(sums.get(name), each / (255.0 if name == _LABELS else 1.0))
            frames += 1
            episodes[-1] |= {"length": within + 1, "dataset_to_index": frames}
            if len(rows) == _BATCH:
                _write_rows(rows, writer)
        _write_rows(rows, writer)
    plain = {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in numbers.items()}
    info: dict[str, Any] = {"codebase_version": "v3.0", "robot_type": None, "fps": export.fps, "video_path": None}
    info |= {"total_episodes": len(episodes), "total_frames": frames, "total_tasks": 1, "chunks_size": 1000}
    info |= {"data_files_size_in_mb": 100, "video_files_size_in_mb": 200, "splits": {"train": f"0:{len(episodes)}"}}
    info |= {"data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"}
    info |= {"features": {**features, **plain}}
    export.save("meta/info.json", json.dumps(info, indent=1).encode())
    spreads = {name: _spread(*each.tolist(), frames) for name, each in sums.items()}
    export.save("meta/stats.json", json.dumps(spreads, indent=1).encode())
    # pandas, which reads the tasks, finds them as the index.
    column = {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    index = json.dumps({"index_columns": ["task"], "column_indexes": [], "columns": [column]})
    tasks = arrow.table({"task_index": [0], "task": [_TASK]}).replace_schema_metadata({"pandas": index})
    parquet.write_table(tasks, export.folder / export.save("meta/tasks.parquet", b""))
    target = export.folder / export.save("meta/episodes/chunk-000/file-000.parquet", b"")
    parquet.write_table(arrow.Table.from_pylist(episodes), target)


def _image_feature(image: NDArray[Any], step_m: float) -> dict[str, Any]:
    depth = {"info": {"is_depth_map": True, "range_step_m": step_m}} if image.dtype == np.uint16 else {}
    return {"dtype": "image", "shape": [*image.shape, 1], "names": ["height", "width", "channels"], **depth}


def _write_rows(rows: list[dict[str, Any]], writer: Any) -> None:
    """Write rows, and forget them."""
    if rows:
        writer.write_table(import_module("pyarrow").Table.from_pylist(rows, writer.schema))
        rows.clear()


def _summed(before: NDArray[np.float64] | None, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Least, greatest, sum, sum of squares and number of all values so far, float64 [5]."""
    new = np.array([values.min(), values.max(), values.sum(), (values**2).sum(), values.size])
    if before is None:
        return new
    return np.array([min(before[0], new[0]), max(before[1], new[1]), *(before[2:] + new[2:])])


def _spread(least: float, most: float, total: float, squares: float, values: float, frames: int) -> dict[str, Any]:
    """Statistics of one channel in the numbers that LeRobot's reader gives."""
    mean = total / values
    found = {"min": least, "max": most, "mean": mean, "std": max(squares / values - mean**2, 0.0) ** 0.5}
    return {**{name: [[[value]]] for name, value in found.items()}, "count": [frames]}


LabelFormat = Literal["coco", "panoptic", "dense-pose-parts", "png", "lerobot"]

LABEL_FORMATS: Final[dict[LabelFormat, Callable[[_Export], None]]] = {
    "coco": _coco,
    "panoptic": _panoptic,
    "dense-pose-parts": _dense_pose,
    "png": _indexed,
    "lerobot": _lerobot,
}
"""Name -> writer of an export."""


def write_labels(
    out: Path,
    kind: LabelFormat,
    label_map: LabelMap,
    images: Iterable[LabelImage],
    facts: Mapping[str, Any],
    uncompressed: bool = False,
    fps: int = 10,
) -> None:
    """Write labels into the folder `out` in one of `LABEL_FORMATS`; it appears when it is whole.

    label_map: the classes. facts: plain JSON about the labels, for export.json. uncompressed: COCO's run lengths as
    numbers and not as text. fps: LeRobot's frames per second. A folder of an earlier export is replaced. Raises
    BadConfig for any other folder that holds something, or one that cannot be written; MissingLibrary.
    """
    part, old = part_beside(out), part_beside(out)
    try:
        _check_own(out)
        part.mkdir(parents=True)
        LABEL_FORMATS[kind](_Export(part, label_map, images, uncompressed, fps))
        colours = [f"#{bytes(colour).hex()}" for colour in label_map.colours]
        rows = [{"name": n, "color": c, "attributes": []} for n, c in zip(label_map.names, colours, strict=True)]
        (part / _CLASSES).write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
        write_json(part / _NOTE, {"format": _FORMAT, "kind": kind, **facts, "labels": label_map.to_json()})
        if out.exists():
            out.rename(old)
        part.rename(out)
    except OSError as error:
        raise BadConfig(f"cannot write {out}: {(error.strerror or str(error)).splitlines()[0]}") from error
    finally:
        for folder in (part, old):
            shutil.rmtree(folder, ignore_errors=True)


def _check_own(out: Path) -> None:
    """Raise BadConfig unless a folder is new, empty or of an earlier export."""
    held = sorted(entry.name for entry in out.iterdir()) if out.exists() else []
    with contextlib.suppress(BadConfig):
        if not held or read_json(out / _NOTE).get("format") == _FORMAT:
            return
    raise BadConfig(f"--out must be a new folder, or one of an earlier export of labels: {out} holds {held[0]}")
