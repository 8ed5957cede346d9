"""`bodyseg segment` and `bodyseg sensor fit` on recordings: bags in, labels out, and frames that cannot be read."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from bags import DEPTH, Message, camera_info, image, write_mcap, write_ros1
from label_networks import Places
from mcap.reader import make_reader
from numpy.typing import NDArray
from PIL import Image
from small_rig import SMALL

from bodyseg_data.files import part_beside
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.rigs import Rig
from bodyseg_model import runtimes
from bodyseg_model.commands import cli
from bodyseg_model.networks import Trained
from bodyseg_model.recordings.bag_messages import typestore
from bodyseg_model.runtimes import load_network


def standing(x: int) -> NDArray[np.uint16]:
    """A block 40 pixels high and 12 wide at 2 m, before a wall that fills the frame."""
    frame = np.full((60, 80), 4000, np.uint16)
    frame[10:50, x : x + 12] = 2000
    return frame


STACK = np.stack([standing(2 * number) for number in range(7, 12)])


@pytest.fixture(autouse=True)
def network(monkeypatch: pytest.MonkeyPatch, prepared: list[Rig]) -> Iterator[None]:
    places, card = Places(axis=0, step=5), {"network": "places", "seed": 3, "rig": SMALL.to_json()}
    monkeypatch.setattr(
        runtimes,
        "load_network",
        lambda run, dense=False: load_network(run) if run else Trained(places, card),
    )
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def sent(*broken: int) -> list[Message]:
    """The walk as messages; the numbers of those in `broken` contradict themselves."""
    matrix = np.array([100.0, 0, 39.5, 0, 100, 29.5, 0, 0, 1])
    images = [
        image(frame, "16UC1", 5 + number / 10, **({"height": 61} if number in broken else {}))
        for number, frame in enumerate(STACK)
    ]
    return [camera_info((60, 80), k=matrix), *images]


def run(*words: str | Path) -> int:
    return cli.main(["segment", *map(str, words), "--keep-things"])


def refused(capsys: pytest.CaptureFixture[str], *words: str | Path) -> str:
    assert run(*words) == 2
    return capsys.readouterr().err.splitlines()[-1]


def report(out: Path) -> dict[str, Any]:
    parsed: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return parsed


def labels(out: Path, name: str) -> NDArray[Any]:
    with Image.open(out / "labels" / f"{name}.png") as picture:
        return np.asarray(picture).copy()


@pytest.mark.usefixtures("near_is_person")
def test_a_bag_is_labelled_by_its_own_camera_and_times(tmp_path: Path) -> None:
    bag, out = write_ros1(tmp_path / "walk.bag", sent()), tmp_path / "out"
    assert run(bag, "--out", out) == 0
    facts = report(out)
    assert [frame["name"] for frame in facts["each"]] == ["0000", "0001", "0002", "0003", "0004"]
    assert [frame["time_s"] for frame in facts["each"]] == pytest.approx([1.1, 1.2, 1.3, 1.4, 1.5])
    assert facts["each"][0]["camera"]["focal_px"] == 100 and facts["unit_m"] == 0.001 and facts["skipped"] == []
    for number, frame in enumerate(STACK):
        np.testing.assert_array_equal(labels(out, f"{number:04d}") != BACKGROUND, frame == 2000)
    assert run(bag, "--topic", DEPTH, "--out", out) == 0, "the same frames may be labelled anew"


def test_labels_go_out_with_the_stamps_of_their_frames(tmp_path: Path) -> None:
    bag, out, path = write_mcap(tmp_path / "a.mcap", sent()), tmp_path / "out", tmp_path / "labels.mcap"
    assert run(bag, "--out", out, "--labels-out", path) == 0
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        (legend,) = reader.iter_metadata()
        messages = list(reader.iter_messages())
    assert legend.metadata["map"] == "parts33" and legend.metadata["255"] == "no label"
    assert len(messages) == 5
    for number, (schema, channel, message) in enumerate(messages):
        assert schema is not None and schema.name == "sensor_msgs/msg/Image" and channel.topic == "/bodyseg/labels"
        found: Any = typestore("cdr").deserialize_cdr(message.data, schema.name)
        assert (found.header.stamp.sec, found.header.stamp.nanosec) == (5, number * 10**8)
        assert found.header.frame_id == "optical" and found.encoding == "mono8"
        assert message.log_time == pytest.approx(1.1e9 + number * 1e8, abs=300)
        np.testing.assert_array_equal(found.data.reshape(60, 80), labels(out, f"{number:04d}"))
    assert not list(tmp_path.glob(".*"))


def test_points_go_out_beside_labels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Read as subscribers read a PointCloud2: each field from its own offset."""
    np.save(tmp_path / "a.npy", STACK)
    words = (tmp_path / "a.npy", "--focal", "100", "--out", tmp_path / "out", "--points")
    assert "--points are written beside labels: give --labels-out, too" in refused(capsys, *words)
    path = tmp_path / "labels.mcap"
    assert run(*words[:-1], "--labels-out", path) == run(*words, "--labels-out", path) == 0, "labels replace labels"
    with path.open("rb") as file:
        messages = list(make_reader(file, validate_crcs=True).iter_messages(topics="/bodyseg/points"))
    assert len(messages) == 5
    for number, (schema, _, message) in enumerate(messages):
        assert schema is not None and schema.name == "sensor_msgs/msg/PointCloud2"
        cloud: Any = typestore("cdr").deserialize_cdr(message.data, schema.name)
        body = labels(tmp_path / "out", f"{number:04d}") != BACKGROUND
        assert cloud.width == body.sum() and cloud.is_dense and not cloud.is_bigendian
        rows = cloud.data.reshape(cloud.width, cloud.point_step)
        at = {each.name: (each.offset, each.datatype, each.count) for each in cloud.fields}
        assert [*at] == ["x", "y", "z", "label", "person", "confidence"] and at["z"] == (8, 7, 1)
        np.testing.assert_allclose(rows[:, 8:12].copy().view("<f4").ravel(), 2)
        named = labels(tmp_path / "out", f"{number:04d}")[body]
        np.testing.assert_array_equal(rows[:, at["label"][0]], named)
        assert (rows[:, 14:16].copy().view("<u2") == 1).all() and at["person"] == (14, 4, 1)


