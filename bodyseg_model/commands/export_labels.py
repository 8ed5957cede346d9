"""`bodyseg export-labels`: labels of a set, or of what `bodyseg segment` wrote, in formats of other programs.

COCO's as cocodataset.org/#format-data describes them; DensePose's charts as detectron2's DENSEPOSE_DATASETS.md numbers
them; LeRobot's v3.0 as the package `lerobot` 0.4 reads it. A new format is a function and an entry of `FORMATS`.
"""

import io
import json
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from bodyseg_data import loading
from bodyseg_data.artifacts import PAPER_SENSOR, VariantName
from bodyseg_data.commands import WHERE_HELP, Progress, check_target, command_line, option, provenance
from bodyseg_data.core import BadConfig, MissingLibrary, ProgressCallback, check_int, reported
from bodyseg_data.files import held_part, parse_json, part_beside, read_bytes, read_json, write_json
from bodyseg_data.labels import BACKGROUND, PART_CLASSES, PARTS33, LabelMap, label_map_from_json
from bodyseg_data.renders import read_array
from bodyseg_data.samples import Split, split_key
from bodyseg_data.shards import column_names, open_store
from bodyseg_model import segmentation
from bodyseg_model.recordings import find_frames

EXAMPLE = "bodyseg export-labels labelled --out coco --format coco"

_FORMAT: Final = "bodyseg label export 1"
_NOTE: Final = "export.json"  # in every export: what it is; such a folder may be replaced by another export
_BEGINNING: Final = '{"info": {"description": "exported by bodyseg"}, "licenses": [], "annotations": ['  # COCO's
_APPLES: Final = ("._", ".DS_Store")  # how names of files begin that macOS leaves in folders

DENSE_POSE: Final = np.zeros(256, np.uint8)
"""Label of the 33 parts -> DensePose's chart, uint8 [256], 0 for none; the first of those not told apart."""
DENSE_POSE[: len(PARTS33)] = [
    *(23, 23, 23, 2, 2, 2, 2, 2, 2, 1, 1, 1, 1, 1, 1),  # head; front and back of the trunk
    *(16, 15, 20, 19, 20, 19, 3, 4),  # right and left: shoulder, elbow, wrist, hand
    *(7, 8, 13, 14, 11, 12, 6, 5, 6, 5),  # hip, front and back of the knee, ankle, toes
]

FormatName = Literal["coco", "panoptic", "dense-pose-parts", "png", "lerobot"]
Images = Iterator["LabelImage"]


@dataclass(frozen=True)
class Options:
    folder: str = option("folder that `segment` wrote, or a set: its folder or address", positional=True, address=True)
    out: Path | None = option("folder that gets the export: a new one, or an earlier export's, which is replaced", None)
    format: FormatName | None = option("COCO's run lengths or panoptic PNGs, DensePose's parts, PNGs, LeRobot", None)
    coco: Path | None = option("in place of both: JSON file that gets COCO's run lengths, without ranges", None)
    frames: tuple[Path, ...] = option("with a folder of `segment`: the frames it labelled, to export their ranges", ())
    topic: str | None = option("of --frames: topic of a bag or array of an NPZ file (default: the only one)", None)
    variant: VariantName = option("with a set: artifacts of the ranges; labels are those without artifacts", "none")
    sensor: str = option("sensor model with the artifacts: the name of one that ships, or a TOML file", PAPER_SENSOR)
    seed: int = option("seed of the artifacts", 0)
    split: Split | None = option("with a set: split to export (default: train and test)", None)
    where: tuple[str, ...] = option(WHERE_HELP, ())
    labels: str | None = option("with a set: classes to export, a label map by name or file (default: the set's)", None)
    instances: str | None = option("with a set: its plane of instances (default: instances, if it has one)", None)
    fps: int = option("with lerobot: frames a second", 10)


