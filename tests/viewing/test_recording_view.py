"""What a recording's page draws: frames, labels, confidence and flicker."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from label_networks import Places
from pngs import png
from small_rig import SMALL

from bodyseg_data.core import BadConfig
from bodyseg_data.labels.label_map import COLOURS
from bodyseg_data.rigs import Camera, Rig
from bodyseg_model.networks import Trained
from bodyseg_model.recordings import find_frames
from bodyseg_model.segmentation import Background, FrameLabeller, LabelledFrame
from bodyseg_model.viewing import RecordingView
from bodyseg_model.viewing.pictures import legible
from bodyseg_model.viewing.recording_view import CONFIDENCE_LEGEND, FLICKER_LEGEND, ShownFrame, body_range, changes_of

CAMERA = Camera(60, 80, 90.0, (40.0, 30.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def frame(column: int, wall: bool = True) -> np.ndarray:
    """A board 20 pixels wide at 1.5 m, before a wall at 8 m, which is beyond the limit of bodies."""
    image = np.full((60, 80), 8000 if wall else 0, np.uint16)
    image[10:50, column : column + 20] = 1500
    return image


def view_of(folder: Path, *images: np.ndarray) -> RecordingView:
    for number, image in enumerate(images):
        (folder / f"{number}.png").write_bytes(png(image))
    frames = find_frames([folder])
    trained = Trained(Places(1, 8), {"rig": SMALL.to_json()})
    return RecordingView(FrameLabeller(trained, Background("limits")).recording(frames, focal_px=90.0))


def test_bodies_have_the_colours_of_their_labels_and_the_room_is_thinner(tmp_path: Path) -> None:
    view = view_of(tmp_path, frame(10))
    first = view.labelled(0)
    drawing = view.draw(ShownFrame())
    body = np.isclose(first.range_m, 1.5)
    np.testing.assert_array_equal(body_range(first), np.where(body, first.range_m, 0))
    assert drawing.bodies == 20 * 40
    np.testing.assert_array_equal(drawing.points.colours[:800], legible(COLOURS)[first.labels[body]])
    np.testing.assert_allclose(drawing.points.xyz[:800, 2], -1.5, atol=1e-6)
    assert len(drawing.points.xyz) - 800 == np.count_nonzero(~body[::3, ::3])
    assert len(view.draw(ShownFrame(room=False)).points.xyz) == 800
    assert drawing.gap_m == pytest.approx(1.5 / 90)


def test_frames_that_are_labelled_whole_have_no_people(tmp_path: Path) -> None:
    frames = view_of(tmp_path, frame(10)).recording.frames
    labeller = FrameLabeller(Trained(Places(1, 8), {"rig": SMALL.to_json()}), Background("frame"))
    drawing = RecordingView(labeller.recording(frames, focal_px=90.0)).draw(ShownFrame())
    assert drawing.facts[1] == "frame 0, 1 in all: labelled whole"


def test_mirrored_frames_show_the_world_as_it_is(tmp_path: Path) -> None:
    plain = view_of(tmp_path, frame(10))
    mirrored = FrameLabeller(Trained(Places(1, 8), {"rig": SMALL.to_json()}), Background("limits"), mirrored=True)
    view = RecordingView(mirrored.recording(plain.recording.frames, focal_px=90.0))
    drawn, points = view.draw(ShownFrame()).points.xyz, view.labelled(0).points()
    np.testing.assert_allclose(drawn, plain.draw(ShownFrame()).points.xyz * [-1, 1, 1], atol=1e-6)
    np.testing.assert_allclose(drawn[:800, 0], points["x"], atol=1e-6)


def test_confidence_and_its_legend(tmp_path: Path) -> None:
    drawing = view_of(tmp_path, frame(10)).draw(ShownFrame(colouring="confidence", room=False))
    assert drawing.legend == CONFIDENCE_LEGEND
    assert any(fact.startswith("mean confidence") for fact in drawing.facts)
    green = CONFIDENCE_LEGEND[2][1]
    assert np.abs(drawing.points.colours.astype(int) - green).max() < 20


def test_a_frame_after_one_that_cannot_be_read_is_shown(tmp_path: Path) -> None:
    view = view_of(tmp_path, frame(10), np.zeros((8, 8), np.uint16), frame(10))
    with pytest.raises(BadConfig, match="a frame must have the camera's size"):
        view.draw(ShownFrame(number=1))
    assert view.draw(ShownFrame(number=2)).bodies == 800
    assert view.before(2) is None


def labelled(labels: list[int], range_m: list[float]) -> LabelledFrame:
    """A frame of one row."""
    return LabelledFrame(
        labels=np.array([labels], np.uint8),
        bodies=(),
        milliseconds={},
        number=0,
        range_m=np.array([range_m], np.float32),
        camera=CAMERA,
    )


def test_changes_are_told_from_movement() -> None:
    frame = labelled([1, 2, 2, 2, 255], [1.0, 1.0, 1.0, 1.0, 0.0])
    before = labelled([1, 1, 1, 255, 4], [1.5, 1.5, 1.01, 1.0, 1.0])
    assert changes_of(frame, before).tolist() == [[0, 1, 2, 3, 255]]
    assert changes_of(frame, None).tolist() == [[3, 3, 3, 3, 255]]


def test_flicker_has_its_colours_and_its_share(tmp_path: Path) -> None:
    """Labels follow columns from the body's left edge, which is farther left in the second frame."""
    wider = frame(10)
    wider[10:50, 0:10] = 1500
    view = view_of(tmp_path, frame(10), wider)
    changes = changes_of(view.labelled(1), view.labelled(0))
    assert (changes[10:50, 0:10] == 3).all() and (changes == 2).any()
    drawing = view.draw(ShownFrame(1, "flicker", room=False))
    colours = np.array([colour for _, colour in FLICKER_LEGEND])
    np.testing.assert_array_equal(drawing.points.colours, colours[changes[changes != 255]])
    share = (changes == 2).sum() / (40 * 20)
    assert f"flicker {share:.1%}, where nothing moves {share:.1%}" in drawing.facts
    assert not any("flicker" in fact for fact in view.draw(ShownFrame(0)).facts)


