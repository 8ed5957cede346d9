"""Files for the viewer Rerun, whose package a stub stands in for."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from fake_rerun import FakeRerun, FakeStream
from label_networks import Places
from pngs import png
from small_rig import SMALL

from bodyseg_data.artifacts.variants import VARIANTS
from bodyseg_data.core.errors import BadConfig, MissingLibrary
from bodyseg_data.core.labels.label_map import PARTS33
from bodyseg_data.core.rig import Camera
from bodyseg_data.drawing.contact_sheet import span_of
from bodyseg_model.commands.cli import main
from bodyseg_model.networks.checkpoints import Trained
from bodyseg_model.recordings.camera_files import FrameCameras
from bodyseg_model.recordings.cameras import FrameCamera
from bodyseg_model.recordings.live import LiveRecording
from bodyseg_model.segmentation.foreground import Background
from bodyseg_model.segmentation.segmenter import Segmenters
from bodyseg_model.viewing.pictures import KIND_LEGEND
from bodyseg_model.viewing.recording_view import FLICKER_LEGEND, RecordingView
from bodyseg_model.viewing.rerun_file import write_recording, write_set
from bodyseg_model.viewing.set_view import SetView, Shown

CAMERA = Camera(60, 80, 90.0, (40.0, 30.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


@pytest.fixture
def sdk(monkeypatch: pytest.MonkeyPatch) -> FakeRerun:
    fake = FakeRerun()
    monkeypatch.setitem(sys.modules, "rerun", fake)
    monkeypatch.setitem(sys.modules, "rerun.blueprint", fake.blueprint)
    return fake


def contexts(stream: FakeStream) -> dict[str, list[tuple[int, str, tuple[int, ...]]]]:
    """Entity -> classes, of all contexts."""
    return {entity: things[0].parts[0] for entity, _, things, _ in stream.logged if things[0].kind.startswith("Ann")}


def test_samples_have_the_images_of_the_page(small_set: Path, tmp_path: Path, sdk: FakeRerun) -> None:
    view = SetView(small_set, Trained(Places(0, 5), {"rig": SMALL.to_json()}), split="train")
    done: list[tuple[int, int]] = []
    path = tmp_path / "set.rrd"
    assert write_set(path, view, Shown(variant="noise"), 2, lambda *numbers: done.append(numbers)) == 2
    assert done == [(1, 2), (2, 2)] and [file.name for file in tmp_path.iterdir()] == ["set.rrd"]
    (stream,) = sdk.streams
    numbers = [0, len(view) - 1]
    assert sorted({times["sample"] for _, times, _, static in stream.logged if not static}) == numbers
    for place, number in enumerate(numbers):
        found = view.images_of(Shown(number, "noise"))
        layers = found.layers
        points = stream.of("world/points")[place]
        np.testing.assert_array_equal(points.facts["class_ids"], layers.labels[layers.range > 0])
        np.testing.assert_array_equal(points.parts[0], view.points_of(found, "parts").xyz)
        np.testing.assert_array_equal(stream.of("images/range")[place].parts[0], found.sample.range)
        np.testing.assert_array_equal(stream.of("images/projector")[place].parts[0], found.sample.occluder_range())
        for entity, image in (("labels", layers.labels), ("answer", layers.answer), ("mistakes", layers.kinds)):
            np.testing.assert_array_equal(stream.of(f"images/{entity}")[place].parts[0], image)
        for name in VARIANTS:
            image = stream.of(f"variants/{name}")[place]
            np.testing.assert_array_equal(image.parts[0], found.variants[name].range)
            assert image.facts["meter"] == pytest.approx(1 / view.rig.range_step_m)
        confidence = stream.of("images/confidence")[place].parts[0]
        assert (confidence[layers.range == 0] == 0).all() and (confidence[layers.range > 0] > 100).all()
        assert stream.of("facts")[place].parts[0].splitlines()[0] == found.sample.key
        (transform, lens) = [things for name, _, things, _ in stream.logged if name == "world/projector"][place]
        assert transform.facts["translation"] == pytest.approx(found.placed[1].position)
        assert lens.facts["resolution"] == (view.rig.camera.columns, view.rig.camera.rows)
    assert [name for _, name, _ in contexts(stream)["images/mistakes"]][:-1] == [name for name, _ in KIND_LEGEND]
    assert contexts(stream)["world"][3][1] == PARTS33.names[3] and contexts(stream)["world"][-1][0] == 255


def test_without_a_network_there_is_no_answer(small_set: Path, tmp_path: Path, sdk: FakeRerun) -> None:
    write_set(tmp_path / "set.rrd", SetView(small_set), Shown(), 1, lambda *numbers: None)
    entities = {entity for entity, _, _, static in sdk.streams[0].logged if not static}
    assert "images/labels" in entities and not entities & {"images/answer", "images/mistakes", "images/confidence"}


def board(left: int) -> np.ndarray:
    """A board at 1.5 m, from column `left` to 40, before a wall at 8 m, beyond the limit of bodies."""
    image = np.full((60, 80), 8000, np.uint16)
    image[10:50, left:40] = 1500
    return image


def recording(*arrays: np.ndarray) -> RecordingView:
    """Frames half a second apart, from second 100 on."""
    frames = list(LiveRecording([(100 + number / 2, pixels) for number, pixels in enumerate(arrays)]))
    cameras = FrameCameras(frames, [None] * len(frames), lambda shape, where: FrameCamera(CAMERA, "given"))
    trained = Trained(Places(1, 8), {"rig": SMALL.to_json()})
    return RecordingView(frames, cameras, Segmenters(trained, Background("limits")), PARTS33)


def test_frames_stand_at_their_times(tmp_path: Path, sdk: FakeRerun) -> None:
    view = recording(board(10), board(0))
    assert write_recording(tmp_path / "a.rrd", view, 9, lambda *numbers: None) == (2, [])
    (stream,) = sdk.streams
    assert {tuple(times.items()) for _, times, _, static in stream.logged if not static} == {
        (("frame", 0), ("time", 0.0)),
        (("frame", 1), ("time", 0.5)),
    }
    first, second = (view.labelled(number) for number in (0, 1))
    np.testing.assert_array_equal(stream.of("images/labels")[1].parts[0], second.segmentation.labels)
    np.testing.assert_array_equal(stream.of("images/range")[0].parts[0], first.range_m)
    facts = stream.of("images/range")[0].facts
    assert facts["meter"] == 1 and facts["depth_range"] == pytest.approx((1.5, 8.0))
    bodies, room = stream.of("world/bodies")[0], stream.of("world/room")[0]
    assert len(bodies.parts[0]) == 40 * 30 and room.facts["class_ids"] is None and len(room.parts[0]) > 100
    assert (stream.of("images/flicker")[1].parts[0] == 2).any()
    assert [len(stream.of(f"curves/{name}")) for name in ("flicker", "confidence", "milliseconds")] == [1, 2, 2]
    changed = (first.segmentation.labels != second.segmentation.labels)[10:50, 10:40].mean()
    assert stream.of("curves/flicker")[0].parts[0] == pytest.approx(changed, abs=1e-5)
    assert contexts(stream)["images/flicker"][1][1] == FLICKER_LEGEND[1][0]


def test_frames_that_cannot_be_read_are_left_out_and_told(tmp_path: Path, sdk: FakeRerun) -> None:
    view = recording(board(10), np.zeros((30, 40), np.uint16), board(0))
    written, faults = write_recording(tmp_path / "a.rrd", view, 3, lambda *numbers: None)
    assert written == 2 and len(faults) == 1 and "60 x 80" in faults[0]
    assert not sdk.streams[0].of("curves/flicker")  # the frame before cannot be read
    with pytest.raises(BadConfig, match="no frame could be read; the first: .*60 x 80"):
        write_recording(tmp_path / "b.rrd", recording(np.zeros((30, 40), np.uint16)), 1, lambda *numbers: None)
    assert [file.name for file in tmp_path.iterdir()] == ["a.rrd"]


def test_a_file_that_cannot_be_written_is_one_line(
    tmp_path: Path, sdk: FakeRerun, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(BadConfig, match=r"cannot write .*none/a.rrd: "):
        write_recording(tmp_path / "none" / "a.rrd", recording(board(10)), 1, lambda *numbers: None)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingLibrary, match="--rrd needs the package 'rerun-sdk': pip install rerun-sdk"):
        write_recording(tmp_path / "a.rrd", recording(board(10)), 1, lambda *numbers: None)


def test_spans() -> None:
    assert span_of(np.array([[0, 4, 9]], np.uint16)) == (4.0, 9.0) and span_of(np.zeros((2, 2))) == (0.0, 1.0)


def test_the_command_writes_the_file(tmp_path: Path, sdk: FakeRerun, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "1.png").write_bytes(png(np.where(board(10) == 1500, board(10), np.uint16(0))))
    words = ["view", str(tmp_path), "--focal", "90", "--background", "keep"]
    assert main([*words, "--rrd", str(tmp_path / "a.rrd")]) == 0
    assert f"wrote 1 of 1 frames to {tmp_path / 'a.rrd'}: open it with `rerun" in capsys.readouterr().err
    for more, said in (
        (["--rrd", str(tmp_path / "a.rrd"), "--port", "1"], "--port is for the page, found it with --rrd"),
        (["--count", "3"], "--count is the number of samples or frames in a file: give --rrd with it"),
        (["--rrd", str(tmp_path / "a.rrd"), "--count", "0"], "--count must be"),
        (["--rrd", str(tmp_path / "none" / "a.rrd")], "--rrd needs a file in a folder that is there, found"),
    ):
        assert main([*words, *more]) == 2
        assert said in capsys.readouterr().err
