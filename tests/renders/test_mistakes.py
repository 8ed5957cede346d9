"""Mistakes of those who render: each is one line that names the file and the rule."""

from __future__ import annotations

import json
import shutil
import struct
import sys
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pngs import chunk
from rendered_scenes import CAMERA, blenderproc, isaac, plain, save

from bodyseg_data.commands.cli import main
from bodyseg_data.core import BadConfig, BadSample
from bodyseg_data.renders.blenderproc import _datasets
from bodyseg_data.renders.images import read_array
from bodyseg_data.renders.set_file import SetFile, read_rows, read_set

FIRST = "scene-000"


def pack(folder: Path, *options: str) -> int:
    out = folder.parent / "shards"
    return main(["shard", "--source", "renders", "--path", str(folder), "--out", str(out), "--workers", "0", *options])


def refused(folder: Path, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    """The one line that a command ends with; nothing is left that could be taken for a set."""
    assert pack(folder, *options) == 2
    (line,) = [
        line
        for line in capsys.readouterr().err.splitlines()
        if not line.startswith(("packing:", "bodyseg shard: note"))
    ]
    assert not (folder.parent / "shards" / "manifest.json").exists()
    return line


def edit(folder: Path, old: str, new: str, name: str = "set.toml") -> None:
    assert old in (folder / name).read_text()
    (folder / name).write_text((folder / name).read_text().replace(old, new))


def replaced(kind: str, change: Callable[[Any], Any], key: str = FIRST, ending: str = ".png") -> Callable[[Path], None]:
    """Change one image of a plain folder."""

    def apply(folder: Path) -> None:
        path = folder / kind / f"{key}.png"
        image = np.asarray(Image.open(path))
        path.unlink()
        save(path.with_suffix(ending), change(image))

    return apply


def all_replaced(kinds: tuple[str, ...], change: Callable[[Any], Any]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        for kind in kinds:
            for path in (folder / kind).iterdir():
                replaced(kind, change, path.stem)(folder)

    return apply


def in_set(old: str, new: str) -> Callable[[Path], None]:
    return lambda folder: edit(folder, old, new)


def in_rig(old: str, new: str) -> Callable[[Path], None]:
    return lambda folder: edit(folder, old, new, "rig.toml")


def coloured(image: Any, blend: bool = False) -> Any:
    table = np.array([[0, 0, 0], [255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    found = table[image]
    if blend:
        found[5, 5:9] = [[100, 20, 3], [90, 20, 3], [80, 20, 3], [70, 20, 3]]
    return found


COLOURS = 'classes = [{name="floor", colour="#ff0000"}, {name="arm", colour="#00ff00"}, {name="box", colour="#0000ff"}]'
IN_COLOURS = in_set('classes = ["floor", "arm", "box"]', COLOURS)
ALSO_BLACK = in_set("background = [0]", 'background = [0, "#000000"]')


def in_a_sphere(image: Any) -> Any:
    """Depth that was distances along the ray, with a farthest one for nothing."""
    lengths = np.linalg.norm(CAMERA.pixel_rays(), axis=2)
    return np.where(image == 0, 6000 / lengths, image).astype(np.float32)


def with_a_border(image: Any) -> Any:
    """Labels that reach half a pixel too far, here in one place."""
    found = image.copy()
    found[tuple(np.argwhere(image == 0)[0])] = 2
    return found


def in_deep_colours(folder: Path) -> None:
    """Label numbers as a grey picture in colours of 16 bits a channel."""
    path = folder / "labels" / f"{FIRST}.png"
    numbers = np.asarray(Image.open(path)).astype(">u2")
    rows = b"".join(b"\0" + np.repeat(row, 3).tobytes() for row in numbers)
    head = struct.pack(">IIBBBBB", *numbers.shape[::-1], 16, 2, 0, 0, 0)
    parts = chunk(b"IHDR", head), chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


def both(*steps: Callable[[Path], None]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        for step in steps:
            step(folder)

    return apply


def table(text: str) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        (folder / "samples.jsonl").unlink()
        (folder / "samples.csv").write_text(text)

    return apply


MISTAKES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "unit": (in_set("unit_m = 0.001", "unit_m = 1.0"), "look like millimetres (unit_m = 0.001)"),
    "two units": (
        replaced("range", lambda image: (image * 200.0).astype(np.float32), ending=".npy"),
        "look like millimetres (unit_m = 0.001) or centimetres (unit_m = 0.01)",
    ),
    "a hall": (
        replaced("range", lambda image: (image * 20.0).astype(np.float32), ending=".npy"),
        "look like centimetres (unit_m = 0.01); if it is metres, a larger range_step_mm of the rig reaches farther",
    ),
    "small unit": (in_set("unit_m = 0.001", "unit_m = 0.000001"), "is 'unit_m' right?"),
    "no unit": (in_set("unit_m = 0.001", ""), "integers needs 'unit_m'"),
    "8 bits": (replaced("range", lambda image: (image // 16).astype(np.uint8)), "holds at most 256 ranges"),
    "colours": (
        replaced("range", lambda image: np.zeros((*image.shape, 3), np.uint8)),
        "a range image has one channel",
    ),
    "half": (replaced("range", lambda image: image.astype(np.float16), ending=".npy"), "16-bit floats"),
    "negative": (replaced("range", lambda image: -image.astype(np.float32), ending=".npy"), "as OpenGL's z is"),
    "buffer": (
        replaced("range", lambda image: np.where(image == 0, 1, image / 3000).astype(np.float32), ending=".npy"),
        "a depth buffer",
    ),
    "far plane": (
        replaced("range", lambda image: np.where(image == 0, 6000, image).astype(np.uint16)),
        "no_range = [6000] in set.toml says",
    ),
    "far sphere": (replaced("range", in_a_sphere, ending=".npy"), "6 m along the ray: 0 in its file says"),
    "far plane behind borders": (
        both(
            replaced("range", lambda image: np.where(image == 0, 6000, image).astype(np.uint16)),
            replaced("labels", with_a_border),
        ),
        "no_range = [6000] in set.toml says",
    ),
    "size": (replaced("labels", lambda image: image[:-1]), "must have 16 rows and 20 columns"),
    "turned": (replaced("range", lambda image: image.T.copy()), "rows and columns are exchanged"),
    "projector's size": (
        replaced("projector", lambda image: image[:8]),
        "24 rows and 30 columns as the rig's projector",
    ),
    "label": (replaced("labels", lambda image: np.where(image == 2, 9, image).astype(np.uint8)), "most of them 9 ("),
    "half labels": (replaced("labels", lambda image: image / 2, ending=".npy"), "a label must be a whole number"),
    "coloured labels": (replaced("labels", coloured), "no class of set.toml has a colour"),
    "deep colours": (in_deep_colours, "RGB colours of 8 bits, found mode RGB of 16 bits"),
    "strange colour": (both(IN_COLOURS, all_replaced(("labels",), coloured)), "most of them #000000"),
    "blended": (
        both(IN_COLOURS, ALSO_BLACK, replaced("labels", lambda image: coloured(image, blend=True))),
        "without antialiasing",
    ),
    "partner": (lambda folder: (folder / "labels" / f"{FIRST}.png").unlink(), "lacks 1 of 4 samples: 'scene-000'"),
    "extra": (lambda folder: (folder / "range" / f"{FIRST}.png").unlink(), "'scene-000'"),
    "twice": (lambda folder: np.save(folder / "range" / f"{FIRST}.npy", np.zeros((16, 20))), "has one file of a kind"),
    "lossy": (lambda folder: (folder / "labels" / "scene-009.jpg").write_bytes(b""), "which keep numbers as they are"),
    "key": (lambda folder: (folder / "range" / f"{FIRST}.png").rename(folder / "range" / "a b.png"), "gives the key"),
    "damaged": (
        lambda folder: (folder / "range" / f"{FIRST}.png").write_bytes(b"\x89PNG"),
        "cannot be read as an image",
    ),
    "pickle": (replaced("range", lambda image: np.array([{}]), ending=".npy"), "cannot be read as an image"),
    "mirrored labels": (replaced("labels", lambda image: image[:, ::-1].copy()), "labels look mirrored left to right"),
    "mirrored camera": (all_replaced(("range", "labels"), lambda image: image[:, ::-1].copy()), "the camera's images"),
    "mirrored projector": (all_replaced(("projector",), lambda image: image[:, ::-1].copy()), "the projector's images"),
    "left-handed": (
        all_replaced(("range", "labels", "projector"), lambda image: image[:, ::-1].copy()),
        "all images look mirrored",
    ),
    "turned labels": (replaced("labels", lambda image: image[::-1].copy()), "labels look mirrored upside down"),
    "another unit": (all_replaced(("projector",), lambda image: (image // 2).astype(np.uint16)), "or a unit another"),
    "other side": (
        in_rig("[0.3, 0.0, 0.0]\naims_at_m = [0.1,", "[-0.3, 0.0, 0.0]\naims_at_m = [-0.1,"),
        "on the other side",
    ),
    "OpenGL's axes": (
        in_rig("1.5]", "-1.5]"),
        "the camera sees 1.5 m away: found one at [0.3, 0.0, 0.0] m that aims at [0.1, 0.0, -1.5] (x right, z ahead)",
    ),
    "no rig": (in_set('rig = "rig.toml"', ""), "'rig' is missing"),
    "no classes": (in_set('classes = ["floor", "arm", "box"]', ""), "'classes' is missing"),
    "misspelt": (in_set("unit_m", "units_m"), "unknown 'units_m'"),
    "class twice": (in_set('"arm"', '"floor"'), "a class is named once"),
    "label twice": (in_set("background = [0]", "background = [1]"), "stands for two classes"),
    "no row": (table("key,split\nscene-000,train\n"), "no row for 'scene-001'"),
    "no image": (table("key,split\n" + "".join(f"scene-00{n},train\n" for n in range(5))), "no images for 'scene-004'"),
    "split": (table("key,split\nscene-000,val\n"), "line 2: 'split' must be one of train, test"),
    "no key": (table("Key,split\nscene-000,train\n"), "line 2: a row must have a 'key', found 'Key', 'split'"),
    "cells": (table("key,split\nscene-000\n"), "line 2: a row has a cell"),
    "field": (lambda folder: (folder / "samples.jsonl").write_text('{"key": "scene-000", "Robot": "r"}'), "line 1:"),
    "unprintable": (  # of the separators of lines, JSON allows some within a text
        lambda folder: (folder / "samples.jsonl").write_text('{"key": "scene-000", "note": "a\u2028b"}'),
        "line 1: field 'note' must be text that can be printed",
    ),
    "format": (in_set("bodyseg renders 1", "2"), "'format' must be 'bodyseg renders 1'"),
}


@pytest.mark.parametrize(
    ("line", "rule"),
    [
        ("no_range = 3", "'no_range' must be a list"),
        ('no_range = ["far"]', "a list of numbers"),
        ("classes = [3]", "a class is a name or a table"),
        ('classes = [{ name = "arm", label = 1.5 }]', "'label' of class 0 must be a whole number or a colour"),
        ('classes = [{ name = "arm", colour = "red" }]', "'colour' of class 0 must be a whole number or a colour"),
        ('classes = [{ name = "arm", within = 3 }]', "'within' of 'arm' must be a name"),
        ('classes = [{ name = "arm", side = "up" }]', "'arm' must be left, right or middle"),
        ("rigs = 3", "must give names to rig files"),
        ("rig = 3", "'rig' must be a file, a name or a table"),
        ('rig = "paper"\n[rigs]\nnear = "paper"', "found both"),
    ],
)
def test_set_toml_is_refused_for_values_of_another_kind(tmp_path: Path, line: str, rule: str) -> None:
    (tmp_path / "set.toml").write_text(f'format = "bodyseg renders 1"\n{line}\n')
    with pytest.raises(BadConfig, match=rf"set\.toml: .*{rule}"):
        read_set(tmp_path)


def test_a_set_has_one_table_of_samples_with_each_key_once(tmp_path: Path) -> None:
    (tmp_path / "samples.jsonl").write_text('{"key": "a"}\n{"key": "a"}\n')
    with pytest.raises(BadConfig, match=r"samples\.jsonl, line 2: .*each key once, found 'a'"):
        read_rows(tmp_path, SetFile(tmp_path / "set.toml"))
    (tmp_path / "samples.csv").write_text("key\na\n")
    with pytest.raises(BadConfig, match="one table of samples"):
        read_rows(tmp_path, SetFile(tmp_path / "set.toml"))


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], mistake: str) -> None:
    folder = plain(tmp_path / "cell")
    spoil, said = MISTAKES[mistake]
    spoil(folder)
    assert said in refused(folder, capsys)


def rewritten(path: Path, **changes: Any) -> None:
    """Change entries of a JSON file; None takes one away."""
    tree = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({key: value for key, value in tree.items() if value is not None}))


def params(**changes: Any) -> Callable[[Path], None]:
    return lambda folder: rewritten(folder / "camera_params_0000.json", **changes)


ISAAC_MISTAKES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no distances": (lambda folder: remove(folder, "distance_to_image_plane_*"), "its layout cannot be told"),
    "no labels": (
        lambda folder: remove(folder, "semantic_segmentation_*"),
        "BasicWriter with semantic_segmentation=True",
    ),
    "no params": (lambda folder: remove(folder, "camera_params_0001.json"), "'rig' is missing; a rig is made of"),
    "no projector": (lambda folder: shutil.rmtree(folder / "projector"), "'rig' is missing; a rig is made of"),
    "no partner": (lambda folder: remove(folder / "projector", "distance_*_0001.npy"), "the second lacks 1 of 3"),
    "fisheye": (params(cameraModel="fisheyePolynomial"), "'cameraModel' must be pinhole"),
    "offset": (params(cameraApertureOffset=[1.0, 0.0]), "an aperture with an offset"),
    "mirror": (params(cameraViewTransform=np.diag([-1.0, 1, 1, 1]).ravel().tolist()), "one that mirrors or scales"),
    "no aperture": (params(cameraAperture=None), "list 'cameraAperture' is missing"),
    "key": (lambda folder: rewritten(labels_json(folder), x={"class": "arm"}), "a key must be like '3'"),
    "unknown colour": (
        lambda folder: labels_json(folder).write_text('{"(1, 2, 3, 255)": {"class": "arm"}}'),
        "colours that are neither",
    ),
    "not JSON": (lambda folder: labels_json(folder).write_text("{"), "is not JSON"),
    "no name": (lambda folder: labels_json(folder).write_text('{"1": {"class": 3}}'), "must name a class"),
    "size": (
        lambda folder: np.save(folder / "distance_to_image_plane_0000.npy", np.ones((8, 8), np.float32)),
        "must have 16 rows and 20 columns",
    ),
}


def remove(folder: Path, pattern: str) -> None:
    for path in folder.glob(pattern):
        path.unlink()


def labels_json(folder: Path) -> Path:
    return folder / "semantic_segmentation_labels_0000.json"


@pytest.mark.parametrize("mistake", ISAAC_MISTAKES)
def test_a_mistake_with_isaac_sim_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], mistake: str) -> None:
    folder = isaac(tmp_path / "cell")
    spoil, said = ISAAC_MISTAKES[mistake]
    spoil(folder)
    assert said in refused(folder, capsys)


def in_frame(change: Callable[[Any], Any]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        h5py = pytest.importorskip("h5py")
        with h5py.File(folder / "0.hdf5", "a") as file:
            change(file)

    return apply


def stereo(file: Any) -> None:
    depth = file["depth"][()]
    del file["depth"]
    file["depth"] = np.stack([depth, depth])


def instances_only(file: Any, name: str) -> None:
    file["instance_segmaps"] = file["class_segmaps"][()]
    del file["class_segmaps"]
    if name in file:
        del file[name]
    file[name] = np.bytes_('[{"idx": 0}]')


BLENDERPROC_MISTAKES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "no depth": (in_frame(lambda file: file.pop("depth")), "enable_depth_output"),
    "no labels": (in_frame(lambda file: file.pop("class_segmaps")), "enable_segmentation_output"),
    "stereo": (in_frame(stereo), "stereo pair go into two folders"),
    "attributes": (in_frame(lambda file: instances_only(file, "instance_attribute_maps")), "idx and category_id"),
    "no HDF5": (lambda folder: (folder / "0.hdf5").write_bytes(b"no"), "cannot be read as HDF5"),
    "no frame": (lambda folder: remove(folder / "projector", "*.hdf5"), "found none"),
    "no folder": (
        in_set("rig =", 'projector = "light"\nrig ='),
        "'projector' must be a folder beside it, found 'light'",
    ),
    "no set": (lambda folder: (folder / "set.toml").unlink(), "'classes' is missing"),
}


@pytest.mark.parametrize("mistake", BLENDERPROC_MISTAKES)
def test_a_mistake_with_blenderproc_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], mistake: str
) -> None:
    pytest.importorskip("h5py")
    folder = blenderproc(tmp_path / "cell")
    spoil, said = BLENDERPROC_MISTAKES[mistake]
    spoil(folder)
    assert said in refused(folder, capsys)


@pytest.mark.parametrize(("module", "write"), [("h5py", blenderproc), ("OpenEXR", partial(plain, ending=".exr"))])
def test_a_missing_package_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, module: str, write: Any
) -> None:
    pytest.importorskip(module)
    folder = write(tmp_path / "cell")
    monkeypatch.setitem(sys.modules, module, None)
    assert f"needs the package {module!r}: pip install 'bodyseg[renders]'" in refused(folder, capsys)


def test_options_of_bodies_do_not_go_with_renders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = plain(tmp_path / "cell")
    for words in (
        "--meshes 2",
        "--views 3",
        "--renderer embree",
        "--landmarks x",
        "--rig kinect_v1",
        "--engine dask://a:1",
    ):
        assert f"{words.split()[0]} does not go with --source renders" in refused(folder, capsys, *words.split())
    assert main(["shard", "--source", "open", "--layout", "plain", "--plan"]) == 2
    assert "--layout does not go with --source open" in capsys.readouterr().err
    assert main(["shard", "--source", "renders", "--plan"]) == 2
    assert "needs --path" in capsys.readouterr().err


def test_folders_of_two_render_products_are_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    isaac(tmp_path / "out" / "Replicator")
    assert "by 'camera' and 'projector' in which folders" in refused(tmp_path / "out", capsys)


def test_a_layout_that_cannot_be_told_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = plain(tmp_path / "cell")
    np.save(folder / "distance_to_image_plane_0000.npy", np.ones((16, 20)))
    assert "found signs of plain and isaac" in refused(folder, capsys)
    assert pack(folder, "--layout", "plain", "--plan") == 0
    edit(folder, "first_label = 1", 'first_label = 1\nlayout = "maya"')
    capsys.readouterr()
    assert "must be one of plain, blenderproc, isaac, found 'maya'" in refused(folder, capsys)
    assert "no folder" in refused(tmp_path / "none", capsys)


@pytest.mark.parametrize(
    "write", [plain, partial(plain, ending=".npz"), partial(plain, ending=".exr"), blenderproc, isaac]
)
def test_damaged_files_end_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], write: Any) -> None:
    for module in ("h5py", "OpenEXR"):
        pytest.importorskip(module)
    folder, draws = write(tmp_path / "cell", count=1), np.random.default_rng(5)
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        whole = path.read_bytes()
        data = bytearray(whole[: int(draws.integers(len(whole))) if draws.random() < 0.3 else None])
        for place in draws.integers(len(whole), size=8):
            data[place : place + 1] = draws.bytes(1)
        path.write_bytes(data)
        assert pack(folder) in (0, 2), (path.name, capsys.readouterr().err)
        shutil.rmtree(folder.parent / "shards", ignore_errors=True)
        path.write_bytes(whole)


