"""`ShardWriter`: scenes as arrays become a set that streams in every variant, whatever they came as."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bodyseg_data import VARIANTS, RangeImages, ShardWriter, loader
from bodyseg_data.commands import cli
from bodyseg_data.rigs import Camera, Rig

CAMERA = Camera(16, 20, 24.0, (10.0, 8.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
PROJECTOR = Camera(24, 30, 36.0, (15.0, 12.0), (0.2, 0.0, 0.0), (0.2, 0.0, 1.0))
RIG = Rig("bench", 1.5, CAMERA, PROJECTOR)
CLASSES = ["floor", "arm", "box"]


def scene(number: int = 0) -> dict[str, Any]:
    """A wall 2 m away with a plate before it, seen by both devices; label 1 on the plate."""
    range_m = np.full((16, 20), 2.0, np.float32)
    labels = np.zeros((16, 20), np.int64)
    range_m[4:12, 6 + number % 3 : 12] = 1.2
    labels[range_m == np.float32(1.2)] = 1
    range_m[:2], labels[:2] = 0, 2
    projector = np.full((24, 30), 2.0)
    # The plate lies 0.2 m * 36 px / 1.2 m = 6 px further left, and all is larger by 36 / 24.
    projector[6:18, round(1.5 * (6 + number % 3 - 10) + 15 - 6) : 12] = 1.2
    return {"key": f"scene-{number:03d}", "range_m": range_m, "labels": labels, "projector_range_m": projector}


def written(out: Path, count: int = 5, **options: Any) -> RangeImages:
    with ShardWriter(out, rig=RIG, classes=CLASSES, **options) as writer:
        for number in range(count):
            writer.write(**scene(number), split="test" if number == 3 else "train", fields={"robot": "r1"})
    return RangeImages(out)


def test_scenes_stream_in_every_variant_with_their_own_classes(tmp_path: Path) -> None:
    images = written(tmp_path / "set")
    assert cli.main(["verify", str(tmp_path / "set")]) == 0
    assert (len(images), images.manifest.classes.names) == (5, ("floor", "arm", "box"))
    for variant in VARIANTS:
        for batch in loader(RangeImages(tmp_path / "set", variant), 2, 0):
            assert batch["range"].shape[1:] == (1, 16, 20)
    sample = RangeImages(tmp_path / "set", "none", split="train").clean(0)
    assert sample.info.robot == "r1" and sample.key == "scene-000"
    assert (sample.range[:2] == 0).all() and (sample.labels[:2] == 255).all()
    assert (sample.range[2:4] == 20000).all() and (sample.labels[4:12, 6:12] == 1).all()
    lit = RangeImages(tmp_path / "set", "occ", split="train").image(0)
    shaded = (lit.range == 0) & (sample.range > 0)
    # The plate's shadow lies on the wall, on the side away from the projector.
    assert shaded[6:10, 1:6].any() and not shaded[:, 12:].any() and not shaded[4:12, 6:12].any()
