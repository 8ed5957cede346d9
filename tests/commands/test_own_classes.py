"""The whole path on a set of classes of its own, by the commands: nothing takes a floor for a part of a body."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benches import __main__ as tools
from open_sets import CELL_CLASSES, NAMES, STEP_M, write_open_set
from PIL import Image

from bodyseg_data import BadConfig, LabelMap, Mixture, RangeImages
from bodyseg_data.labels import LANDMARKS, Classes, LabelClass, classes_of, whole_map
from bodyseg_model import load_network
from bodyseg_model.commands import main
from bodyseg_model.segmentation import FrameLabeller
from bodyseg_model.training.loss import class_pixels
from bodyseg_model.viewing.set_view import SetView, Shown

# Two levels: in bfloat16, with AMX, PyTorch 2.13 at times gives a layer of stride 2 that sees one cell nan as gradient.
SETTINGS = json.dumps({"widths": [8, 8], "blocks": [1, 1]})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two sets, of which `dark` has no projector's range, and a network trained on the first."""
    found = tmp_path_factory.mktemp("own classes")
    write_open_set(found / "cells")
    write_open_set(found / "dark", projector="none")
    options = ["--steps", "2", "--batch-size", "4", "--num-workers", "0", "--settings", SETTINGS, "--device", "cpu"]
    assert main(["train", "--data", str(found / "cells"), "--out", str(found / "run"), *options]) == 0
    return found


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run a command that must be refused; returns its last line."""

    def run(*arguments: Any) -> str:
        assert main(list(map(str, arguments))) == 2
        return capsys.readouterr().err.splitlines()[-1]

    return run


def pixels_of(path: Path) -> Any:
    with Image.open(path) as picture:
        return np.asarray(picture)


def words_of_bodies(text: str) -> list[str]:
    return [word for word in (*LANDMARKS, "body part", "one of 33", "person") if word in text]


def test_inspect_names_classes_fields_planes_and_rigs(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sheet = folder / "sheet.png"
    assert main(["inspect", str(folder / "cells"), "--json", "--rows", "1", "--out", str(sheet)]) == 0
    told = json.loads(capsys.readouterr().out)
    assert tuple(told["class_shares"]) == NAMES and told["classes"] == "robot cell"
    assert told["rigs"] == 2 and told["planes"] == {"instances": "uint16", "material": "uint8"}
    assert told["fields"]["cell"] == {"c0": 4, "c1": 4, "c2": 4}
    assert sum(told["fields"]["height_m"].values()) == 12
    dark = folder / "dark.png"
    assert main(["inspect", str(folder / "dark"), "--variant", "none", "--rows", "1", "--out", str(dark)]) == 0
    lit = folder / "lit.png"
    assert main(["inspect", str(folder / "dark"), "--occluder", "camera", "--rows", "1", "--out", str(lit)]) == 0
    widths = [pixels_of(path).shape[1] for path in (sheet, dark, lit)]
    assert widths[0] == widths[2] > widths[1]  # without what the projector sees, and the two variants with shadows


def test_inspect_gives_the_ends_of_fields_of_many_values(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_open_set(tmp_path, 21, 0)
    assert main(["inspect", str(tmp_path), "--json", "--where", "lamps>=0"]) == 0
    assert json.loads(capsys.readouterr().out)["fields"]["height_m"] == {"values": 21, "least": 1.5, "greatest": 4.0}


def test_cards_tell_of_the_sets_own_classes(folder: Path) -> None:
    assert tools.main(["card", str(folder / "cells"), "--title", "Cells"]) == 0
    page, tree = (
        (folder / "cells" / "README.md").read_text(),
        json.loads((folder / "cells" / "croissant.json").read_text()),
    )
    assert "scenes with a class, one of 12 (robot cell), at each pixel: 8 for training and 4 for testing" in page
    for line in (
        "| 7 | left finger | robot | right finger |",
        "| cell | c0, c1, c2 |",
        "| height_m | 1.5 to 2.875 |",
        "| `NAME.plane.instances.*` | the plane `instances`, whole numbers |",
        "| further rigs | 1, like this one but for their lenses and places |",
    ):
        assert f"{line}\n" in page
    assert not words_of_bodies(page) and not words_of_bodies(json.dumps(tree))
    assert [row["classes/name"] for row in tree["recordSet"][-1]["data"]] == [*NAMES]


def test_a_network_is_trained_scored_and_exported_with_its_classes(folder: Path) -> None:
    card = json.loads((folder / "run" / "network.json").read_text())
    assert card["settings"]["classes"] == 12 and card["labels"]["of"] == CELL_CLASSES.to_json()
    assert load_network(folder / "run").label_map.names == NAMES
    words = ["--run", str(folder / "run"), "--data", str(folder / "cells"), "--num-workers", "0", "--frames", "0"]
    scores, figures = folder / "scores.json", folder / "figures"
    assert main(["evaluate", *words, "--json", str(scores), "--figures", str(figures), "--device", "cpu"]) == 0
    told = json.loads(scores.read_text())
    assert [part["name"] for part in told["classes"]] == [*NAMES] and len(told["confusion"]) == 12
    assert list(told["subsets"]) == ["all"] and told["subsets"]["all"]["images"] == 4
    assert (figures / "samples.png").exists()
    assert tools.main(["card", str(folder / "run")]) == 0
    page = (folder / "run" / "README.md").read_text()
    assert "Labels the pixels of a range image as robot cell." in page and not words_of_bodies(page)


def test_a_network_refuses_sets_of_other_classes(
    folder: Path, tmp_path: Path, small_set: Path, refused: Callable[..., str], capsys: pytest.CaptureFixture[str]
) -> None:
    write_open_set(tmp_path / "other", 2, 2, classes=classes_of([*NAMES[:11], "hose"], "other cell"))
    scored = ["--json", tmp_path / "no.json", "--num-workers", 0, "--frames", 0]
    for data, name, first in (
        (tmp_path / "other", "other cell", "11 is 'cable' and 'hose'"),
        (small_set, "parts33", "0 is 'floor' and 'Sellion'"),
    ):
        line = refused("evaluate", "--run", folder / "run", "--data", data, *scored)
        assert line.endswith(f"other classes than the set's: found the labels 'robot cell' and {name!r}: {first}")
    assert "'parts33' are of other classes than the set's" in refused("evaluate", "--data", folder / "cells", *scored)
    training = ["--steps", 4, "--batch-size", 2, "--num-workers", 0, "--settings", SETTINGS, "--device", "cpu"]
    line = refused("train", "--data", tmp_path / "other", "--out", folder / "run", "--resume", *training)
    assert "holds another training" in line
    words = ["--data", tmp_path / "other", "--out", tmp_path / "run", "--pretrained", folder / "run", *training]
    capsys.readouterr()
    assert main(["train", *map(str, words)]) == 0
    assert "other classes, 'robot cell': all weights are kept, as there are as many\n" in capsys.readouterr().err
    line = refused("stability", "--run", folder / "run", "--data", folder / "cells", "--out", tmp_path / "stability")
    assert "stability is measured on the 33 parts" in line


def test_classes_may_be_joined_and_have_no_mirror_image(
    folder: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    joined = tmp_path / "hands.toml"
    joined.write_text(
        'format = "bodyseg labels 1"\nname = "hands"\n[classes]\nleft = ["left finger"]\nrest = ["floor"]\n'
    )
    words = ["--data", folder / "cells", "--labels", joined, "--steps", 1, "--batch-size", 4, "--num-workers", 0]
    line = refused("train", *words, "--out", tmp_path / "run")
    assert line.endswith("labels 'hands': the mirror image of the class 'left' must be one class")
    words += ["--settings", SETTINGS, "--no-mirror", "--device", "cpu"]
    assert main(list(map(str, ["train", *words, "--out", tmp_path / "run"]))) == 0
    assert load_network(tmp_path / "run").label_map.names == ("left", "rest")


def test_a_mixture_counts_the_pixels_of_each_set_by_its_own_map(folder: Path, tmp_path: Path) -> None:
    unpaired = Classes("reversed", tuple(map(LabelClass, NAMES[::-1])))
    write_open_set(tmp_path, 8, 4, classes=unpaired)
    plain = RangeImages(folder / "cells", "none")
    turned = LabelMap("robot cell", tuple((name, (name,)) for name in NAMES), unpaired)
    with pytest.raises(BadConfig, match="other mirror images"):
        Mixture([(plain, 1.0), (RangeImages(tmp_path, "none", labels=turned), 1.0)])
    maps = [LabelMap("two", (("a", ("floor",)), ("b", ("wall",))), each.of) for each in (plain.label_map, turned)]
    sets = [
        RangeImages(path, "none", labels=each) for path, each in zip((folder / "cells", tmp_path), maps, strict=True)
    ]
    both = Mixture([(each, 1.0) for each in sets])
    picked = both.evenly_sampled(128).tolist()
    floors = sum(int((both.clean(index).labels == (0 if index < 12 else 11)).sum()) for index in picked)
    assert class_pixels(both)[0] == floors / len(picked) > 0


def test_frames_are_labelled_whole(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images = RangeImages(folder / "cells", "all", "test")
    frame = tmp_path / "frame.png"
    Image.fromarray(images.image(0).range).save(frame)
    words = [str(frame), "--run", str(folder / "run"), "--units", "mm", "--focal", "18", "--device", "cpu"]
    assert main(["segment", *words, "--out", str(tmp_path / "out")]) == 0
    assert "less accurate" not in capsys.readouterr().err
    other = ["30" if word == "18" else word for word in words]
    assert main(["segment", *other, "--out", str(tmp_path / "other")]) == 0
    rows, columns = images.image(0).range.shape
    assert (
        f"frames are {rows} x {columns} with a focal length of 30 px, those that the network was trained on {rows} x "
        f"{columns} with a focal length of 18 px: labels are less accurate\n"
    ) in capsys.readouterr().err
    told = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert told["labels"] == whole_map(CELL_CLASSES).to_json() and told["background"] == {"mode": "frame"}
    labels = pixels_of(tmp_path / "out" / "labels" / "frame.png")
    range_m = images.image(0).range * np.float32(STEP_M)
    assert np.array_equal(labels != 255, range_m > 0)
    labeller = FrameLabeller(load_network(folder / "run"), device="cpu")
    camera = images.manifest.rigs[0].camera
    assert np.array_equal(labeller(range_m, camera).labels, labels)
    turned = FrameLabeller(load_network(folder / "run"), device="cpu", mirrored=True)
    mirrored = turned(np.ascontiguousarray(range_m[:, ::-1]), camera)
    assert np.array_equal(mirrored.labels, labels[:, ::-1])


def test_the_viewer_shows_the_sets_own_classes(folder: Path) -> None:
    view = SetView(folder / "cells", load_network(folder / "run"))
    drawing = view.draw(Shown(1))
    assert [name for name, _ in drawing.legend] == [f"{label} {name}" for label, name in enumerate(NAMES)]
    dark = SetView(folder / "dark").draw(Shown(0, "all"))
    assert "measured in none" in "".join(dark.facts)


def test_classes_that_differ_in_colour_alone_are_the_same() -> None:
    one, other = (
        classes_of([LabelClass("a", colour=colour), "b"], name) for colour, name in (("#000000", "x"), (None, "y"))
    )
    assert one == other and hash(one) == hash(other) and one.colours.tolist() != other.colours.tolist()
    assert one != classes_of(["a", "c"], "x")