def test_labels_go_out_with_times_of_their_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "a.npy", STACK)
    words = (tmp_path / "a.npy", "--focal", "100", "--fps", "4", "--out", tmp_path / "out", "--labels-out")
    part_beside(tmp_path / "points.mcap").touch()  # as a killed call leaves it
    assert run(*words, tmp_path / "points.mcap", "--points") == 0
    with (tmp_path / "points.mcap").open("rb") as file:
        found = [(channel.topic, message.log_time) for _, channel, message in make_reader(file).iter_messages()]
    times = [number * 250_000_000 for number in range(5)]
    for topic in ("/bodyseg/labels", "/bodyseg/points"):
        assert [time for name, time in found if name == topic] == times, "frames without times follow --fps"
    (tmp_path / "folder.mcap").mkdir()
    for name in ("labels.txt", "bag", "folder.mcap"):
        assert "labels are written into an .mcap file, found" in refused(capsys, *words, tmp_path / name)
    assert "--labels-out must lie outside --out" in refused(capsys, *words, tmp_path / "out" / "a.mcap")
    assert "No such file or directory" in refused(capsys, *words, tmp_path / "no" / "a.mcap")
    assert not list(tmp_path.glob(".*"))


def test_labels_never_replace_the_recording_that_they_are_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_mcap(tmp_path / "walk.mcap", sent())
    (folder := tmp_path / "bag").mkdir()
    (folder / "part.mcap").write_bytes(held := bag.read_bytes())
    (tmp_path / "link.mcap").symlink_to(bag)
    for given, path in ((bag, bag), (bag, tmp_path / "link.mcap"), (folder, folder / "part.mcap")):
        said = refused(capsys, given, "--out", tmp_path / "out", "--labels-out", path)
        assert said == f"bodyseg segment: --labels-out must lie outside --out and the frames, found {path}"
    words = ("--labels-out", bag, write_mcap(tmp_path / "run.mcap", sent()), "--out", tmp_path / "out")
    assert f"labels replace an earlier file of labels alone, found {bag}" in refused(capsys, *words), "of *.mcap"
    (tmp_path / "cut.mcap").write_bytes(held[:100])
    assert "must be a whole MCAP file" in refused(capsys, bag, "--labels-out", tmp_path / "cut.mcap", *words[-2:])
    assert bag.read_bytes() == (folder / "part.mcap").read_bytes() == held and not (tmp_path / "out").exists()


