"""Frames of cameras that are mounted turned: labelled as upright ones, labels where the frame has its pixels."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from label_networks import Places
from numpy.typing import NDArray
from pngs import pixels, png
from small_rig import SMALL

from bodyseg_data import RangeImages, example_set
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import PARTS33
from bodyseg_data.rigs import Camera, Distortion
from bodyseg_model import runtimes
from bodyseg_model.commands import main
from bodyseg_model.networks import Trained, load_network
from bodyseg_model.recordings import find_frames, to_metres
from bodyseg_model.segmentation import Background, FrameLabeller, Segmentation, Segmenter
from bodyseg_model.sensor_fit import read_recording

UPRIGHT = Camera(60, 80, 100.0, (37.0, 31.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
TURNS = (1, 2, 3)


pytestmark = pytest.mark.usefixtures("one_thread", "near_is_person", "prepared")


def as_mounted(quarters: int, camera: Camera = UPRIGHT) -> Camera:
    """The camera, mounted turned clockwise by so many right angles: its images then are turned counter-clockwise."""
    return camera.turned(-quarters)


def seen_by(quarters: int, frame: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.ascontiguousarray(np.rot90(frame, quarters))


def standing() -> NDArray[np.float32]:
    """Two blocks of different sizes before a wall."""
    frame = np.full((60, 80), 4.0, np.float32)
    frame[10:52, 30:42] = 2.0
    frame[20:50, 60:70] = 2.2
    return frame


def labeller(turned: int | str | None = None, video: bool = False, mirrored: bool = False) -> FrameLabeller:
    trained = Trained(Places(0, 5), {"rig": SMALL.to_json()})
    return FrameLabeller(trained, video=video, mirrored=mirrored, turned=turned)  # type: ignore[arg-type]


def check_same(found: Segmentation, upright: Segmentation, quarters: int) -> None:
    np.testing.assert_array_equal(np.rot90(found.labels, -quarters), upright.labels)
    np.testing.assert_array_equal(np.rot90(found.confidence, -quarters), upright.confidence)
    assert len(found.bodies) == len(upright.bodies) == 2
    for body, other in zip(found.bodies, upright.bodies, strict=True):
        assert (np.diff(body.pixels) > 0).all() and body.median_range_m == other.median_range_m


def test_degrees_are_no_quarters() -> None:
    """Modulo 4, 90 and 270 would be upside down, and 180 upright."""
    for degrees in (90, 180, 270, -1):
        with pytest.raises(BadConfig, match=f"^quarters must be one of 0, 1, 2, 3, found {degrees}$"):
            Segmenter(Places(0, 5), UPRIGHT, Background("keep"), quarters=degrees)


@pytest.mark.parametrize("quarters", TURNS)
@pytest.mark.parametrize("video", [False, True])
def test_a_turned_frame_gets_the_labels_of_the_upright_one(quarters: int, video: bool) -> None:
    label, upright = labeller(90 * quarters, video), labeller(video=video)
    camera = replace(as_mounted(quarters), roll_deg=0.0)  # a camera that does not say
    for _ in range(2):
        found = label(seen_by(quarters, standing()), camera)
        check_same(found, upright(standing(), UPRIGHT), quarters)
        np.testing.assert_array_equal(found.range_m, seen_by(quarters, standing()))
        assert found.camera == camera


@pytest.mark.parametrize("quarters", TURNS)
def test_a_rigs_roll_is_obeyed(quarters: int) -> None:
    camera = as_mounted(quarters)
    assert camera.roll_deg % 360 == 90 * quarters
    check_same(labeller()(seen_by(quarters, standing()), camera), labeller()(standing(), UPRIGHT), quarters)
    for each in labeller().stream([seen_by(quarters, standing())], camera):
        check_same(each, labeller()(standing(), UPRIGHT), quarters)
    # A driver that shows left for right turns heads to the other side.
    assert labeller(mirrored=True).quarters(camera) == -quarters % 4
    assert labeller(90, mirrored=True).quarters(camera) == 1, "as frames show it"
    tilted = replace(UPRIGHT, roll_deg=40.0)
    check_same(labeller()(standing(), tilted), labeller()(standing(), UPRIGHT), 0)
    check_same(labeller(0)(standing(), replace(UPRIGHT, roll_deg=180.0)), labeller()(standing(), UPRIGHT), 0)


@pytest.mark.parametrize("quarters", [0, *TURNS])
def test_a_camera_is_turned_with_its_images(quarters: int) -> None:
    bent = replace(UPRIGHT, distortion=Distortion(0.1, -0.02, 0.01, -0.03, 0.004))
    turned = bent.turned(quarters)
    assert bent.turned(quarters).turned(-quarters) == bent and turned.distortion is not None
    assert bent.distortion is not None
    for camera, other in ((bent, turned), (replace(bent, distortion=None), replace(turned, distortion=None))):
        images = []
        for each in (camera, other):
            x, y, _ = np.moveaxis(each.pixel_rays(), -1, 0)
            if each.distortion is not None:
                x, y = each.distortion.apply(x, y)
            images.append((x * each.focal_px + each.centre_px[0], y * each.focal_px + each.centre_px[1]))
        across, down = (np.rot90(image, -quarters) for image in images[0])
        for _ in range(quarters):
            across, down = camera.rows - down, across
            camera = camera.turned(1)
        np.testing.assert_allclose(images[1][0], across, atol=1e-9)
        np.testing.assert_allclose(images[1][1], down, atol=1e-9)


def test_another_turn_is_refused() -> None:
    for turned in (45, "left", -90):
        with pytest.raises(BadConfig, match=r"^turned must be one of 0, 90, 180, 270, auto, found "):
            labeller(turned)


def room(index: int, variant: str) -> NDArray[np.uint16]:
    """A person of the example set before a wall, millimetres."""
    images = RangeImages(example_set(), variant=variant, split="test")  # type: ignore[arg-type]
    metres = images[index]["range"][0].numpy()
    return np.rint(1000 * np.where(metres > 0, metres, 4.0)).astype(np.uint16)


def test_a_persons_labels_come_back_and_auto_finds_the_turn(tmp_path: Path) -> None:
    """By the network that ships, through the command, on frames with all artifacts and without."""
    frames = {"clean": room(3, "none"), "hard": room(9, "all")}
    rows, columns = frames["clean"].shape
    expected: dict[str, NDArray[np.uint8]] = {}
    for quarters, names in ((0, ("clean", "hard")), (2, ("hard",)), (3, ("clean",))):
        folder, out = tmp_path / f"frames{quarters}", tmp_path / f"out{quarters}"
        folder.mkdir()
        seen = {name: frames[name] for name in names}
        for name, frame in seen.items():
            (folder / f"{name}.png").write_bytes(png(np.ascontiguousarray(np.rot90(frame, quarters))))
        words = ["--focal", "757.5757", "--turned", "auto", "--no-overlay", "--threads", "1", "--device", "cpu"]
        assert main(["segment", str(folder), *words, "--out", str(out)]) == 0
        assert json.loads((out / "summary.json").read_text())["camera"].get("turned_deg", 0) == 90 * quarters
        for name in seen:
            labels = np.rot90(pixels(out / "labels" / f"{name}.png"), -quarters)
            first = expected.setdefault(name, labels)
            body = first < 255
            assert body.sum() > 5000 and (labels == first)[body].mean() >= 0.98
    assert (rows, columns) == expected["clean"].shape


def test_auto_takes_no_thing_for_a_person_and_is_for_recordings(tmp_path: Path) -> None:
    """Blocks, of which the network is not sure, tell nothing."""
    unsure = Trained(Places(0, 5, sure_m=0.5), {"rig": SMALL.to_json()})
    label = FrameLabeller(unsure, keep_things=True, turned="auto", device="cpu")
    (tmp_path / "a.png").write_bytes(png(np.rint(1000 * standing()).astype(np.uint16)))
    opened = label.recording(tmp_path / "a.png", focal_px=UPRIGHT.focal_px)
    assert opened.label(0).bodies and opened.turned_deg == 0
    for labelled in (lambda: label(standing(), UPRIGHT), lambda: list(label.stream([standing()], UPRIGHT))):
        with pytest.raises(BadConfig, match=r"^turned 'auto' is for recordings: other frames need their turn, like"):
            labelled()


class Upright(Places):
    """Sure of bodies whose upper half is nearer, unsure of all others."""

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        found = super().scores(range_m)
        rows = torch.arange(range_m.shape[2])[:, None].expand(range_m.shape[2:])
        for image, answer in zip(range_m[:, 0], found, strict=True):
            seen, middle = image > 0, rows[image > 0].float().median()
            if not image[seen & (rows < middle)].mean() < image[seen & (rows > middle)].mean() - 0.1:
                answer.clamp_(max=3.5657)  # 52 %
        return found


def sure_upright(turned: str | None = "auto") -> FrameLabeller:
    """By a network that tells the turn as the one that ships does, in a hundredth of its time."""
    return FrameLabeller(Trained(Upright(0, 5), {"rig": SMALL.to_json()}), turned=turned, device="cpu")  # type: ignore[arg-type]


def leaning() -> NDArray[np.uint16]:
    """A block whose upper end is nearer, before a wall, millimetres."""
    frame = np.full((60, 80), 4000, np.uint16)
    frame[10:52, 30:42] = np.linspace(2000, 2500, 42, dtype=np.uint16)[:, None]
    return frame


def test_auto_finds_the_turn_where_people_come_late(tmp_path: Path) -> None:
    late = np.rot90(leaning()).copy()
    frames = np.stack([np.full_like(late, 4000)] * 48 + [late] * 3)
    np.save(tmp_path / "a.npy", frames)
    opened = sure_upright().recording(tmp_path / "a.npy", focal_px=as_mounted(1).focal_px)
    assert opened.turned_deg == 90 and all(len(opened.label(number).bodies) == 1 for number in range(48, 51))


def test_each_recording_has_a_turn_of_its_own(tmp_path: Path) -> None:
    label = sure_upright()
    frames = {quarters: np.ascontiguousarray(np.rot90(leaning(), quarters)) for quarters in (0, 2)}
    opened = {}
    for quarters, frame in frames.items():
        (tmp_path / f"{quarters}.png").write_bytes(png(frame))
        opened[quarters] = label.recording(tmp_path / f"{quarters}.png", focal_px=UPRIGHT.focal_px)
    (upright,) = list(opened[0])
    (turned,) = list(opened[2])
    assert [each.turned_deg for each in opened.values()] == [0, 180]
    same_rows(np.rot90(turned.labels, 2), upright.labels)


def same_rows(labels: NDArray[np.uint8], others: NDArray[np.uint8]) -> None:
    """Labels are steps from the top of a view, which may begin a pixel higher."""
    body = others < 255
    assert body.sum() > 400 and ((labels < 255) == body).all() and len(np.unique(others[body])) > 8
    assert np.abs(labels[body].astype(int) - others[body]).max() <= 1


def test_a_turned_recording_is_told_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    trained = Trained(Upright(0, 5), {"rig": SMALL.to_json()})
    monkeypatch.setattr(runtimes, "load_network", lambda run, dense=False: load_network(run) if run else trained)
    for name, quarters in (("upright", 0), ("mounted", 3)):
        (tmp_path / f"{name}.png").write_bytes(png(np.ascontiguousarray(np.rot90(leaning(), quarters))))
        words = ["--focal", "100", "--no-overlay", "--threads", "1", "--device", "cpu"]
        assert main(["segment", str(tmp_path / f"{name}.png"), *words, "--out", str(tmp_path / name)]) == 0
        assert ("give --turned 270 if they are" in capsys.readouterr().err) == (name == "mounted")


def test_sensor_fit_seeks_bodies_upright(tmp_path: Path) -> None:
    frame = (1000 * standing()).astype(np.uint16)
    masks = []
    for quarters in (0, *TURNS):
        (tmp_path / f"{quarters}.png").write_bytes(png(np.ascontiguousarray(np.rot90(frame, quarters))))
        files = find_frames([tmp_path / f"{quarters}.png"])
        (found,) = read_recording(files, as_mounted(quarters), Background(), None, quarters=quarters).frames
        np.testing.assert_array_equal(found.range_m, to_metres(np.rot90(frame, quarters), 1e-3))
        masks.append(np.rot90(found.body, -quarters))
    for mask in masks:
        np.testing.assert_array_equal(mask, (frame < 4000))


def test_the_network_that_ships_may_be_given() -> None:
    assert FrameLabeller(load_network(), turned=180).quarters(UPRIGHT) == 2


class OneEnd(Places):
    """Sure of bodies whose nearer half is above, unsure of those that lean away, as people do who lie."""

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        found = super().scores(range_m)
        rows = torch.arange(range_m.shape[2])[:, None].expand(range_m.shape[2:])
        for image, answer in zip(range_m[:, 0], found, strict=True):
            seen, middle = image > 0, rows[image > 0].float().median()
            above, below = image[seen & (rows < middle)], image[seen & (rows > middle)]
            if above.numel() and below.numel() and above.mean() > below.mean():
                answer.clamp_(max=3.5657)  # 52 %
        return found


def test_a_person_of_whom_the_network_is_sure_upside_down_is_labelled_so() -> None:
    frame = np.zeros((60, 80), np.float32)
    frame[10:52, 30:42] = np.linspace(2.0, 2.5, 42, dtype=np.float32)[:, None]  # nearer above
    flipped = np.ascontiguousarray(np.rot90(frame, 2))
    centred = replace(UPRIGHT, centre_px=(40.0, 30.0))

    def segmenter(either_way: bool = True) -> Segmenter:
        return Segmenter(OneEnd(0, 5), centred, Background("keep"), rig=SMALL, either_way=either_way)

    usual, turned, left = segmenter()(frame), segmenter()(flipped), segmenter(either_way=False)(flipped)
    assert usual.bodies[0].mean_confidence > 0.99 and left.bodies[0].mean_confidence < 0.6
    shown = frame > 0
    back, unturned = (np.rot90(found.labels, 2)[shown].astype(int) for found in (turned, left))
    assert np.abs(back - usual.labels[shown]).max() <= 1  # a row more or less: views begin at whole pixels
    assert np.abs(unturned - usual.labels[shown]).max() > 5
    assert turned.bodies[0].mean_confidence > 0.99
    sure, unsure = segmenter(), segmenter(either_way=False)
    np.testing.assert_array_equal(sure(frame).labels, unsure(frame).labels)
    assert len(sure._network.seen) == 1  # who is seen well is looked at once


@pytest.mark.parametrize(
    ("above_m", "columns", "name", "looks"),
    [
        (3.5, 12, "parts33", 2),
        (3.1, 12, "parts33", 1),
        (3.5, 12, "own", 1),
        (3.0, 44, "parts33", 1),
        (3.0, 60, "parts33", 2),
        (3.0, 60, "own", 1),
    ],
)
def test_only_parts_of_bodies_that_may_lie_are_looked_at_twice(
    above_m: float, columns: int, name: str, looks: int
) -> None:
    frame = np.zeros((60, 80), np.float32)
    frame[10:52, 40 - columns // 2 : 40 + columns // 2] = np.linspace(above_m, 3.0, 42, dtype=np.float32)[:, None]
    label_map = PARTS33 if name == "parts33" else replace(PARTS33, name=name)
    network = Places(0, 5, sure_m=0.5)
    Segmenter(network, UPRIGHT, Background("keep"), rig=SMALL, label_map=label_map)(frame)
    assert len(network.seen) == looks
