"""Finished renders in each layout become sets that stream, with the same images whatever program wrote them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rendered_scenes import CAMERA, NAMES, PROJECTOR, blenderproc, isaac, plain, seen_by

from bodyseg_data import RangeImages
from bodyseg_data.commands.cli import main
from bodyseg_data.renders import open_renders


def packed(folder: Path, *options: str) -> RangeImages:
    out = folder.parent / f"{folder.name}-shards"
    assert main(["shard", "--source", "renders", "--path", str(folder), "--out", str(out), *options]) == 0
    return RangeImages(out)


@pytest.mark.parametrize("ending", [".png", ".tif", ".npy", ".npz", ".exr"])
def test_plain_folders_hold_any_image_file(tmp_path: Path, ending: str) -> None:
    if ending == ".exr":
        pytest.importorskip("OpenEXR")
    source = open_renders(plain(tmp_path / "cell", ending=ending))
    range_m, labels = seen_by(CAMERA, 1)
    render = source.load("scene-001")
    np.testing.assert_allclose(render.range_m, range_m, atol=6e-4)
    np.testing.assert_array_equal(render.labels, labels)
    assert render.projector_range_m is not None
    np.testing.assert_allclose(render.projector_range_m, seen_by(PROJECTOR, 1)[0], atol=6e-4)
    assert (source.split("scene-003"), render.fields) == ("test", {"robot": "r1", "tilt_deg": 2})


WRITERS: list[tuple[Any, dict[str, Any]]] = [
    (plain, {}),
    (blenderproc, {}),
    (blenderproc, {"distance": True}),
    (blenderproc, {"labels_as": "instance_segmaps"}),
    (isaac, {}),
    (isaac, {"colours": False, "ray": True}),
    (isaac, {"nested": True}),
]


@pytest.mark.parametrize(("write", "options"), WRITERS)
def test_every_layout_gives_the_same_scene(tmp_path: Path, write: Any, options: dict[str, Any]) -> None:
    if write is blenderproc:
        pytest.importorskip("h5py")
    source = open_renders(write(tmp_path / "cell", **options))
    render = source.load(source.keys()[2])
    rig = source.rigs[render.rig]
    np.testing.assert_allclose(render.range_m, seen_by(CAMERA, 2)[0], atol=6e-4)
    assert render.projector_range_m is not None
    np.testing.assert_allclose(render.projector_range_m, seen_by(PROJECTOR, 2)[0], atol=6e-4)
    names = np.array([*source.classes.names] + [""] * (256 - len(source.classes)))
    np.testing.assert_array_equal(names[render.labels], np.array([*NAMES] + [""] * 253)[seen_by(CAMERA, 2)[1]])
    assert (len(source.rigs), rig.projector.rows) == (1, 24)
    np.testing.assert_allclose(rig.camera.focal_px, CAMERA.focal_px if write is not isaac else 24.0)
    np.testing.assert_allclose(rig.projector.position_m, PROJECTOR.position_m, atol=1e-6)
    np.testing.assert_allclose(rig.projector.axes, PROJECTOR.axes, atol=1e-5)


@pytest.mark.parametrize("write", [plain, blenderproc, isaac])
def test_a_command_packs_them(tmp_path: Path, write: Any) -> None:
    if write is blenderproc:
        pytest.importorskip("h5py")
    images = packed(write(tmp_path / "cell"))
    assert sorted(images.classes.names) == sorted(NAMES)