@pytest.mark.usefixtures("near_is_person")
def test_frames_that_cannot_be_read_are_skipped_within_a_budget(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, out = write_mcap(tmp_path / "a.mcap", sent(0, 3)), tmp_path / "out"
    words = (bag, "--out", out, "--labels-out", tmp_path / "labels.mcap")
    said = refused(capsys, *words)
    assert "frame 0: an image of 61 x 80" in said and not out.exists() and not (tmp_path / "labels.mcap").exists()
    said = refused(capsys, *words, "--skip-unreadable", "1")
    assert "frame 3: an image of" in said and said.endswith("after 1 that --skip-unreadable allowed")
    assert not (out / "summary.json").exists() and not list(tmp_path.glob("*labels.mcap*"))
    assert run(*words, "--skip-unreadable", "2") == 0
    said = capsys.readouterr().err
    assert "wrote 3 frames" in said and "2 frames could not be read: see skipped in summary.json" in said
    facts = report(out)
    assert [frame["name"] for frame in facts["skipped"]] == ["0000", "0003"]
    assert [frame["name"] for frame in facts["each"]] == ["0001", "0002", "0004"] and facts["frames"] == 3
    assert "cannot have" in facts["skipped"][0]["error"]
    np.testing.assert_array_equal(labels(out, "0004") != BACKGROUND, STACK[4] == 2000)
    assert "must be a whole number of at least 0, found -1" in refused(capsys, *words, "--skip-unreadable", "-1")
    broken = write_mcap(tmp_path / "b.mcap", sent(*range(5)))
    said = refused(capsys, broken, "--out", tmp_path / "b", "--skip-unreadable", "9")
    assert "at least one frame must be readable, found none" in said


@pytest.mark.usefixtures("near_is_person")
@pytest.mark.parametrize("in_a_folder", [False, True])
def test_a_recording_that_cannot_be_opened_is_skipped_like_a_frame(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], in_a_folder: bool
) -> None:
    (folder := tmp_path / "day").mkdir()
    bags = [write_mcap(folder / f"{name}.mcap", sent()) for name in "abc"]
    bags[1].write_bytes(bags[1].read_bytes()[:40])
    words = (*([folder] if in_a_folder else bags), "--out", tmp_path / "out", "--skip-unreadable")
    said = refused(capsys, *words, "0")
    assert f"{bags[1]} must be a whole MCAP file" in said and not (tmp_path / "out").exists()
    assert run(*words, "1") == 1
    captured = capsys.readouterr().err
    assert "wrote 10 frames" in captured and f"\nskipped {bags[1]}: must be a whole MCAP file" in captured
    facts = report(tmp_path / "out")
    assert [frame["file"] for frame in facts["skipped"]] == [str(bags[1])] and facts["frames"] == 10
    np.testing.assert_array_equal(labels(tmp_path / "out", facts["each"][-1]["name"]) != BACKGROUND, STACK[4] == 2000)
    words_of_export = [
        "export-labels",
        tmp_path / "out",
        "--out",
        tmp_path / "png",
        "--format",
        "png",
        "--frames",
    ]
    assert cli.main([*map(str, words_of_export), *map(str, words[:-3])]) == 0
    bags[2].write_bytes(b"")
    said = refused(capsys, *words, "1")
    assert f"{bags[2]}: " in said and said.endswith(", after 1 that --skip-unreadable allowed")
    assert "No such file" in refused(capsys, tmp_path / "absent.mcap", *words, "9")


def test_a_missing_package_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = write_ros1(tmp_path / "a.bag", sent())
    np.save(tmp_path / "a.npy", STACK)
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    said = refused(capsys, bag, "--out", tmp_path / "out")
    assert "reading and writing bags needs the package 'rosbags': pip install 'bodyseg[recordings]'" in said
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    words = (tmp_path / "a.npy", "--focal", "100", "--out", tmp_path / "out", "--labels-out", tmp_path / "a.mcap")
    assert "pip install 'bodyseg[recordings]'" in refused(capsys, *words)
    assert not (tmp_path / "out").exists()


def test_a_sensor_is_fitted_to_a_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = write_mcap(tmp_path / "a.mcap", sent(1))
    words = ["sensor", "fit", str(bag), "--nearer-than", "3", "--json"]
    assert cli.main(words) == 2
    assert "frame 1: an image of" in capsys.readouterr().err
    assert cli.main([*words, "--skip-unreadable", "1"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out)["frames"] == 4 and "assumed" not in captured.err
    assert f"skipped {bag}: {DEPTH}, frame 1: an image of" in captured.err
    (cut := tmp_path / "cut.mcap").write_bytes(bag.read_bytes()[:40])
    assert cli.main([*words[:2], str(cut), *words[2:], "--skip-unreadable", "2"]) == 0
    assert f"skipped {cut}: must be a whole MCAP file" in capsys.readouterr().err
    np.save(tmp_path / "c.npy", STACK.astype(np.float32) / 1000)
    assert cli.main(["sensor", "fit", str(tmp_path / "c.npy"), str(bag), "--focal", "100", "--nearer-than", "3"]) == 2
    assert "frames must have one unit, found 0.00025 and 0.001 m a step" in capsys.readouterr().err
