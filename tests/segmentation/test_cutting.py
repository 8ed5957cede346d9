"""People cut out of whole frames: what the network sees of them, with the labels of the frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from bodyseg_data import RangeImages, ShardWriter
from bodyseg_data.labels import BACKGROUND, PARTS33, UNLABELLED, classes_of
from bodyseg_data.rigs import Camera, Rig, load_rig
from bodyseg_model.commands import cli
from bodyseg_model.segmentation import cut_people

LENS = Camera(60, 80, 100.0, (40.0, 30.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
ROOM = Rig("room", 2.0, LENS, replace(LENS, position_m=(0.1, 0.0, 0.0), aims_at_m=(0.1, 0.0, 1.0)))
PAPER = load_rig()

pytestmark = pytest.mark.usefixtures("one_thread", "near_is_person")


def room(left: int, width: int = 12) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """A wall 5 m away, and before it somebody at 2 m, in the rows 10 to 49, with a new part every fourth row."""
    range_m, labels = np.full((60, 80), 5.0, np.float32), np.full((60, 80), UNLABELLED, np.uint8)
    range_m[10:50, left : left + width] = 2.0
    labels[10:50, left : left + width] = np.arange(40)[:, None] // 4
    return range_m, labels


def test_a_person_is_cut_out_as_the_network_sees_people_with_the_labels_of_the_frame() -> None:
    (person,) = cut_people(*room(34), LENS, PAPER)
    assert person.range_m.shape == person.labels.shape == (640, 329)
    np.testing.assert_array_equal(person.range_m[person.range_m > 0], np.float32(2.5))
    np.testing.assert_array_equal(person.labels == BACKGROUND, person.range_m == 0)
    scale = 757.5757 / 2.5 / (100 / 2.0)
    edges = 320 + (np.arange(10, 51, 4) - 30) * scale  # of parts, in the image of the paper's camera
    first = (np.floor(edges[0]) + np.ceil(edges[-1]) - 640) // 2
    rows = np.flatnonzero(person.range_m.any(axis=1))
    middle = person.labels[rows, 164]
    expected = np.searchsorted(edges, rows + first + 0.5, "right") - 1
    # A pixel has the label of the nearest pixel of the frame, whose place is rounded: a border moves by one at most.
    assert set(middle[expected != middle] - expected[expected != middle].astype(int)) <= {-1, 1}
    assert np.count_nonzero(expected != middle) <= 9


def test_what_is_mostly_no_person_is_left_out_and_things_in_hands_have_no_class() -> None:
    range_m, labels = room(34)
    labels[10:29, 34:46] = UNLABELLED
    (person,) = cut_people(range_m, labels, LENS, PAPER)
    counts = np.bincount(person.labels[person.labels != BACKGROUND], minlength=255)
    assert counts[UNLABELLED] == pytest.approx(counts.sum() * 19 / 40, rel=0.01)
    labels[10:31, 34:46] = UNLABELLED
    assert list(cut_people(range_m, labels, LENS, PAPER)) == []
    assert list(cut_people(np.full_like(range_m, 5.0), labels, LENS, PAPER)) == []


def test_a_view_that_is_larger_than_the_image_is_cut_into_windows_that_hold_all_of_it() -> None:
    narrow = replace(PAPER, camera=replace(PAPER.camera, columns=41, centre_px=(20.5, 320.0)))
    (whole,), parts = (list(cut_people(*room(34), LENS, rig)) for rig in (PAPER, narrow))
    seen = np.flatnonzero(whole.labels[320] != BACKGROUND)
    assert len(parts) == -(-len(seen) // 41) > 1
    body = whole.labels[:, seen]
    for part, left in zip(parts, np.linspace(0, len(seen) - 41, len(parts)), strict=True):
        np.testing.assert_array_equal(part.labels, body[:, int(left) : int(left) + 41])


def test_larger_images_hold_whole_those_alone_who_are_larger_than_the_rigs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    narrow = replace(PAPER, camera=replace(PAPER.camera, columns=41, centre_px=(20.5, 320.0)))
    (whole,) = cut_people(*room(34), LENS, PAPER)
    assert list(cut_people(*room(34), LENS, PAPER, larger=(700, 400))) == []  # the paper's images hold them
    (larger,) = cut_people(*room(34), LENS, narrow, larger=(700, 329))
    assert larger.labels.shape == larger.range_m.shape == (700, 329)
    np.testing.assert_array_equal(larger.labels[30:-30], whole.labels)
    assert not larger.range_m[:30].any() and (larger.labels[-30:] == BACKGROUND).all()
    parts = list(cut_people(*room(34), LENS, narrow, larger=(640, 60)))
    assert len(parts) == -(-int(np.ptp(np.flatnonzero(whole.labels[320] != BACKGROUND)) + 1) // 60)
    range_m, labels = room(10, 58)  # 350 pixels of the paper's camera, which has 329
    with ShardWriter(tmp_path / "wide", rig=ROOM, classes=classes_of(PARTS33.names), projector="none") as out:
        out.write(key="wide", range_m=range_m, labels=labels, split="train")
    given = ["cut", "--data", str(tmp_path / "wide"), "--variant", "none", "--out", str(tmp_path / "people")]
    assert cli.main([*given, "--larger", "700"]) == 2
    assert "--larger needs two numbers, rows and columns, found 1" in capsys.readouterr().err
    assert cli.main([*given, "--larger", "700", "400"]) == 0
    images = RangeImages(tmp_path / "people")
    camera = images.manifest.rig.camera
    assert (len(images), images.shape) == (1, (700, 400))
    assert (camera.rows, camera.columns, camera.centre_px) == (700, 400, (200.0, 350.0))
    assert camera.focal_px == PAPER.camera.focal_px


def frames(folder: Path) -> Path:
    """Three rooms: with somebody, with nobody, and for the test, with somebody else."""
    with ShardWriter(folder, rig=ROOM, classes=classes_of(PARTS33.names), projector="none") as out:
        for number, left in enumerate((34, 0, 20)):
            range_m, labels = room(left, 12 if left else 0)
            out.write(key=f"room-{number}", range_m=range_m, labels=labels, split="test" if number == 2 else "train")
    return folder


def test_the_command_packs_a_set_to_train_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["cut", "--data", str(frames(tmp_path / "rooms")), "--variant", "none", "--out", str(tmp_path / "people")]
    assert cli.main(given) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'people'}: 1 images of people in 2 frames\n"
    images = RangeImages(tmp_path / "people", variant="occ")
    assert images.manifest.classes.names == PARTS33.names
    assert images.table()["frame"].tolist() == ["room-0"]
    assert images.keys == ["room-0-0"]
    (cut,) = cut_people(*room(34), LENS, PAPER)
    np.testing.assert_array_equal(images.image(0).range, np.rint(cut.range_m * 1000))  # shadows are the frame's own
    np.testing.assert_array_equal(images.image(0).labels, cut.labels)
    with pytest.warns(UserWarning, match="nothing was written"):
        assert cli.main(given) == 0
    capsys.readouterr()
    for others in (["--split", "test"], ["--variant", "noise"], ["--seed", "1"]):
        assert cli.main([*given, *others]) == 2
        assert "people already holds a set of shards packed with other options" in capsys.readouterr().err


def test_what_cannot_be_cut_is_refused_in_one_line_and_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rooms, out = frames(tmp_path / "rooms"), tmp_path / "people"
    given = ["cut", "--data", str(rooms), "--out", str(out)]
    for words, told in (
        (["--variant", "none", "--finder", "compact"], "a finder of people needs 2 classes"),
        (["--variant", "none", "--where", "rig=1"], "rig"),
        ([], "holds no projector range"),
    ):
        assert cli.main([*given, *words]) == 2
        assert told in capsys.readouterr().err
        assert not out.exists()
