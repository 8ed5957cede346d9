"""Finished renders in each layout become sets that stream, with the same images whatever program wrote them."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image
from rendered_scenes import (
    CAMERA,
    NAMES,
    PROJECTOR,
    along_ray,
    blenderproc,
    isaac,
    plain,
    save,
    seen_by,
    view_transform,
)

from bodyseg_data import RangeImages
from bodyseg_data.commands.cli import main
from bodyseg_data.core import BadConfig, BadSample
from bodyseg_data.packing import pack_renders
from bodyseg_data.renders import open_renders, read_array


def packed(folder: Path, *options: str, variant: str = "all") -> RangeImages:
    out = folder.parent / f"{folder.name}-shards"
    assert main(["shard", "--source", "renders", "--path", str(folder), "--out", str(out), *options]) == 0
    return RangeImages(out, variant)


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


def test_scenes_are_in_the_order_of_the_numbers_in_their_names(tmp_path: Path) -> None:
    folder = plain(tmp_path / "cell", table=False)
    for key, other in (("scene-000", "s10"), ("scene-001", "s0009"), ("scene-002", "s8"), ("scene-003", "s007")):
        for file in folder.rglob(f"{key}.png"):
            file.rename(file.with_name(f"{other}.png"))
    assert open_renders(folder).keys() == ["s007", "s8", "s0009", "s10"]


def test_a_tiff_may_be_of_doubles(tmp_path: Path) -> None:
    """As tifffile writes NumPy's default; Pillow alone has no name for it."""
    metres = np.linspace(0.5, 3, 320).reshape(16, 20)
    tifffile.imwrite(tmp_path / "a.tif", metres)
    np.testing.assert_array_equal(read_array(tmp_path / "a.tif"), metres.astype(np.float32))


@pytest.mark.parametrize("kind", [np.uint16, np.int32, np.float32, np.float64])
def test_a_compressed_tiff_may_be_of_either_order_of_bytes(tmp_path: Path, kind: Any) -> None:
    """Pillow reads 32 and 64 bits of the other order than the machine's with their bytes exchanged."""
    image = np.arange(320).reshape(16, 20).astype(kind)
    for order in "<>":
        tifffile.imwrite(tmp_path / "a.tif", image, compression="zlib", byteorder=order)
        np.testing.assert_array_equal(read_array(tmp_path / "a.tif"), image)


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
    folder = write(tmp_path / "cell")
    for path in [each for each in folder.rglob("*") if each.is_file()]:
        path.with_name(f"._{path.name}").write_bytes(b"")  # as macOS leaves beside files on other disks
    images = packed(folder)
    assert sorted(images.manifest.classes.names) == sorted(NAMES)


def test_packing_carries_on_without_reading_what_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, options = plain(tmp_path / "cell", count=5), ("--shard-samples", "2", "--workers", "0")
    whole = packed(folder, *options)
    names = {path.name: path.read_bytes() for path in Path(whole.path).iterdir() if path.suffix == ".tar"}
    source, read = open_renders(folder), list[str]()
    load = type(source).load
    monkeypatch.setattr(type(source), "load", lambda self, key: read.append(key) or load(self, key))
    (Path(whole.path) / "train-00001.tar").unlink()
    packed(folder, *options)
    assert {path.name: path.read_bytes() for path in Path(whole.path).iterdir() if path.suffix == ".tar"} == names
    assert read == ["scene-002", "scene-003"]
    for kind in ("range", "projector", "labels"):
        (folder / kind / "scene-001.png").unlink()
    rows = (folder / "samples.jsonl").read_text().splitlines(keepends=True)
    (folder / "samples.jsonl").write_text("".join(row for row in rows if "scene-001" not in row))
    with pytest.raises(BadConfig, match="train-00000.tar holds the sample 'scene-001', which is gone from the renders"):
        pack_renders(open_renders(folder), Path(whole.path), "bsi", None, 2, 0)


def swapped(folder: Path) -> None:
    """Two label images exchange their names, and keep their times."""
    first, second = (folder / "labels" / f"scene-00{number}.png" for number in (0, 1))
    first.rename(folder / "aside.png")
    second.rename(first)
    (folder / "aside.png").rename(second)


def touched(folder: Path) -> None:
    os.utime(folder / "range" / "scene-001.png", ns=(10**18, 10**18))