class LabelImage(NamedTuple):
    """Labels of one image, uint8 [H, W], 255 where there is none.

    name: of its files; it may name folders. number: from 1, the same in every export. instances: uint16 [H, W], number,
    from 1, of a pixel's person or thing, 0: not known; None where nothing is counted. range: uint16 [H, W], steps of
    `step_m` metres, 0 = nothing measured; None: not known. sequence: of images that follow each other. time_s: of a
    frame, seconds. tracks: numbers that instances keep from frame to frame. split: of a set's sample.
    """

    name: str
    number: int
    labels: NDArray[np.uint8]
    instances: NDArray[np.uint16] | None
    range: NDArray[np.uint16] | None = None
    step_m: float = 1e-3
    sequence: str = ""
    time_s: float | None = None
    tracks: Mapping[int, int] = MappingProxyType({})
    split: Split | None = None


def run(options: Options) -> int:
    """Write the export: its folder appears when it is whole, in place of one of an earlier export."""
    check_int("--fps", options.fps, 1)
    if options.topic is not None and not options.frames:
        raise BadConfig("--topic is of --frames, which are missing")
    folder = Path(options.folder)
    if (folder / segmentation.UNFINISHED).is_file():
        raise BadConfig(f"`bodyseg segment` has not ended in {folder}: repeat its call")
    opened = partial(_frames if (folder / segmentation.SUMMARY).is_file() else _samples, options)
    if options.coco is not None and options.out is None and options.format is None:
        return _annotations(options, options.coco, opened)
    if options.coco is not None or options.out is None or options.format is None:
        raise BadConfig("give --out and --format, or --coco alone")
    facts = {"format": _FORMAT, **provenance(command_line("bodyseg export-labels", options))}
    if Path.cwd().is_relative_to(options.out.resolve()):
        raise BadConfig(f"--out must not hold the folder in which the command runs, found {options.out}")
    out = options.out.resolve() if options.out.is_symlink() else options.out  # the link stays
    old = part_beside(out)
    try:
        held = sorted(each.name for each in out.iterdir() if not each.name.startswith(_APPLES)) if out.exists() else []
        note = read_json(out / _NOTE) if _NOTE in held else {}
        if held and note.get("format") != _FORMAT:
            raise BadConfig(f"--out must be a new folder, or one of an earlier export: {out} holds {held[0]}")
        if held and not (isinstance(most := note.get("holds"), int) and _count(out) <= most):
            raise BadConfig(f"--out must hold an earlier export alone, found other files, too, in {out}: move them")
        with Progress("exporting", "images") as progress:
            label_map, images = opened(progress.update)
            with held_part(out, partial(Path.mkdir, parents=True)) as part:
                FORMATS[options.format](part, label_map, images, options)
                colours = zip(label_map.names, label_map.colours, strict=True)
                rows = [
                    {"name": name, "color": f"#{bytes(colour).hex()}", "attributes": []} for name, colour in colours
                ]
                (part / "classes.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
                told = {"kind": options.format, "labels": label_map.to_json(), "holds": _count(part) + 1}
                write_json(part / _NOTE, {**facts, **told})
                if out.exists():
                    out.rename(old)
                part.rename(out)
    except OSError as error:
        raise BadConfig(f"cannot write {out}: {(error.strerror or str(error)).splitlines()[0]}") from error
    finally:
        if old.exists():
            shutil.rmtree(old) if out.exists() else old.rename(out)
    sys.stderr.write(f"wrote {options.out}\n")
    return 0


def _annotations(options: Options, path: Path, opened: Callable[[ProgressCallback], tuple[LabelMap, Images]]) -> int:
    """Write COCO's annotations alone, without ranges: into a new file, or in place of an earlier export's."""
    check_target(path, "--coco")
    with reported(f"cannot write {path}", BadConfig, OSError), Progress("exporting", "images") as progress:
        if path.is_file() and np.fromfile(path, np.uint8, len(_BEGINNING)).tobytes() != _BEGINNING.encode():
            raise BadConfig(f"--coco must be a new file, or one of an earlier export, found {path}")
        label_map, images = opened(progress.update)
        with held_part(path, Path.mkdir) as part:
            _coco(part, label_map, (image._replace(range=None) for image in images), options)
            (part / "annotations.json").replace(path)
    sys.stderr.write(f"wrote {path}\n")
    return 0


def _count(folder: Path) -> int:
    """Files and folders within a folder, without macOS's own."""
    return sum(not entry.name.startswith(_APPLES) for entry in folder.rglob("*"))


def _samples(options: Options, progress: ProgressCallback) -> tuple[LabelMap, Images]:
    """Classes and samples of a set: numbers are places in the whole set, views of one body are a sequence."""
    if options.frames:
        raise BadConfig(f"--frames are of a folder that `bodyseg segment` wrote, found none in {options.folder}")
    chosen: dict[str, Any] = {"sensor": options.sensor, "labels": options.labels, "where": options.where}
    chosen["columns"] = [name for name in column_names(open_store(options.folder)[0]) if name == "instances"]
    planes = [options.instances] if options.instances else []
    images = loading.RangeImages(options.folder, options.variant, options.split, options.seed, planes=planes, **chosen)
    plane = options.instances or ("instances" if "instances" in images.manifest.planes else None)
    numbers = {key: at for at, key in enumerate(chain.from_iterable(each.keys for each in images.manifest.shards), 1)}

    def each() -> Images:
        by_split = np.argsort(images.table()["split"] == "test", kind="stable")  # one after the other, as LeRobot's
        for done, index in enumerate(by_split.tolist(), 1):
            sample = images.clean(index)
            labels, instances = images.label_map.table[sample.labels], None
            if plane is not None:
                instances = sample.planes[plane].astype(np.uint16)
            elif images.label_map.of_bodies:  # one person a view
                instances = (labels != BACKGROUND).astype(np.uint16)
            ranges = images.augmentation_of(sample)(sample, images.epoch).range
            of_range = ranges, images.manifest.rig_of(sample).range_step_m, split_key(sample.key)[0]
            yield LabelImage(sample.key, numbers[sample.key], labels, instances, *of_range, split=sample.info.split)
            progress(done, len(images))

    return images.label_map, each()


def _frames(options: Options, progress: ProgressCallback) -> tuple[LabelMap, Images]:
    """Classes and frames of `bodyseg segment`: numbers are places in its summary, frames of one input a sequence."""
    for name in ("variant", "sensor", "seed", "split", "where", "labels", "instances"):
        if getattr(options, name) != getattr(Options, name):
            raise BadConfig(f"--{name} is for sets, not for {options.folder}, which `bodyseg segment` wrote")
    folder = Path(options.folder)
    file = folder / segmentation.SUMMARY
    try:
        summary = parse_json(read_bytes(file), str(file))  # a kilobyte a frame: more than `read_json` takes
        label_map = label_map_from_json(summary["labels"], f"{file}, labels")
        each = [(str(at["name"]), str(at["path_id"])) for at in summary["each"]]
        times = [at.get("time_s") for at in summary["each"]]
        skipped = len(summary.get("skipped", ()))  # among them recordings that cannot be opened
        tracks = [{n: b["track"] for n, b in enumerate(at["bodies"], 1) if "track" in b} for at in summary["each"]]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise BadConfig(f"{file} is none of `bodyseg segment`: {error!r}") from error
    given = find_frames(options.frames, options.topic, summary.get("given_unit_m"), skipped) if options.frames else []
    frames = {each.path_id: each for each in given}

    def images() -> Images:
        for number, (name, path_id) in enumerate(each, 1):
            if Path(name).is_absolute() or ".." in Path(name).parts:
                raise BadConfig(f"an image's name must stay in its folder, found {name}")
            of_range: tuple[Any, float, str] = (None, 1e-3, "")
            labels = read_array(folder / segmentation.ImageKind.LABELS / f"{name}.png")
            if labels.ndim != 2 or labels.dtype != np.uint8:
                raise BadConfig(f"labels must be uint8 [H, W], found {labels.dtype} {labels.shape}: {name}")
            if len(wrong := labels[(labels >= len(label_map)) & (labels != BACKGROUND)]):
                raise BadConfig(f"labels must be below {len(label_map)}, or {BACKGROUND}, found {wrong[0]}: {name}")
            instances = (
                read_array(folder / segmentation.ImageKind.PERSONS / f"{name}.png") if label_map.of_bodies else None
            )
            if instances is not None and (instances.dtype != np.uint16 or instances.shape != labels.shape):
                found = f"{instances.dtype} {instances.shape}: {name}"
                raise BadConfig(f"persons must be uint16 {labels.shape}, as their labels, found {found}")
            if frames:
                if path_id not in frames:
                    raise BadConfig(f"--frames must be those labelled, where they lay: {name} is not among them")
                frame, bent = frames[path_id], folder / segmentation.ImageKind.UNDISTORTED / f"{name}.png"
                ranges = read_array(bent) if bent.exists() else frame.read()
                if ranges.shape != labels.shape:
                    raise BadConfig(f"{frame.where}: its labels are of another size, {labels.shape}")
                of_range = ranges * (ranges < 65535), frame.step_m, str(frame.sequence)  # 65535 is saturated
            of_frame = *of_range, times[number - 1], tracks[number - 1]
            yield LabelImage(name, number, labels, instances, *of_frame)
            progress(number, len(each))

    return label_map, images()


def segments(image: LabelImage) -> Iterator[tuple[dict[str, Any], NDArray[np.int64]]]:
    """Yield COCO's facts, with id category + 256 instance, and run lengths of every class of every instance."""
    codes, rows = image.labels.astype(np.int32) + 1, len(image.labels)
    if image.instances is not None:
        codes += 256 * image.instances.astype(np.int32)
    flat = np.where(image.labels == BACKGROUND, 0, codes).T.ravel()
    starts = np.flatnonzero(np.diff(flat, prepend=-1))
    runs, kinds = np.stack([starts, np.append(starts[1:], flat.size)], 1), flat[starts]
    for code in np.unique(kinds[kinds > 0]).tolist():
        own = runs[kinds == code]
        counts = np.diff(own.ravel(), prepend=0, append=flat.size)
        (left, top), (right, bottom) = np.divmod(own[:, 0], rows), np.divmod(own[:, 1] - 1, rows)
        over = (left != right).any()  # a run goes on at the top of the next column
        first, last = (0, rows - 1) if over else (int(top.min()), int(bottom.max()))
        box = [int(left[0]), first, int(right[-1] - left[0]) + 1, last - first + 1]
        facts = {"id": code, "category_id": code & 255, "area": int(counts[1::2].sum()), "bbox": box}
        facts |= {"iscrowd": 0, "instance": code >> 8}
        facts |= {"track_id": image.tracks[code >> 8]} if code >> 8 in image.tracks else {}
        yield facts, counts if counts[-1] else counts[:-1]


def compressed(counts: NDArray[np.int64]) -> str:
    """COCO's text of run lengths: from the fourth on, less the one before the last; in signed digits of five bits, the
    least first, each a character from "0" on, with 32 added where another follows.
    """
    text = bytearray()
    for at, count in enumerate(counts.tolist()):
        left = count - (int(counts[at - 2]) if at > 2 else 0)
        more = True
        while more:
            digit, left = left & 31, left >> 5
            more = left != (-1 if digit & 16 else 0)
            text.append(digit + 32 * more + 48)
    return text.decode()


def _path(folder: Path, name: str) -> Path:
    """A path within the export's folder; makes the folders on the way."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _with_ranges(folder: Path, images: Images) -> Images:
    """Yield images, with their ranges written, where they are known."""
    for image in images:
        if image.range is not None:
            _path(folder, f"range/{image.name}.png").write_bytes(_png(image.range))
        yield image


def _png(image: NDArray[Any], palette: NDArray[np.uint8] | None = None) -> bytes:
    picture, buffer = Image.fromarray(image), io.BytesIO()
    if palette is not None:
        picture.putpalette(palette.tobytes())
    picture.save(buffer, "PNG", compress_level=2)
    return buffer.getvalue()


def _coco(folder: Path, label_map: LabelMap, images: Images, options: Options, panoptic: bool = False) -> None:
    """One annotation for every segment; for `panoptic` one for every image, and a PNG of ids, R + 256 G + 256^2 B."""
    told_images, written, counted = list[dict[str, Any]](), 0, {True: set[int](), False: set[int]()}
    with _path(folder, "panoptic.json" if panoptic else "annotations.json").open("w", encoding="utf-8") as file:
        file.write(_BEGINNING)
        for image in _with_ranges(folder, images):
            rows, columns = image.labels.shape
            size = {"width": columns, "height": rows, "range_step_m": image.step_m}
            name = f"{'' if image.range is None else 'range/'}{image.name}.png"  # else of a file of the frames
            told_images.append({"id": image.number, "file_name": name, **size})
            told_images[-1] |= {} if image.time_s is None else {"time_s": image.time_s}
            told_images[-1] |= {} if image.split is None else {"split": image.split}
            entries, ids = list[dict[str, Any]](), np.zeros(image.labels.size, np.uint32)
            for facts, counts in segments(image):
                ids[np.repeat(np.arange(len(counts)) % 2 > 0, counts)] = facts["id"]
                counted[facts["instance"] > 0].add(facts["category_id"])
                of_image = {"id": written + len(entries) + 1, "image_id": image.number}
                runs = {**of_image, "segmentation": {"size": [rows, columns], "counts": compressed(counts)}}
                entries.append(facts if panoptic else {**facts, **runs})
            if panoptic:
                colours = np.stack([ids >> shift & 255 for shift in (0, 8, 16)], -1).astype(np.uint8)
                colours = np.ascontiguousarray(colours.reshape(columns, rows, 3).swapaxes(0, 1))
                _path(folder, f"panoptic/{image.name}.png").write_bytes(_png(colours))
                entries = [{"image_id": image.number, "file_name": f"{image.name}.png", "segments_info": entries}]
            file.writelines(f"{',' * (written + at > 0)}\n{json.dumps(entry)}" for at, entry in enumerate(entries))
            written += len(entries)
        categories, whole = [], "person" if label_map.of == PART_CLASSES else label_map.of.name
        for at, name in enumerate(label_map.names):
            own = {label_map.of.entries[member].within for member in label_map.members[at]}  # what it is a part of
            wider = (own.pop() if len(own) == 1 else None) or whole
            # A class that no image shows is as most are.
            thing = at + 1 in counted[True] or bool(counted[True] and at + 1 not in counted[False])
            kind = {"isthing": int(thing)} if panoptic else {}
            categories.append({"id": at + 1, "name": name, "supercategory": wider, **kind})
        file.write(f'],\n"categories": {json.dumps(categories)},\n"images": {json.dumps(told_images)}}}\n')


def _indexed(folder: Path, label_map: LabelMap, images: Images, options: Options) -> None:
    """PNGs of labels with the classes' colours as palette."""
    palette = np.concatenate([label_map.colours, np.zeros((256 - len(label_map), 3), np.uint8)])
    for image in _with_ranges(folder, images):
        _path(folder, f"labels/{image.name}.png").write_bytes(_png(image.labels, palette))


def _dense_pose(folder: Path, label_map: LabelMap, images: Images, options: Options) -> None:
    """Images of DensePose's charts, the I of its IUV: uint8, 0 = nobody; see `DENSE_POSE`."""
    differing = label_map.difference(PARTS33)
    if differing is not None:
        raise BadConfig(f"DensePose's parts are made of the 33 parts, found {differing}")
    for image in _with_ranges(folder, images):
        _path(folder, f"dense_pose/{image.name}.png").write_bytes(_png(DENSE_POSE[image.labels]))


def _lerobot(folder: Path, label_map: LabelMap, images: Images, options: Options) -> None:
    """Codebase version v3.0: sequences as episodes; ranges and labels as PNGs of 16 and 8 bits in a Parquet file."""
    try:
        arrow, parquet = import_module("pyarrow"), import_module("pyarrow.parquet")
    except ImportError as error:
        raise MissingLibrary("LeRobot's format needs the package 'pyarrow': pip install pyarrow") from error
    kinds = {"timestamp": "float32"} | dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")
    features: dict[str, Any] = {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in kinds.items()}
    depth, labels = "observation.images.depth", "observation.images.labels"
    picture = arrow.struct([("bytes", arrow.binary()), ("path", arrow.string())])
    schema = arrow.schema({depth: picture, labels: picture, **kinds})
    episodes, rows, sequence, task = list[dict[str, Any]](), list[dict[str, Any]](), None, "label what the camera sees"
    splits: dict[str, list[int]] = {}
    with parquet.ParquetWriter(_path(folder, "data/chunk-000/file-000.parquet"), schema) as writer:
        for frame, image in enumerate(images):
            if image.range is None:
                raise BadConfig("a data set of LeRobot needs ranges: give --frames, as they were given to segment")
            told = {"dtype": "image", "shape": [*image.range.shape, 1], "names": ["height", "width", "channels"]}
            pair = {labels: told, depth: {**told, "info": {"is_depth_map": True, "range_step_m": image.step_m}}}
            if features != {**features, **pair} and frame:
                raise BadConfig(f"images of LeRobot have one size and step, found another one: {image.name}")
            features |= pair
            if (image.split, image.sequence) != sequence:
                sequence, places = (image.split, image.sequence), {"data/chunk_index": 0, "data/file_index": 0}
                places |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0, "dataset_from_index": frame}
                splits.setdefault(image.split or "train", [len(episodes), 0])[1] = len(episodes) + 1
                episodes.append({"episode_index": len(episodes), "tasks": [task], "length": 0, **places})
            within = episodes[-1]["length"]
            episodes[-1] |= {"length": within + 1, "dataset_to_index": frame + 1}
            at = {"frame_index": within, "episode_index": len(episodes) - 1, "index": frame, "task_index": 0}
            pictures = {depth: _png(image.range), labels: _png(image.labels)}
            held = {name: {"bytes": data, "path": f"{image.name}.png"} for name, data in pictures.items()}
            rows.append({**held, "timestamp": within / options.fps, **at})
            if len(rows) == 64:
                writer.write_table(arrow.Table.from_pylist(rows, schema))
                rows = []
        writer.write_table(arrow.Table.from_pylist(rows, schema))
    total, paths = len(episodes), "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    info: dict[str, Any] = {"codebase_version": "v3.0", "robot_type": None, "fps": options.fps, "video_path": None}
    info |= {"total_episodes": total, "total_frames": episodes[-1]["dataset_to_index"], "total_tasks": 1}
    info |= {"chunks_size": 1000, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200, "features": features}
    info |= {"data_path": paths, "splits": {split: f"{first}:{end}" for split, (first, end) in splits.items()}}
    write_json(_path(folder, "meta/info.json"), info)
    # pandas, which reads the tasks, finds them as the index.
    column = {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    index = json.dumps({"index_columns": ["task"], "column_indexes": [], "columns": [column]})
    tasks = arrow.table({"task_index": [0], "task": [task]}).replace_schema_metadata({"pandas": index})
    for name, table in (("tasks", tasks), ("episodes/chunk-000/file-000", arrow.Table.from_pylist(episodes))):
        parquet.write_table(table, _path(folder, f"meta/{name}.parquet"))


FORMATS: Final[dict[FormatName, Callable[..., None]]] = {
    "coco": _coco,
    "panoptic": partial(_coco, panoptic=True),
    "dense-pose-parts": _dense_pose,
    "png": _indexed,
    "lerobot": _lerobot,
}
