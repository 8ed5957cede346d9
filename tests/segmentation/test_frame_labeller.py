"""From frames to labels: arrays, streams and recordings, as one object labels them."""

from __future__ import annotations

import gc
import pickle
import threading
import weakref
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from label_networks import Places
from numpy.typing import NDArray
from pngs import png
from small_rig import SMALL

from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND, PARTS33, load_label_map
from bodyseg_data.rigs import Camera, Distortion, load_rig
from bodyseg_model.networks import Trained, load_network
from bodyseg_model.recordings import Frame, LiveRecording, find_frames, frame_camera
from bodyseg_model.segmentation import Background, FrameLabeller, LabelledFrame, Segmenter, frame_labeller
from bodyseg_model.segmentation.carried_labels import CarriedLabels
from bodyseg_model.segmentation.segmenter import LEAST_CONFIDENCE, STAGES
from bodyseg_model.segmentation.views import Undistortion

CAMERA = Camera(60, 80, 100.0, (40.0, 30.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
BENT = replace(CAMERA, distortion=Distortion(k1=0.1))


pytestmark = pytest.mark.usefixtures("one_thread", "near_is_person")


def labeller(video: bool = False) -> FrameLabeller:
    return FrameLabeller(Trained(Places(0, 5), {"rig": SMALL.to_json()}), video=video)


def standing(x: int, z: float = 2.0) -> NDArray[np.float32]:
    """A block before a wall."""
    frame = np.full((60, 80), 4.0, np.float32)
    frame[10:50, x : x + 12] = z
    return frame


def recording(folder: Path, *columns: int) -> Path:
    folder.mkdir()
    for number, column in enumerate(columns):
        (folder / f"{number}.png").write_bytes(png(np.rint(1000 * standing(column)).astype(np.uint16)))
    return folder


def test_an_array_gets_the_labels_of_a_segmenter() -> None:
    found = labeller()(standing(30), CAMERA)
    expected = Segmenter(Places(0, 5), CAMERA, rig=SMALL)(standing(30))
    np.testing.assert_array_equal(found.labels, expected.labels)
    np.testing.assert_array_equal(found.confidence, expected.confidence)
    np.testing.assert_array_equal(found.labels != BACKGROUND, standing(30) == 2)
    assert len(found.bodies) == 1 and found.things == () and found.camera == CAMERA
    assert tuple(found.milliseconds) == ("read", *STAGES)
    assert found.frame is None and found.stored is None


def test_a_stream_of_frames_tells_their_times() -> None:
    arrays = [(0.5, np.rint(1000 * standing(30)).astype(np.uint16)), (0.6, standing(34))]
    found = list(labeller(video=True).stream(LiveRecording(arrays), CAMERA))
    assert [answer.frame and answer.frame.time_s for answer in found] == [0.5, 0.6]
    for answer, (plain, column) in zip(found, ((standing(30), 30), (standing(34), 34)), strict=True):
        np.testing.assert_array_equal(answer.range_m, plain)
        assert (answer.labels[20:40, column : column + 12] != BACKGROUND).all()
    assert [body.track for answer in found for body in answer.bodies] == [1, 1]
    assert [body.track for answer in labeller().stream([standing(30)], CAMERA) for body in answer.bodies] == [None]


def test_labels_may_be_joined_to_coarser_classes() -> None:
    trained = Trained(Places(0, 5), {"rig": SMALL.to_json()})
    own = FrameLabeller(trained)(standing(30), CAMERA)
    limbs = FrameLabeller(trained, labels="limbs14")(standing(30), CAMERA)
    assert limbs.label_map == load_label_map("limbs14")
    np.testing.assert_array_equal(limbs.labels, load_label_map("limbs14").table[own.labels])
    np.testing.assert_array_equal(limbs.confidence, own.confidence)
    assert len(set(limbs.parts()["part"])) < len(set(own.parts()["part"]))
    np.testing.assert_array_equal(own.joined("limbs14").labels, limbs.labels)
    assert own.joints().shape == (1, 15)
    with pytest.raises(BadConfig, match="^joints are found from the 33 parts alone, found labels 'limbs14'$"):
        limbs.joints()
    with pytest.raises(BadConfig, match="^labels 'parts33' and 'joints24' are of other classes"):
        FrameLabeller(trained, labels="joints24")
    with pytest.raises(BadConfig, match="^labels limbs14 are joined from known classes"):
        replace(own, label_map=None).joined("limbs14")


def test_a_segmenter_goes_by_its_networks_card() -> None:
    trained = Trained(Places(0, 5), {"rig": SMALL.to_json(), LEAST_CONFIDENCE: 0.7})
    segmenter = Segmenter(trained, CAMERA)
    assert (segmenter.rig, segmenter.label_map, segmenter.doubted_below) == (SMALL, PARTS33, 0.7)
    assert Segmenter(trained, CAMERA, doubted_below=0.0, rig=load_rig()).doubted_below == 0.0
    assert Segmenter(trained.network, CAMERA).rig == load_rig()


def test_a_camera_with_distortion_has_its_frames_undistorted() -> None:
    lens = Undistortion(BENT)
    for found in (labeller()(standing(30), BENT), *labeller().stream([standing(30)], BENT)):
        np.testing.assert_array_equal(found.range_m, lens(standing(30)))
        np.testing.assert_array_equal(found.labels != BACKGROUND, found.range_m == 2)
        assert found.camera == lens.camera


def test_a_program_may_have_other_defaults_of_torch() -> None:
    """As float64 in robot kinematics, or a GPU, for which another device stands here."""
    frame, label = standing(30), FrameLabeller(load_network(), device="cpu")
    expected = label(frame, CAMERA)
    torch.set_default_dtype(torch.float64)
    try:
        other = FrameLabeller(load_network(), device="cpu")
        found = [other(frame, CAMERA)]
    finally:
        torch.set_default_dtype(torch.float32)
    with torch.device("meta"):
        found.append(label(frame, CAMERA))
    assert str(other.trained.network) == str(label.trained.network), "also of folded layers"
    for each in found:
        np.testing.assert_array_equal(each.labels, expected.labels)
        np.testing.assert_array_equal(each.confidence, expected.confidence)


def test_a_labeller_that_nobody_holds_is_gone_at_once() -> None:
    """Its networks and a runtime's sessions take much memory, of which Python's collector of cycles knows nothing."""
    label = labeller(video=True)
    assert label(standing(30), BENT).bodies
    gone = weakref.ref(label)
    gc.disable()
    try:
        del label
        assert gone() is None
    finally:
        gc.enable()


def test_sixteen_cameras_may_take_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """To make a lens anew takes as long as half a frame."""
    lenses: list[Camera] = []
    monkeypatch.setattr(frame_labeller, "Undistortion", lambda camera: lenses.append(camera) or Undistortion(camera))
    label, cameras = labeller(), [replace(BENT, focal_px=100.0 + number) for number in range(16)]
    for camera in 2 * cameras:
        label(standing(30), camera)
    assert lenses == cameras


@pytest.mark.parametrize("video", [False, True])
@pytest.mark.parametrize("at_once", [1, 2, 3])
def test_a_stream_answers_each_frame_with_its_number(
    at_once: int, video: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[str] = []
    labelled: list[str] = []

    def live() -> Iterator[NDArray[np.float32]]:
        for column in (20, 24, 28, 32):
            taken.append(threading.current_thread().name)
            yield standing(column)

    def noted(segmenter: Segmenter, frame: Any, label: Any = Segmenter.__call__) -> Any:
        labelled.append(threading.current_thread().name.partition("_")[0])
        return label(segmenter, frame)

    monkeypatch.setattr(Segmenter, "__call__", noted)
    label = labeller(video=video)
    alone = [label(standing(column), CAMERA).labels for column in (20, 24, 28, 32)]
    labelled.clear()
    for number, found in enumerate(label.stream(live(), CAMERA, at_once)):
        assert found.number == number
        np.testing.assert_array_equal(found.labels, alone[number])
        assert at_once > 1 or len(taken) == number + 1, "an answer before the next frame is asked for"
    one_by_one = video or at_once == 1
    assert all((name == "MainThread") == one_by_one for name in taken)
    assert set(labelled) == {"MainThread" if one_by_one else "labelling"}, "a video's frames in their order"


@pytest.mark.parametrize("camera", [CAMERA, BENT])
def test_answers_keep_their_frames_where_a_driver_fills_one_array_again(camera: Camera) -> None:
    held = np.zeros((60, 80), np.float32)

    def live() -> Iterator[NDArray[np.float32]]:
        for column in (20, 28):
            held[:] = standing(column, 1.5 + column / 40)
            yield held

    found = list(labeller().stream(live(), camera))
    for answer, column in zip(found, (20, 28), strict=True):
        expected = labeller()(standing(column, 1.5 + column / 40), camera)
        np.testing.assert_array_equal(answer.range_m, expected.range_m)
        np.testing.assert_array_equal(answer.points(), expected.points())


def test_a_person_whom_no_view_can_show_ends_no_stream() -> None:
    """As a camera of 120 degrees sees somebody from 0.46 m on one side to 1.2 m on the other."""
    wide = replace(CAMERA, focal_px=23.0)
    across = (np.arange(80) + 0.5 - 40) / 23
    z = (1.22898 * 0.71745 + 1.61883 * 0.46106) / (across * (1.22898 - 0.46106) + 0.71745 + 1.61883)
    beside = np.full((60, 80), 4.0, np.float32)
    shown = (across < 0.71745 / 0.46106) & (across > -1.61883 / 1.22898)
    beside[10:50, shown] = z[shown]
    first, second = labeller().stream([beside, standing(30, 1.0)], wide)
    (thing,) = first.things
    assert not first.bodies and (first.labels == BACKGROUND).all()
    np.testing.assert_array_equal(thing.pixels, np.flatnonzero(beside < 3.5))
    assert (thing.scale, thing.mean_confidence) == (0, 0) and 0.4 < thing.median_range_m < 1.3
    assert len(second.bodies) == 1 and not second.things


def test_a_bad_frame_of_a_stream_is_named() -> None:
    answers = labeller().stream([standing(20), standing(20).T], CAMERA)
    assert next(answers).bodies
    with pytest.raises(BadConfig, match="^frame 1: a frame must have .* 60 x 80, found 80 x 60$"):
        next(answers)
    with pytest.raises(BadConfig, match="^a frame must have the camera's size"):
        labeller()(standing(20).T, CAMERA)
    pairs: Any = [(0.5, standing(20))]
    with pytest.raises(BadConfig, match=r"^frame 0: a frame must be an array \(of pairs with times, LiveRecording"):
        next(labeller().stream(pairs, CAMERA))


@pytest.mark.parametrize("given", [np.float64, np.float16, torch.from_numpy, np.ndarray.tolist])
def test_metres_of_any_precision_and_kind_are_a_frame(given: Any) -> None:
    frame = standing(30)
    made = given(frame) if given in (torch.from_numpy, np.ndarray.tolist) else frame.astype(given)
    np.testing.assert_array_equal(labeller()(made, CAMERA).labels, labeller()(frame, CAMERA).labels)
    (answer,) = labeller().stream([made], BENT)
    assert answer.bodies


def test_a_tensor_of_bfloat16_or_with_a_gradient_is_a_frame() -> None:
    frame = standing(30)
    for made in (torch.from_numpy(frame).bfloat16(), torch.from_numpy(frame).requires_grad_()):
        np.testing.assert_array_equal(labeller()(made, CAMERA).labels, labeller()(frame, CAMERA).labels)


def test_masked_pixels_are_not_measured() -> None:
    frame, doubtful = standing(30), np.zeros((60, 80), np.bool_)
    doubtful[:, :36] = True
    for camera in (CAMERA, BENT):
        masked = labeller()(np.ma.masked_array(frame, doubtful), camera)
        np.testing.assert_array_equal(masked.range_m, labeller()(np.where(doubtful, 0, frame), camera).range_m)


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        ((1000 * standing(30)).astype(np.uint16), "must be of floating point, metres, found uint16: .* are metres$"),
        (standing(30) > 3, "must be of floating point, metres, found bool"),
        (1000 * standing(30), "must be in metres, found nothing nearer than 2000: .* are metres$"),
        (None, "must have the camera's size, 60 x 80, found none"),
    ],
)
def test_what_is_not_in_metres_is_no_empty_room(frame: Any, message: str) -> None:
    for camera in (CAMERA, BENT):
        with pytest.raises(BadConfig, match=f"^a frame {message}"):
            labeller()(frame, camera)
        with pytest.raises(BadConfig, match=f"^frame 0: a frame {message}"):
            next(labeller().stream([frame], camera))


@pytest.mark.parametrize("value", [0.0, 1000.0, np.inf, np.nan])
def test_a_frame_of_one_value_is_an_empty_room(value: float) -> None:
    assert not labeller()(np.full((60, 80), value, np.float32), CAMERA).bodies


@pytest.mark.parametrize("camera", [None, "kinect_v1"])
def test_a_frame_needs_its_camera(camera: Any) -> None:
    with pytest.raises(BadConfig, match=f"^a frame needs its camera, like frame_camera.*, found {camera!r}$"):
        labeller()(standing(30), camera)


def test_whole_frames_are_prepared_for_in_their_own_size(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[tuple[int, ...]] = []
    network = Places(0, 5)
    monkeypatch.setattr(
        network, "scores", lambda range_m: sizes.append(range_m.shape[2:]) or Places.scores(network, range_m)
    )
    Segmenter(network, CAMERA, Background("frame")).prepare()
    FrameLabeller(Trained(network, {}), Background("frame"), device="cpu").prepare(CAMERA)
    assert sizes == [(60, 80)] * 2, "and in no size of views of bodies"


def test_a_video_of_few_rows_is_prepared_for() -> None:
    camera = frame_camera((8, 8), "a frame", focal_px=8.0).camera
    Segmenter(Places(0, 5), camera, Background("frame"), video=CarriedLabels()).prepare()


def test_one_frame_is_a_recording() -> None:
    (frame,) = LiveRecording([standing(30)], None)
    (labelled,) = labeller().recording(frame, focal_px=100.0)
    assert len(labelled.bodies) == 1


def test_frames_that_come_once_are_a_recording_and_bare_arrays_are_none() -> None:
    stored = np.rint(1000 * standing(20)).astype(np.uint16)
    opened = labeller().recording(LiveRecording(iter([stored, stored])), focal_px=100.0)
    assert [len(each.bodies) for each in opened] == [1, 1]
    with pytest.raises(BadConfig, match="^arrays are labelled one by one or by `stream`"):
        labeller().recording(np.stack([stored, stored]))


def test_a_recording_is_labelled_from_its_path(tmp_path: Path) -> None:
    folder, label = recording(tmp_path / "frames", 20, 24), labeller()
    opened = label.recording(folder, focal_px=100.0)
    assert len(opened) == 2
    for _ in range(2):  # it may be read again
        found = list(opened)
        assert [(each.number, each.frame.name if each.frame else "") for each in found] == [(0, "0"), (1, "1")]
        for each, column in zip(found, (20, 24), strict=True):
            np.testing.assert_array_equal(each.labels, label(standing(column), CAMERA).labels)
            assert each.stored is not None and each.stored.dtype == np.uint16 and each.own_camera is None
    named: list[str | Path | Frame] = [folder / "0.png", str(folder / "1.png")]
    for source in (str(folder), [folder], find_frames([folder]), named):
        again = list(label.recording(source, focal_px=100.0))
        assert all(np.array_equal(one.labels, other.labels) for one, other in zip(again, found, strict=True))
    for number in (1, -1):
        last = opened.label(number)
        np.testing.assert_array_equal(last.labels, found[1].labels)
        assert last.number == 1
    with pytest.raises(BadConfig, match="no sensor is assumed for frames of 60 rows of 80 pixels"):
        label.recording(folder)
    with pytest.raises(BadConfig, match="a recording must hold a frame, found none"):
        label.recording([])


def test_a_camera_may_be_given_by_the_matrix_of_a_calibration(tmp_path: Path) -> None:
    matrix = np.array([[100, 0, 37], [0, 100, 31], [0, 0, 1]], np.float32)
    opened = labeller().recording(
        recording(tmp_path / "frames", 20),
        focal_px=matrix[0, 0],
        centre_px=matrix[:2, 2],  # type: ignore[arg-type]
    )
    assert opened.cameras.first.camera == replace(CAMERA, centre_px=(37.0, 31.0))


def test_frames_that_cannot_be_read_are_skipped_and_listed(tmp_path: Path) -> None:
    folder = recording(tmp_path / "frames", 20, 24, 28)
    (folder / "1.png").write_bytes(b"no picture")
    opened = labeller().recording(folder, focal_px=100.0, skip_unreadable=1)
    assert [found.number for found in opened] == [0, 2]
    assert [entry["name"] for entry in opened.skipped] == ["1"]
    with pytest.raises(BadConfig, match=r"1\.png"):
        opened.label(1)
    with pytest.raises(BadConfig, match=r"1\.png"):
        list(labeller().recording(folder, focal_px=100.0))


def test_a_video_begins_anew_with_each_recording_and_stream(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    label = labeller(video=True)
    carried: list[int] = []
    assert label.video is not None
    monkeypatch.setattr(label.video, "restart", lambda numbers: carried.append(-1))
    monkeypatch.setattr(Segmenter, "prepare", lambda segmenter: None)
    paths = [recording(tmp_path / "one", 20, 24), recording(tmp_path / "two", 28, 30)]

    def noted(frames: Iterator[LabelledFrame]) -> None:
        carried.extend(frame.number for frame in frames)

    noted(iter(label.recording(paths, focal_px=100.0)))
    noted(label.stream([standing(20), standing(24)], CAMERA))
    label(standing(20), CAMERA)
    assert carried == [-1, 0, 1, -1, 2, 3, -1, 0, 1], "a call carries on"
    label.restart()
    assert carried[-1] == -1
    labeller().restart()  # nothing is carried over without video


@pytest.mark.parametrize("video", [False, True])
def test_a_labeller_can_be_sent_to_workers_that_are_spawned(video: bool) -> None:
    own = labeller(video=video)
    own(standing(20), CAMERA)
    sent = pickle.loads(pickle.dumps(own))
    wanted, got = own(standing(22), CAMERA), sent(standing(22), CAMERA)
    np.testing.assert_array_equal(got.labels, wanted.labels)
    assert [body.track for body in got.bodies] == [body.track for body in wanted.bodies] == [1 if video else None]
    assert sent.of(CAMERA)[1] is sent.of(CAMERA)[1] is not own.of(CAMERA)[1]


def test_leaving_early_leaves_no_thread(tmp_path: Path) -> None:
    opened = labeller().recording(recording(tmp_path / "frames", *range(20, 40, 2)), focal_px=100.0)
    frames = opened.labelled(at_once=2)
    next(frames)
    frames.close()
    assert not any(thread.name.startswith(("reading", "labelling")) for thread in threading.enumerate())


def test_loops_are_loaded_before_threads_label_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Or the first frames would be computed without them, to other last bits than one after another."""
    done: list[str] = []
    monkeypatch.setattr(Segmenter, "prepare", lambda segmenter: done.append("prepared"))
    opened = labeller().recording(recording(tmp_path / "frames", 20, 24), focal_px=100.0)
    done.extend("labelled" for _ in opened.labelled(at_once=2))
    assert done == ["prepared", "labelled", "labelled"]
    label = labeller(video=True)
    list(label.recording(tmp_path / "frames", focal_px=100.0).labelled(at_once=2))
    assert done.count("prepared") == 1, "frames of a video are labelled one after another"
    with pytest.raises(BadConfig, match="^at_once must be a whole number of at least 1, found '2'$"):
        next(opened.labelled(at_once="2"))  # type: ignore[arg-type]


def test_headers_are_read_where_they_are_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = labeller().recording(recording(tmp_path / "frames", 20), focal_px=100.0)
    monkeypatch.setattr(type(opened.frames[0]), "stamp", lambda frame: "header")
    assert [[each.stamp for each in opened.labelled(stamps=stamps)] for stamps in (False, True)] == [[None], ["header"]]


def test_what_a_labeller_refuses(tmp_path: Path) -> None:
    folder = recording(tmp_path / "frames", 20)
    trained = Trained(Places(0, 5), {"rig": SMALL.to_json()})
    with pytest.raises(BadConfig, match="^a confidence must be 0 to 1, found 70$"):
        FrameLabeller(trained, least_confidence=70).recording(folder, focal_px=100.0)
    in_vain: list[dict[str, Any]] = [{"keep_things": True}, {"finder": load_network()}]
    for given in in_vain:
        with pytest.raises(BadConfig, match="^finder and keep_things go with the background 'people', found 'keep'$"):
            FrameLabeller(None, Background("keep"), **given)
    with pytest.raises(BadConfig, match="the backend must be one of torch, onnxruntime, openvino, found 'caffe'"):
        FrameLabeller(trained, backend="caffe")
    wrong: list[Any] = [-1, "2"]
    for budget in wrong:
        with pytest.raises(BadConfig, match="--skip-unreadable"):
            labeller().recording(folder, focal_px=100.0, skip_unreadable=budget)