def test_images_are_bounded_by_what_they_declare(tmp_path: Path) -> None:
    h5py, exr = pytest.importorskip("h5py"), pytest.importorskip("OpenEXR")
    header = {"compression": exr.ZIPS_COMPRESSION, "type": exr.scanlineimage}
    exr.File(header, {"Z": np.ones((20, 30), np.float32)}).write(str(tmp_path / "a.exr"))
    assert read_array(tmp_path / "a.exr").shape == (20, 30)
    data = bytearray((tmp_path / "a.exr").read_bytes())
    window = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    data[window : window + 16] = struct.pack("<4i", 0, 0, 60_000, 60_000)
    (tmp_path / "a.exr").write_bytes(data)
    tags = {256: 16, 257: 16, 258: 16, 259: 8, 262: 1, 277: 1, 322: 32_768, 323: 32_768, 324: 8, 325: 8}
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    (tmp_path / "a.tif").write_bytes(b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4))
    for name in ("a.exr", "a.tif"):
        with pytest.raises(BadSample, match="it has more pixels than an image can"):
            read_array(tmp_path / name)
    (tmp_path / "secret").write_bytes(bytes(100))
    for options, message in (
        ({"shape": (10, 10), "external": [(str(tmp_path / "secret"), 0, 100)]}, "lies in another file"),
        ({"shape": (10**5, 10**5), "chunks": (10, 10)}, "more than an image can"),
        ({"shape": (10, 10), "maxshape": (None, None), "chunks": (30_000, 30_000)}, "more than an image can"),
    ):
        with h5py.File(tmp_path / "a.hdf5", "w") as file:
            file.create_dataset("depth", dtype="u1", **options)
        with pytest.raises(BadSample, match=message):
            _datasets(tmp_path / "a.hdf5")