def test_frames_of_other_recordings_are_not_the_frame_before(tmp_path: Path) -> None:
    frames = []
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "1.png").write_bytes(png(frame(10)))
        frames.append(tmp_path / name)
    view = view_of(tmp_path / "left", frame(10))
    view.recording.frames = find_frames(frames)
    assert not any("flicker" in fact for fact in view.draw(ShownFrame(2)).facts)


def test_confidence_and_flicker_are_drawn_of_bodies_alone_below_the_whole_frame(tmp_path: Path) -> None:
    """A body of 40 x 20 in a frame of 60 x 80 fills 420 of its rows below, less the margin; above it 280."""
    picture = view_of(tmp_path, frame(30)).draw(ShownFrame()).picture
    new = (picture == FLICKER_LEGEND[3][1]).all(-1)
    rows = np.flatnonzero(new.any(1))
    assert np.count_nonzero(new) == pytest.approx(40 * 20 * (420 / 46) ** 2, rel=0.05)
    assert rows[0] > 476, "below the frame"
    whole = view_of(tmp_path, np.full((60, 80), 1500, np.uint16)).draw(ShownFrame()).picture
    assert whole.shape[1] == picture.shape[1]


def test_the_first_frame_is_timed_without_what_is_loaded_before_it(tmp_path: Path, prepared: list[Rig]) -> None:
    view = view_of(tmp_path, frame(10), frame(12))
    view.draw(ShownFrame(1))
    assert len(prepared) == 1, "once a camera"


def test_frames_are_labelled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    view = view_of(tmp_path, frame(10), frame(12))
    view.draw(ShownFrame(1))
    for file in tmp_path.iterdir():
        file.unlink()
    view.draw(ShownFrame(1, "flicker"))


def test_nobody_is_drawn_as_such(tmp_path: Path) -> None:
    view = view_of(tmp_path, np.full((60, 80), 8000, np.uint16), np.zeros((60, 80), np.uint16))
    assert view.draw(ShownFrame(0)).bodies == 0
    empty = view.draw(ShownFrame(1))
    assert len(empty.points.xyz) == 0 and "0 people, 0 things" in empty.facts[1]
