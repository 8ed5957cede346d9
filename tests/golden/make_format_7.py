"""Writes the sets format_7 and format_7_png, as they were written once: from then on they are read for good.

    python tests/golden/make_format_7.py FOLDER

Nothing runs it again: a change of an encoder may give other bytes, and these must stay readable.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Final, Literal

import numpy as np

from bodyseg_data.labels import LabelClass, classes_of
from bodyseg_data.rigs import Camera, Rig
from bodyseg_data.samples import Sample, SampleInfo, Split
from bodyseg_data.shards import ColumnWriter, Fields, Manifest, TarWriter, encode_sample, read_manifest, write_manifest
from bodyseg_data.shards import manifest as manifests

ROWS, COLUMNS = 16, 20
CLASSES: Final = classes_of(
    [
        LabelClass("floor", colour="#806040"),
        LabelClass("left finger", mirror="right finger", within="gripper"),
        LabelClass("right finger", mirror="left finger", within="gripper"),
        LabelClass("box"),
    ],
    "cell",
)
FIELDS: Final = Fields(
    (
        (("rig", "int"), ("robot", "text")),
        (("light", "float"), ("empty", "flag"), ("pose", "numbers")),
    )
)
CAMERA: Final = Camera(ROWS, COLUMNS, 20.0, (10.0, 8.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
PROJECTOR: Final = replace(CAMERA, position_m=(0.1, 0.0, 0.0), aims_at_m=(0.1, 0.0, 1.0))
RIGS: Final = (
    Rig("near", 1.0, CAMERA, PROJECTOR, 0.1),
    Rig("far", 1.0, replace(CAMERA, focal_px=25.0), replace(PROJECTOR, focal_px=25.0), 0.1),
)


def sample(number: int, split: Split, projector: bool, planes: bool) -> Sample:
    """Scene `number`: a floor that rises to the right, a box on it, two fingers, an edge without a class."""
    rows, columns = np.mgrid[0:ROWS, 0:COLUMNS]
    ranges = (9000 + 10 * columns + number).astype(np.uint16)
    labels = np.zeros((ROWS, COLUMNS), np.uint8)
    ranges[6:12, 4 : 9 + number], labels[6:12, 4 : 9 + number] = 8000 + number, 3
    ranges[2:4, 12:14], labels[2:4, 12:14] = 7000, 1
    ranges[2:4, 15:17], labels[2:4, 15:17] = 7000, 2
    labels[:, -1] = 254
    ranges[0], labels[0] = 0, 255
    fields = {"rig": number % 2, "robot": f"r{number // 2}", "light": number / 4, "empty": number == 0}
    info = SampleInfo(split, {**fields, "pose": (0.5, float(number))})
    found = {"instances": 1000 + labels.astype(np.uint16), "material": (rows % 3).astype(np.uint8)}
    return Sample(
        key=f"cell-{number:03d}",
        range=ranges,
        projector_range=ranges[:, ::-1].copy() if projector else None,
        labels=labels,
        faces_projector=(ranges > 0) & (columns % 5 > 0),
        info=info,
        planes=found if planes else {},
    )


def write(folder: Path, codec: Literal["bsi", "png"], indexed: bool) -> None:
    """Write a set of 5 samples for training and 3 for testing. With an index it has all that the format knows."""
    folder.mkdir(parents=True)
    shards = []
    parts: tuple[tuple[Split, int, range], ...] = (
        *(("train", 0, range(3)), ("train", 1, range(3, 5))),
        ("test", 0, range(5, 8)),
    )
    for split, number, scenes in parts:
        path = folder / f"{split}-{number:05d}.tar"
        with TarWriter(path, folder / ".part", split, FIELDS) as shard:
            for scene in scenes:
                made = sample(scene, split, indexed, planes=indexed)
                made.check(len(CLASSES))
                shard.write(made.key, encode_sample(made, codec))
            shard.note("cell", [f"scenes {scenes.start} to {scenes.stop - 1}"])
        shards.append(shard.record)
    manifest = Manifest(RIGS, codec, "renders", "by hand", "0" * 64, shards, (), CLASSES, FIELDS)
    planes = {"instances": "uint16", "material": "uint8"} if indexed else {}
    manifests.INDEXED_FROM = 1 if indexed else 1 << 18  # type: ignore[misc]
    write_manifest(replace(manifest, projector="exact" if indexed else "none", planes=planes), folder)
    keys = [key for shard in read_manifest(folder).shards for key in shard.keys]
    with ColumnWriter(folder, "template", "uint8") as plane:
        for number, key in enumerate(keys):
            plane.write(key, np.full((ROWS, COLUMNS), 10 + number, np.uint8))
    with ColumnWriter(folder, "weight", "float") as field:
        for number, key in enumerate(keys):
            field.write(key, number / 8)


if __name__ == "__main__":
    write(Path(sys.argv[1]) / "format_7", "bsi", indexed=True)
    write(Path(sys.argv[1]) / "format_7_png", "png", indexed=False)