CHANGES: dict[str, Any] = {
    "set.toml": lambda folder: (folder / "set.toml").write_text((folder / "set.toml").read_text() + 'along = "ray"\n'),
    "table": lambda folder: (folder / "samples.jsonl").write_text(
        (folder / "samples.jsonl").read_text().replace('"r0"', '"r7"')
    ),
    "other files": lambda folder: plain(folder),
    "swapped": swapped,
    "older": touched,
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("finished", [True, False])
def test_other_renders_are_not_taken_for_those_that_are_packed(tmp_path: Path, finished: bool, change: str) -> None:
    folder, out = plain(tmp_path / "cell"), tmp_path / "set"

    def pack() -> None:
        pack_renders(open_renders(folder), out, "bsi", None, 2, 0)

    if not finished:
        label = (folder / "labels" / "scene-002.png").read_bytes()
        (folder / "labels" / "scene-002.png").write_bytes(b"")
        with pytest.raises(BadSample, match="scene-002.png: cannot be read"):
            pack()
        (folder / "labels" / "scene-002.png").write_bytes(label)
        assert (out / "train-00000.tar").exists()
    else:
        pack()
    left = {path: path.read_bytes() for path in out.iterdir() if path.is_file()}
    CHANGES[change](folder)
    with pytest.raises(BadConfig, match=r"train-00000.tar holds the sample 'scene-00[01]' from other files, or by"):
        pack()
    assert {path: path.read_bytes() for path in out.iterdir() if path.is_file()} == left


def test_the_same_renders_are_packed_again_wherever_they_lie(tmp_path: Path) -> None:
    folder, out = plain(tmp_path / "cell"), tmp_path / "set"
    whole = pack_renders(open_renders(folder), out, "bsi", None, 2, 0)
    moved = open_renders(folder.rename(tmp_path / "moved"))
    assert pack_renders(moved, out, "bsi", None, 2, 0) == whole
    (out / ".renders.json").unlink()  # of a set that was pulled, or packed before there were notes
    assert pack_renders(moved, out, "bsi", None, 2, 0) == whole
    (out / ".renders.json").unlink()
    later = (out / "train-00000.tar").stat().st_mtime + 1
    os.utime(tmp_path / "moved" / "labels" / "scene-001.png", (later, later))
    with pytest.raises(BadConfig, match="holds the sample 'scene-001' from other files"):
        pack_renders(moved, out, "bsi", None, 2, 0)
    (out / ".renders.json").write_text("{")
    with pytest.raises(BadConfig, match=r".renders.json is not JSON"):
        pack_renders(moved, out, "bsi", None, 2, 0)


def test_planes_facing_normals_and_a_table_of_csv_go_with_samples(tmp_path: Path) -> None:
    folder = plain(tmp_path / "cell")
    (folder / "samples.jsonl").unlink()
    lines = ["key,split,robot,tilt_deg,closed,rig", *(f"scene-00{n},train,r{n},{n}.5,{n > 1},b" for n in (1, 0, 2, 3))]
    (folder / "samples.csv").write_text("\n".join(lines) + "\n")
    text = (folder / "set.toml").read_text().replace('rig = "rig.toml"', '[rigs]\na = "paper"\nb = "rig.toml"')
    rest, rigs = text.split("[rigs]")
    (folder / "set.toml").write_text(rest + "unit_m = 0.001\n[rigs]" + rigs.replace("unit_m = 0.001\n", ""))
    for number in range(4):
        range_m, labels = seen_by(CAMERA, number)
        save(folder / "planes" / "instances" / f"scene-00{number}.npy", labels.astype(np.int64) * 256)
        normals = np.zeros((*range_m.shape, 3), np.float32)
        normals[..., 2] = -1
        save(folder / "normals" / f"scene-00{number}.npy", normals)
    images = packed(folder)
    assert (images.keys[0], len(images.manifest.rigs), dict(images.manifest.planes)) == (
        "scene-001",
        1,
        {"instances": "uint16"},
    )
    sample = images.clean(0)
    assert (sample.info.robot, sample.info.tilt_deg, sample.info.closed) == ("r1", 1.5, False)
    np.testing.assert_array_equal(sample.planes["instances"], seen_by(CAMERA, 1)[1].astype(np.uint16) * 256)
    assert images.manifest.renderer == "external"


def test_a_column_of_csv_with_underscores_or_leading_zeros_is_text(tmp_path: Path) -> None:
    folder = plain(tmp_path / "cell")
    (folder / "samples.jsonl").unlink()
    subjects = ["1_1", "11", "2_0", "1_1"]  # Python reads the first as the second
    robots = ["007", "7", "-01", "0"]
    rows = (f"scene-00{n},{subjects[n]},{robots[n]},{n},0{n}.5" for n in range(4))
    lines = ["key,subject,robot,take,time_s", *rows]
    (folder / "samples.csv").write_text("\n".join(lines) + "\n")
    table = packed(folder).table()
    assert (table["subject"].tolist(), table["robot"].tolist()) == (subjects, robots)
    assert (table["take"].tolist(), table["time_s"].tolist()) == ([0, 1, 2, 3], [0.5, 1.5, 2.5, 3.5])


def test_names_of_two_sides_are_mirror_images(tmp_path: Path) -> None:
    folder = plain(tmp_path / "cell")
    text = (folder / "set.toml").read_text().replace('["floor", "arm", "box"]', '["left arm", "floor", "right arm"]')
    (folder / "set.toml").write_text(text)
    assert open_renders(folder).classes.mirrored[:3].tolist() == [2, 1, 0]


def test_labels_in_colours_and_several_numbers_for_a_class(tmp_path: Path) -> None:
    folder = plain(tmp_path / "cell")
    classes = '[{name="floor", label=[1, 7]}, {name="arm", colour="#00FF00"}, {name="box", colour="#0000ff"}]'
    text = (folder / "set.toml").read_text().replace('["floor", "arm", "box"]', classes)
    (folder / "set.toml").write_text(text.replace("background = [0]", 'background = [0, "#000000", "#ffffff"]'))
    path = folder / "labels" / "scene-000.png"
    numbers = np.asarray(Image.open(path))
    save(path, np.where(numbers == 1, 7, numbers).astype(np.uint8))
    table = np.array([[0, 0, 0], [0, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    save(folder / "labels" / "scene-001.png", table[np.asarray(Image.open(folder / "labels" / "scene-001.png"))])
    source, labels = open_renders(folder), seen_by(CAMERA, 0)[1]
    np.testing.assert_array_equal(source.load("scene-000").labels, labels)
    found, labels = source.load("scene-001").labels, seen_by(CAMERA, 1)[1]
    np.testing.assert_array_equal(found, np.where(labels == 0, 255, labels))
    packed(folder)


@pytest.mark.parametrize("ending", [".png", ".tif"])
def test_pictures_with_a_palette_are_of_its_colours_where_the_set_names_colours(tmp_path: Path, ending: str) -> None:
    folder = plain(tmp_path / "cell")
    for path in sorted((folder / "labels").iterdir()):
        picture = Image.fromarray(np.asarray(Image.open(path)), mode="P")
        picture.putpalette([0, 0, 0, 0, 0, 255, 0, 255, 0, 255, 0, 0])
        path.unlink()
        picture.save(path.with_suffix(ending))
    np.testing.assert_array_equal(open_renders(folder).load("scene-001").labels, seen_by(CAMERA, 1)[1])
    classes = '[{name="box", colour="#ff0000"}, {name="arm", colour="#00ff00"}, {name="floor", colour="#0000ff"}]'
    text = (folder / "set.toml").read_text().replace('["floor", "arm", "box"]', classes)
    (folder / "set.toml").write_text(text.replace("first_label = 1", "").replace("[0]", '["#000000"]'))
    turned = np.array([2, 1, 0] + [255] * 253)
    np.testing.assert_array_equal(open_renders(folder).load("scene-001").labels, turned[seen_by(CAMERA, 1)[1]])


@pytest.mark.parametrize("nothing", [-1, 1 << 40])
def test_background_may_be_any_number(tmp_path: Path, nothing: int) -> None:
    """A negative one, as MuJoCo, PyBullet and Hypersim write it, or one that no table has room for."""
    folder = plain(tmp_path / "cell")
    text = (folder / "set.toml").read_text()
    (folder / "set.toml").write_text(text.replace("background = [0]", f"background = [{nothing}]"))
    labels = seen_by(CAMERA, 0)[1]
    (folder / "labels" / "scene-000.png").unlink()
    save(folder / "labels" / "scene-000.npy", np.where(labels == 255, nothing, labels.astype(np.int64) + 1))
    np.testing.assert_array_equal(open_renders(folder).load("scene-000").labels, labels)


def test_a_side_of_1_is_the_channel(tmp_path: Path) -> None:
    folder = plain(tmp_path / "cell", ending=".npy")
    for number, place in enumerate((0, -1, (0, 1), (0, -1))):
        path = folder / "range" / f"scene-00{number}.npy"
        save(path, np.expand_dims(np.load(path), place))
        np.testing.assert_allclose(open_renders(folder).load(path.stem).range_m, seen_by(CAMERA, number)[0], atol=1e-5)


def test_the_depth_of_a_file_with_layers_is_found(tmp_path: Path) -> None:
    exr = pytest.importorskip("OpenEXR")
    depth, others = np.arange(6, dtype=np.float32).reshape(2, 3), np.zeros((4, 2, 3), np.float32)
    others[0] = 1

    def read(*names: str, in_parts: bool = False, labels: bool = False) -> Any:
        channels = {name: depth if name[-1] in "ZV" else others[place] for place, name in enumerate(names)}
        parts = [exr.Part({}, {name: image}, name.split(".")[0]) for name, image in channels.items()]
        exr.File(parts if in_parts else [exr.Part({}, channels)]).write(str(tmp_path / "a.exr"))
        return read_array(tmp_path / "a.exr", labels=labels)

    for layers in ("R G B Z", "View.Combined.R View.Combined.G View.Combined.B View.Depth.Z", "IndexOB.X Depth.V"):
        np.testing.assert_array_equal(read(*layers.split()), depth)
    np.testing.assert_array_equal(read("R", "G", "B", "Z", labels=True), np.moveaxis(others[:3], 0, 2))
    assert read("Combined.R", "Combined.G", "Combined.B", "A").shape == (2, 3, 3)
    assert read("Normal.X", "Normal.Y", "Normal.Z").shape == (2, 3, 3)
    np.testing.assert_array_equal(read("IndexOB.X", "Depth.Z", in_parts=True), depth)
    for in_parts in (False, True):
        with pytest.raises(
            BadSample, match=r"one channel of depth, or one a colour, found .*A\.Depth\.Z, .*B\.Depth\.Z"
        ):
            read("A.Depth.Z", "B.Depth.Z", in_parts=in_parts)
    exr.File([exr.Part({}, dict.fromkeys("RGB", depth))]).write(str(tmp_path / "a.exr"))
    np.testing.assert_array_equal(read_array(tmp_path / "a.exr"), depth, "grey that was saved in colours")


def test_labels_beside_depth_are_read_from_the_colours(tmp_path: Path) -> None:
    """As Blender writes them with a Z buffer; the range may be in whole numbers that are classes, too."""
    exr = pytest.importorskip("OpenEXR")
    folder = plain(tmp_path / "cell")
    labels = open_renders(folder).load("scene-000").labels
    (folder / "labels" / "scene-000.png").unlink()
    numbers = np.where(labels == 255, 0, labels + 1).astype(np.float32)
    channels = dict.fromkeys("RGB", numbers) | {"Z": np.ones_like(numbers)}
    exr.File([exr.Part({}, channels)]).write(str(folder / "labels" / "scene-000.exr"))
    np.testing.assert_array_equal(open_renders(folder).load("scene-000").labels, labels)


def test_nothing_measured_is_told_by_many_numbers(tmp_path: Path) -> None:
    folder = plain(tmp_path / "cell", ending=".npy")
    (folder / "set.toml").write_text((folder / "set.toml").read_text() + "no_range = [7777.0, 3000]\n")
    for number, nothing in enumerate((np.inf, np.nan, 1e10, 7777.002)):
        range_m = seen_by(CAMERA, number)[0].copy()
        range_m.ravel()[np.flatnonzero(range_m)[0]] = 3.0005  # half a millimetre beside nothing
        save(
            folder / "range" / f"scene-00{number}.npy",
            np.where(range_m == 0, nothing, 1000 * range_m).astype(np.float32),
        )
        np.testing.assert_allclose(open_renders(folder).load(f"scene-00{number}").range_m, range_m, atol=1e-5)


def test_a_rig_may_stand_in_the_set_and_ranges_along_the_ray(tmp_path: Path) -> None:
    folder = plain(tmp_path / "cell", ending=".npy")
    rig = (folder / "rig.toml").read_text().replace('format = "bodyseg rig 1"', "[rig]")
    rig = rig.replace("[camera]", "[rig.camera]").replace("[projector]", "[rig.projector]")
    (folder / "set.toml").write_text(
        (folder / "set.toml").read_text().replace('rig = "rig.toml"', 'along = "ray"') + rig
    )
    for kind, device in (("range", CAMERA), ("projector", PROJECTOR)):
        for number in range(4):
            save(folder / kind / f"scene-00{number}.npy", 1000 * along_ray(seen_by(device, number)[0], device))
    render = open_renders(folder).load("scene-002")
    np.testing.assert_allclose(render.range_m, seen_by(CAMERA, 2)[0], atol=1e-5)
    packed(folder, "--projector", "exact")
    packed(folder, "--plan")


def test_camera_files_of_isaac_sim_may_lack_what_is_usual(tmp_path: Path) -> None:
    folder = isaac(tmp_path / "cell")
    (rig,) = open_renders(folder).rigs
    for home, device in ((folder, CAMERA), (folder / "projector", PROJECTOR)):
        for path in home.glob("camera_params_*.json"):
            said = json.loads(path.read_text()) | {"cameraViewTransform": view_transform(device, 1.0)}
            needed = "cameraAperture", "cameraFocalLength", "cameraViewTransform", "renderProductResolution"
            path.write_text(json.dumps({name: said[name] for name in needed}))
    assert open_renders(folder).rigs == (rig,)
    (folder / "set.toml").write_text('format = "bodyseg renders 1"\nrange_step_mm = 0.25\n')
    assert open_renders(folder).rigs == (replace(rig, range_step_mm=0.25),)


def test_a_wall_of_floats_is_a_surface(tmp_path: Path) -> None:
    """Only one and the same number is asked about, which no wall has along the ray."""
    folder = plain(tmp_path / "cell", ending=".npy")
    range_m, draws = seen_by(CAMERA, 0)[0], np.random.default_rng(0)
    wall = 6 + draws.normal(0, 1e-5, range_m.shape)
    save(folder / "range" / "scene-000.npy", (1000 * np.where(range_m == 0, wall, range_m)).astype(np.float32))
    assert np.count_nonzero(open_renders(folder).load("scene-000").range_m > 5.9) == np.count_nonzero(range_m == 0)


def test_a_table_a_metre_away_is_no_depth_buffer_where_the_set_says_so(tmp_path: Path) -> None:
    folder = plain(tmp_path / "cell", ending=".npy")
    for kind, device in (("range", CAMERA), ("projector", PROJECTOR)):
        save(folder / kind / "scene-000.npy", np.ones((device.rows, device.columns), np.float32))
    text = (folder / "set.toml").read_text().replace("unit_m = 0.001\n", "")
    (folder / "set.toml").write_text(text)
    with pytest.raises(BadSample, match="a depth buffer, or depth scaled to 0..1"):
        open_renders(folder).load("scene-000")
    (folder / "set.toml").write_text(text + "no_range = []\n")
    assert (open_renders(folder).load("scene-000").range_m == 1).all()


def test_a_set_without_the_projectors_images_is_one_too(tmp_path: Path) -> None:
    folder = plain(tmp_path / "cell")
    for path in (folder / "projector").iterdir():
        path.unlink()
    (folder / "projector").rmdir()
    assert packed(folder, variant="none").manifest.projector == "none"


def test_what_systems_leave_in_folders_is_no_image(tmp_path: Path) -> None:
    folder = plain(tmp_path / "cell")
    keys = open_renders(folder).keys()
    for name in (".DS_Store", "._scene-000.png", "Thumbs.db", "desktop.ini"):
        (folder / "range" / name).write_bytes(b"thumbnails")
    assert open_renders(folder).keys() == keys


def test_images_of_the_projector_that_are_not_stored_are_not_read(tmp_path: Path) -> None:
    folder = plain(tmp_path / "cell")
    source = open_renders(folder)
    assert pack_renders(source, tmp_path / "clean", "bsi", "none", 2, 0).projector == "none"
    assert pack_renders(source, tmp_path / "lit", "bsi", None, 2, 0).projector != "none", "the caller's stay whole"
    for path in (folder / "projector").iterdir():
        path.write_bytes(b"damaged")
    assert packed(folder, "--projector", "none", variant="none").manifest.projector == "none"
