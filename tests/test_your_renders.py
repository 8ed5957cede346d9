"""The program of a robot cell, and the tutorial that goes on from it to labelled frames, at small size."""

from __future__ import annotations

import json
import re
import shlex
import sys
from collections.abc import Iterator
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Final

import numpy as np
import pytest
from folders import DOCS
from pngs import pixels
from seen import skip_without_opengl
from tutorials import smaller

from bodyseg_data import RangeImages
from bodyseg_data.labels import BACKGROUND
from bodyseg_model.commands import main as bodyseg_main

SIZES: Final = {
    "shard --workers": "1",
    "train --steps": "2",
    "train --batch-size": "2",
    "train --num-workers": "0",
    "train --precision": "float32",
    "evaluate --images": "2",
    "evaluate --num-workers": "0",
}
"""Options that make the commands short."""

BLOCK: Final = re.compile(r"^```(bash|python)\n(.*?)^```", re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def program() -> Iterator[ModuleType]:
    skip_without_opengl()
    spec = spec_from_file_location("robot_cell", DOCS / "examples" / "robot_cell.py")
    assert spec is not None and spec.loader is not None
    found = module_from_spec(spec)
    spec.loader.exec_module(found)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gc.collect", lambda: 0)  # each of pyrender's renderers, as it goes, looks at all that tests keep
        yield found


def steps_of(document: Path) -> Iterator[tuple[str, list[str] | str]]:
    """Commands of a document, as (program, words), and its Python blocks, as ("", text), in their order."""
    for language, text in BLOCK.findall(document.read_text()):
        if language == "python":
            yield "", text
        else:
            yield from ((words[0], words[1:]) for words in map(shlex.split, text.splitlines()) if words)


def test_the_tutorial_runs_from_renders_to_labels(
    program: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    *_, frames = (text for name, text in steps_of(DOCS / "tutorials" / "start.md") if not name)
    for _ in range(2):  # the first tutorial, which may be repeated, leaves its frames in the same folder
        exec(compile(str(frames), "start.md", "exec"), {})
    ran = []
    for name, words in steps_of(DOCS / "tutorials" / "your_renders.md"):
        if isinstance(words, str):
            exec(compile(words.replace("range(3)", "range(1)"), "your_renders.md", "exec"), {})
        elif name == "python":
            assert words[0] == "robot_cell.py"
            program.main([*smaller(["cell", *words[1:]], {"cell --scenes": "5", "cell --columns": "48"})[1:]])
        elif name == "bodyseg":
            assert bodyseg_main(smaller(words, SIZES)) == 0, (words, capfd.readouterr().err)
            ran.append(words[0])
    assert ran == ["shard", "verify", "inspect", "train", "evaluate", "segment"]
    images = RangeImages("cell", split="test")
    assert images.manifest.classes.names == tuple(program.CLASSES)
    assert (len(images), images.manifest.planes) == (1, {"instances": "uint16"})
    scores = json.loads(Path("scores.json").read_text())
    assert [each["name"] for each in scores["classes"]] == program.CLASSES
    labelled = sorted(Path("cell-labelled/labels").glob("*.png"))
    assert [path.stem for path in labelled] == list(images.keys)
    for index, path in enumerate(labelled):
        measured = images[index]["range"][0].numpy() > 0
        np.testing.assert_array_equal(pixels(path) != BACKGROUND, measured)


def test_files_and_shards_hold_the_same_scenes(program: ModuleType, tmp_path: Path) -> None:
    sizes = ["--scenes", "2", "--first", "3", "--columns", "48"]
    program.main([str(tmp_path / "direct"), "--shards", *sizes])
    program.main([str(tmp_path / "files"), *sizes])
    words = ["--source", "renders", "--path", str(tmp_path / "files"), "--out", str(tmp_path / "packed")]
    assert bodyseg_main(["shard", *words]) == 0
    direct, packed = RangeImages(tmp_path / "direct"), RangeImages(tmp_path / "packed")
    assert direct.keys == packed.keys and set(direct.keys) == {"cell-0003", "cell-0004"}
    for index in range(2):
        one, other = direct.clean(index), packed.clean(index)
        np.testing.assert_array_equal(one.range, other.range)
        np.testing.assert_array_equal(one.labels, other.labels)
        np.testing.assert_array_equal(one.planes["instances"], other.planes["instances"])
        assert one.info == other.info
        assert (one.faces_projector != other.faces_projector).mean() < 0.02, "found from ranges before their rounding"


def test_a_scene_is_drawn_by_its_key_alone(program: ModuleType) -> None:
    one, other = program.draw_cell("cell-0007"), program.draw_cell("cell-0007")
    assert [name for name, _ in one[0]] == [name for name, _ in other[0]]
    assert set(program.CLASSES) == {name for name, _ in one[0]} | {"person"}
    np.testing.assert_array_equal(one[1], other[1])
    assert one[2] == other[2] != program.draw_cell("cell-0008")[2]


@pytest.mark.usefixtures("program")
def test_hands_are_mirror_images_of_each_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(DOCS / "examples"))
    hands = import_module("hands")
    monkeypatch.delitem(sys.modules, "hands")
    monkeypatch.delitem(sys.modules, "robot_cell")
    hands.main([str(tmp_path / "renders"), "--scenes", "5", "--columns", "64"])
    words = ["--source", "renders", "--path", str(tmp_path / "renders"), "--out", str(tmp_path / "packed")]
    assert bodyseg_main(["shard", *words]) == 0
    images = RangeImages(tmp_path / "packed")
    classes = images.manifest.classes
    assert classes.names == tuple(hands.CLASSES) and len(classes) == 13
    assert classes.mirrored[:13].tolist() == [*range(6, 12), *range(6), 12]
    seen = {int(label) for index in range(len(images)) for label in np.unique(images.clean(index).labels)}
    assert seen == set(range(13))
