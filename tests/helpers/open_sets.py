"""Small sets of classes of their own: cells of a robot with 12 classes, two planes, two rigs and fields.

A scene is a floor and upright rectangles at right angles to the optical axis, seen by the camera and by a projector
beside it, so that a rectangle shades what is behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.labels import BACKGROUND, UNLABELLED, Classes, LabelClass, classes_of
from bodyseg_data.rigs import Camera, Rig
from bodyseg_data.samples import Sample, SampleInfo, Split, steps
from bodyseg_data.shards import Fields, Manifest, ProjectorKind, TarWriter, encode_sample, write_manifest

NAMES: Final = (
    *("floor", "wall", "table", "base", "lower arm", "upper arm", "gripper", "left finger", "right finger"),
    *("part", "bin", "cable"),
)

CELL_CLASSES: Final = classes_of(
    [
        LabelClass(
            name,
            mirror={"left finger": "right finger", "right finger": "left finger"}.get(name),
            colour="#80c0ff" if name == "floor" else None,
            within="robot" if name in NAMES[3:9] else None,
        )
        for name in NAMES
    ],
    "robot cell",
)
"""Twelve classes: two are each other's mirror image, one has a colour of its own."""

CELL_FIELDS: Final = Fields(((("cell", "text"), ("rig", "int")), (("lamps", "int"), ("height_m", "float"))))
PLANES: Final = {"instances": "uint16", "material": "uint8"}
STEP_M: Final = 0.001


def cell_rig(
    name: str = "cell-0", focal_px: float = 18.0, baseline_m: float = 0.2, size: tuple[int, int] = (16, 20)
) -> Rig:
    """A rig whose projector looks along the camera's axis from the right."""
    rows, columns = size
    camera = Camera(rows, columns, focal_px, (columns / 2, rows / 2), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    projector = replace(camera, position_m=(baseline_m, 0.0, 0.0), aims_at_m=(baseline_m, 0.0, 1.0))
    return Rig(name, 2.0, camera, projector, 1000 * STEP_M)


CELL_RIGS: Final = (cell_rig(), cell_rig("cell-1", 24.0, 0.3))


def cell_sample(
    number: int, rig: Rig, split: Split = "train", projector: ProjectorKind = "exact", number_of_rig: int = 0
) -> Sample:
    """Sample `number` of a robot cell: some classes, a surface without a class, and nothing above the floor."""
    random = np.random.default_rng(number)
    shapes = [(2.4, -9.0, 9.0, 0.0, 9.0, label_at) for label_at in (0,)]  # the floor, its near edge across the image
    for label in random.permutation(np.arange(1, 12))[:5]:
        x, y = random.uniform(-0.8, 0.6), random.uniform(-0.7, 0.4)
        shapes.append((random.uniform(1.5, 2.2), x, x + 0.5, y, y + 0.4, int(label)))
    shapes.append((1.4, -0.1, 0.1, -0.1, 0.1, UNLABELLED))
    seen, labels, instances = _view(rig.camera, shapes)
    lit, _, _ = _view(rig.projector, shapes)
    info = SampleInfo(
        split, {"cell": f"c{number % 3}", "lamps": number % 2, "height_m": 1.5 + number / 8, "rig": number_of_rig}
    )
    return Sample(
        key=f"scene-{number:03d}",
        range=steps(seen, STEP_M, "camera"),
        projector_range=None if projector == "none" else steps(lit, STEP_M, "projector"),
        labels=labels,
        faces_projector=seen > 0,
        info=info,
        planes={"instances": instances, "material": (labels % 4).astype(np.uint8)},
    )


def _view(
    device: Camera, shapes: Sequence[tuple[float, ...]]
) -> tuple[NDArray[np.float64], NDArray[np.uint8], NDArray[np.uint16]]:
    rays = device.pixel_rays()
    seen = np.zeros(rays.shape[:2])
    labels, instances = np.full(seen.shape, BACKGROUND, np.uint8), np.zeros(seen.shape, np.uint16)
    for number, (z, left, right, top, bottom, label) in enumerate(shapes):
        x, y = z * rays[..., 0] + device.position_m[0], z * rays[..., 1]
        hit = (left <= x) & (x < right) & (top <= y) & (y < bottom) & ((seen == 0) | (z < seen))
        seen[hit], labels[hit], instances[hit] = z, int(label), 1000 + number
    return seen, labels, instances


def write_open_set(
    folder: Path,
    samples: int = 8,
    tests: int = 4,
    *,
    projector: ProjectorKind = "exact",
    classes: Classes = CELL_CLASSES,
    rigs: tuple[Rig, ...] = CELL_RIGS,
    codec: str = "bsi",
    planes: bool = True,
    source: str = "renders",
) -> Manifest:
    """Write a set of robot cells: `samples` in train, `tests` in test, in turns of each of the rigs."""
    folder.mkdir(parents=True, exist_ok=True)
    records = []
    parts: dict[Split, range] = {"train": range(samples), "test": range(samples, samples + tests)}
    for split, numbers in parts.items():
        if not numbers:
            continue
        path = folder / f"{split}-00000.tar"
        with TarWriter(path, path.with_suffix(".part"), split, CELL_FIELDS) as shard:
            for number in numbers:
                rig = number % len(rigs)
                sample = cell_sample(number, rigs[rig], split, projector, rig)
                sample = replace(sample, labels=_within(sample.labels, classes), planes=sample.planes if planes else {})
                sample.check(len(classes))
                shard.write(sample.key, encode_sample(sample, codec))
        records.append(shard.record)
    manifest = Manifest(
        rigs=rigs,
        codec=codec,
        source=source,
        renderer="rectangles",
        plan="",
        shards=[record for record in records if record is not None],
        classes=classes,
        fields=CELL_FIELDS,
        projector=projector,
        planes=PLANES if planes else {},
    )
    return write_manifest(manifest, folder)


def _within(labels: NDArray[np.uint8], classes: Classes) -> NDArray[np.uint8]:
    """Labels of a set with fewer classes."""
    found: NDArray[np.uint8] = np.where(labels < UNLABELLED, labels % len(classes), labels).astype(np.uint8)
    return found
