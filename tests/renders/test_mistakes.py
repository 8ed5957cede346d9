"""Mistakes of those who render: each is one line that names the file and the rule."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rendered_scenes import CAMERA, PROJECTOR, SET_TOML, blenderproc, isaac, millimetres, plain, save, seen_by

from bodyseg_data.commands.cli import main

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


def edit(folder: Path, old: str, new: str) -> None:
    assert old in (folder / "set.toml").read_text()
    (folder / "set.toml").write_text((folder / "set.toml").read_text().replace(old, new))


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


def coloured(image: Any, blend: bool = False) -> Any:
    table = np.array([[0, 0, 0], [255, 0, 0], [0, 255, 0], [0, 0, 255]], np.uint8)
    found = table[image]
    if blend:
        found[5, 5:9] = [[100, 20, 3], [90, 20, 3], [80, 20, 3], [70, 20, 3]]
    return found


COLOURS = 'classes = [{name="floor", colour="#ff0000"}, {name="arm", colour="#00ff00"}, {name="box", colour="#0000ff"}]'
IN_COLOURS = in_set('classes = ["floor", "arm", "box"]', COLOURS)
ALSO_BLACK = in_set("background = [0]", 'background = [0, "#000000"]')


def both(*steps: Callable[[Path], None]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        for step in steps:
            step(folder)

    return apply


def table(text: str) -> Callable[[Path], None]:
    return lambda folder: [(folder / "samples.jsonl").unlink(), (folder / "samples.csv").write_text(text)] and None


MISTAKES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "unit": (in_set("unit_m = 0.001", "unit_m = 1.0"), "look like millimetres (unit_m = 0.001)"),
    "small unit": (in_set("unit_m = 0.001", "unit_m = 0.000001"), "is 'unit_m' right?"),
    "no unit": (in_set("unit_m = 0.001", ""), "integers needs 'unit_m'"),
    "8 bits": (replaced("range", lambda image: (image // 16).astype(np.uint8)), "holds at most 256 ranges"),
    "colours": (
        replaced("range", lambda image: np.zeros((*image.shape, 3), np.uint8)),
        "a range image has one channel",
    ),
    "half": (replaced("range", lambda image: image.astype(np.float16), ending=".npy"), "16-bit floats"),
    "negative": (replaced("range", lambda image: -image.astype(np.float32), ending=".npy"), "axis points backwards"),
    "buffer": (
        replaced("range", lambda image: np.where(image == 0, 1, image / 3000).astype(np.float32), ending=".npy"),
        "a depth buffer",
    ),
    "far plane": (replaced("range", lambda image: np.where(image == 0, 6000, image).astype(np.uint16)), "'no_range'"),
    "size": (replaced("labels", lambda image: image[:-1]), "must have 16 rows and 20 columns"),
    "turned": (replaced("range", lambda image: image.T.copy()), "rows and columns are exchanged"),
    "projector's size": (
        replaced("projector", lambda image: image[:8]),
        "24 rows and 30 columns as the rig's projector",
    ),
    "label": (replaced("labels", lambda image: np.where(image == 2, 9, image).astype(np.uint8)), "label 9 ("),
    "half labels": (replaced("labels", lambda image: image / 2, ending=".npy"), "a label must be a whole number"),
    "coloured labels": (replaced("labels", coloured), "no class of set.toml has a colour"),
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
    "no rig": (in_set('rig = "rig.toml"', ""), "'rig' is missing"),
    "no classes": (in_set('classes = ["floor", "arm", "box"]', ""), "'classes' is missing"),
    "misspelt": (in_set("unit_m", "units_m"), "unknown 'units_m'"),
    "class twice": (in_set('"arm"', '"floor"'), "a class is named once"),
    "label twice": (in_set("background = [0]", "background = [1]"), "stands for two classes"),
    "no row": (table("key,split\nscene-000,train\n"), "no row for 'scene-001'"),
    "no image": (table("key,split\n" + "".join(f"scene-00{n},train\n" for n in range(5))), "no images for 'scene-004'"),
    "split": (table("key,split\nscene-000,val\n"), "line 2: 'split' must be one of train, test"),
    "cells": (table("key,split\nscene-000\n"), "line 2: a row has a cell"),
    "field": (lambda folder: (folder / "samples.jsonl").write_text('{"key": "scene-000", "Robot": "r"}'), "line 1:"),
    "format": (in_set("bodyseg renders 1", "2"), "'format' must be 'bodyseg renders 1'"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], mistake: str) -> None:
    folder = plain(tmp_path / "cell")
    spoil, said = MISTAKES[mistake]
    spoil(folder)
    assert said in refused(folder, capsys)
