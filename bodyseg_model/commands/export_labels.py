"""`bodyseg export-labels`: labels of a set, or of what `bodyseg segment` wrote, in formats of other programs."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts import PAPER_SENSOR, VariantName
from bodyseg_data.commands import WHERE_HELP, Progress, last_name, option
from bodyseg_data.core import BadConfig, ProgressCallback, check_int
from bodyseg_data.labels import BACKGROUND, PART_CLASSES, LabelMap, label_map_from_json
from bodyseg_data.loading import RangeImages
from bodyseg_data.renders import read_array
from bodyseg_data.samples import ReadSplit, split_key
from bodyseg_data.transfer import LabelFormat, LabelImage, write_labels
from bodyseg_model.recordings import Frame, find_frames
from bodyseg_model.segmentation import LABELS, SUMMARY, UNDISTORTED, read_summary

EXAMPLE = "bodyseg export-labels --in labelled --out coco --format coco"

_INSTANCES: Final = "instances"
_SATURATED: Final = 65535


@dataclass(frozen=True)
class Options:
    """Options of `bodyseg export-labels`."""

    folder: str = option("folder that `bodyseg segment` wrote, or folder or address of a set", address=True, flag="in")
    out: Path = option("folder for the export: a new one, or of an earlier export")
    format: LabelFormat = option("COCO's run lengths or panoptic PNGs, DensePose's parts, indexed PNGs, LeRobot v3.0")
    frames: tuple[Path, ...] = option(
        "of `segment`'s folder: the frames, as given to it; exports their ranges, too", ()
    )
    topic: str | None = option("topic of a bag or array of an NPZ file among --frames", None)
    variant: VariantName = option("of a set: artifacts of the ranges; labels are those without artifacts", "none")
    sensor: str = option("the artifacts: a sensor that ships with the package, or a TOML file", PAPER_SENSOR)
    seed: int = option("seed of the artifacts", 0)
    split: ReadSplit | None = option("only this split of a set (default: train and test)", None)
    where: tuple[str, ...] = option(WHERE_HELP, ())
    labels: str | None = option("classes of a set to export: a label map (default: the set's)", None)
    instances: str | None = option("the set's image of instances (default: instances, if it has one)", None)
    uncompressed: bool = option("COCO's run lengths as numbers, not as text", False)
    fps: int = option("LeRobot's frames per second", 10)


def run(options: Options) -> int:
    """Write the export."""
    check_int("--fps", options.fps, 1)
    of_frames = (Path(options.folder) / SUMMARY).is_file()
    label_map, images, facts = _of_frames(options) if of_frames else _of_set(options)
    with Progress("exporting", "images") as progress:
        chosen = images(progress.update)
        write_labels(options.out, options.format, label_map, chosen, facts, options.uncompressed, options.fps)
    sys.stderr.write(f"wrote {options.out}\n")
    return 0


Images = Any  # a function of a progress callback that yields `LabelImage`s


def _of_set(options: Options) -> tuple[LabelMap, Images, dict[str, Any]]:
    def opened(planes: Sequence[str]) -> RangeImages:
        return RangeImages(
            options.folder,
            options.variant,
            options.split,
            options.seed,
            sensor=options.sensor,
            labels=options.labels,
            where=options.where,
            planes=planes,
        )

    if options.frames:
        raise BadConfig(f"--frames are of a folder that `bodyseg segment` wrote, found a set: {options.folder}")
    images = opened([options.instances] if options.instances else [])
    facts = {"set": last_name(options.folder), "variant": options.variant, "sensor": options.sensor}
    plane = options.instances or (_INSTANCES if _INSTANCES in images.manifest.planes else None)
    return images.label_map, partial(_samples, images, plane), {**facts, "seed": options.seed, "split": options.split}


def _samples(images: RangeImages, plane: str | None, progress: ProgressCallback) -> Iterator[LabelImage]:
    """Yield the samples of a set: numbers are their places in the whole set, views of one body are a sequence."""
    keys = chain.from_iterable(shard.keys for shard in images.manifest.shards)
    numbers = {key: number for number, key in enumerate(keys, 1)}
    of_parts = images.manifest.classes == PART_CLASSES
    for index in range(len(images)):
        sample = images.clean(index)
        labels = images.label_map.table[sample.labels]
        instances = None if plane is None else sample.planes[plane].astype(np.uint16)
        if plane is None and of_parts:  # one person a view
            instances = (labels != BACKGROUND).astype(np.uint16)
        made, step_m = images.augmentation_of(sample)(sample, images.epoch), images.manifest.rig_of(sample).range_step_m
        sequence = split_key(sample.key)[0]
        yield LabelImage(sample.key, numbers[sample.key], labels, instances, frozenset(), made.range, step_m, sequence)
        progress(index + 1, len(images))


def _of_frames(options: Options) -> tuple[LabelMap, Images, dict[str, Any]]:
    file = Path(options.folder) / SUMMARY
    summary = read_summary(file)
    of_sets = (options.split, options.labels, options.instances)
    if options.variant != "none" or options.where or any(each is not None for each in of_sets):
        raise BadConfig(f"--variant, --split, --where, --labels and --instances are of sets, found frames: {file}")
    label_map = label_map_from_json(summary.get("labels"), f"{file}, labels")
    frames = {frame.path_id: frame for frame in find_frames(options.frames, options.topic)} if options.frames else None
    images = partial(_frames, Path(options.folder), summary, frames, label_map.of == PART_CLASSES)
    return label_map, images, {"network": summary.get("network")}


def _frames(
    folder: Path,
    summary: Mapping[str, Any],
    frames: Mapping[str, Frame] | None,
    of_parts: bool,
    progress: ProgressCallback,
) -> Iterator[LabelImage]:
    """Yield the frames of a folder of `bodyseg segment`, each numbered by its place; those of one recording follow."""
    for number, entry in enumerate(summary["each"], 1):
        labels = _image(folder / LABELS / f"{entry['name']}.png", np.uint8)
        instances, crowds = persons(labels, entry.get("bodies", ())) if of_parts else (None, frozenset[int]())
        ranges, step_m, sequence = None, 1e-3, ""
        if frames is not None:
            frame = frames.get(entry["path_id"])
            if frame is None:
                raise BadConfig(f"--frames must be those that were labelled: {entry['file']} is not among them")
            bent = folder / UNDISTORTED / f"{entry['name']}.png"
            ranges = _image(bent, np.uint16) if bent.exists() else frame.read()
            if ranges.shape != labels.shape:
                raise BadConfig(f"{frame.where} must have the size of its labels, {labels.shape}, found {ranges.shape}")
            ranges = np.where(ranges == _SATURATED, 0, ranges).astype(np.uint16)
            step_m, sequence = frame.step_m, str(frame.sequence)
        yield LabelImage(entry["name"], number, labels, instances, crowds, ranges, step_m, sequence)
        progress(number, len(summary["each"]))


def _image(path: Path, kind: type[np.generic]) -> NDArray[Any]:
    image = read_array(path)
    if image.ndim != 2 or image.dtype != kind:
        raise BadConfig(f"{path} must be an image [H, W] of {kind.__name__}, found {image.dtype} {image.shape}")
    return image


def persons(labels: NDArray[np.uint8], bodies: Sequence[Any]) -> tuple[NDArray[np.uint16], frozenset[int]]:
    """Number, from 1, of the body that each labelled pixel of a frame belongs to, by the bodies' boxes in the summary.

    Bodies one of whose labelled pixels lies in both boxes are not told apart: they have one number, which is among the
    second answer.
    """
    found, crowds = np.zeros(labels.shape, np.uint16), set[int]()
    for number, body in enumerate(bodies, 1):
        top, left, bottom, right = body["box"]
        part, shown = found[top:bottom, left:right], labels[top:bottom, left:right] != BACKGROUND
        for met in set(np.unique(part[shown]).tolist()) - {0}:
            found[found == met] = number
            crowds = (crowds - {met}) | {number}
        part[shown] = number
    return found, frozenset(crowds)
