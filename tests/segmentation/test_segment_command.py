"""`bodyseg segment`, as its users call it."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from kernel_forms import computed_by
from label_networks import Places
from numpy.typing import NDArray
from PIL import Image
from pngs import pixels, png
from small_rig import SMALL

from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND, LANDMARKS, PART_CLASSES, PARTS33, LabelMap, load_label_map
from bodyseg_data.rigs import Rig, load_sensor
from bodyseg_model import runtimes
from bodyseg_model.commands import cli, segment
from bodyseg_model.networks import Trained, build, save_network
from bodyseg_model.recordings import Skipping, find_frames
from bodyseg_model.recordings.camera_files import cameras_beside
from bodyseg_model.runtimes import backends, load_network
from bodyseg_model.segmentation import FrameLabeller, Segmenter, view_body
from bodyseg_model.segmentation.views import STEP, Undistortion

pytestmark = pytest.mark.usefixtures("near_is_person", "prepared")

Frame = NDArray[np.uint16]


def standing(x: int, millimetres: int, shape: tuple[int, int] = (60, 80)) -> Frame:
    """A block 40 pixels high and 12 wide, before a wall that fills the frame."""
    frame = np.full(shape, 4000, np.uint16)
    frame[10:50, x : x + 12] = millimetres
    return frame


def save(path: Path, frame: NDArray[Any]) -> Path:
    Image.fromarray(frame).save(path)
    return path


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Five frames; the block walks to the right."""
    folder = tmp_path / "recording"
    folder.mkdir()
    for number in range(7, 12):
        save(folder / f"{number}.png", standing(2 * number, 2000))
    return folder


@pytest.fixture(autouse=True)
def network(monkeypatch: pytest.MonkeyPatch) -> Iterator[Places]:
    """Stands in for the network that ships: parts from the top down. One thread is enough for images this small."""
    places = Places(axis=0, step=5)
    card = {"network": "places", "seed": 3, "rig": SMALL.to_json()}
    monkeypatch.setattr(
        runtimes, "load_network", lambda run, dense=False: load_network(run) if run else Trained(places, card)
    )
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    monkeypatch.setattr(backends, "computes_bfloat16", lambda: False)  # which computes a copy of it
    yield places
    torch.set_num_threads(before)


def run(*words: str | Path) -> int:
    return cli.main(["segment", *map(str, words)])


def refused(capsys: pytest.CaptureFixture[str], *words: str | Path) -> str:
    assert run(*words) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1].startswith("bodyseg segment: ") and not any("Traceback" in line for line in lines)
    return lines[-1].removeprefix("bodyseg segment: ")


def report(out: Path) -> dict[str, Any]:
    parsed: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return parsed


def test_an_install_without_numba_names_the_extra(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "numba", None)
    with computed_by("numpy"):  # as it then is, whatever an earlier test has decided
        said = refused(capsys, recording, "--focal", "100", "--out", tmp_path / "out")
    assert said.startswith("labelling frames needs the package 'numba': pip install 'bodyseg[segment]'")


def test_coarser_classes_may_be_asked_for(recording: Path, tmp_path: Path) -> None:
    for out, words in (("fine", ()), ("coarse", ("--labels", "limbs14", "--video"))):
        assert run(recording, "--focal", "100", "--out", tmp_path / out, *words) == 0
    fine, coarse = (np.asarray(Image.open(tmp_path / out / "labels" / "9.png")) for out in ("fine", "coarse"))
    np.testing.assert_array_equal(coarse, load_label_map("limbs14").table[fine])
    assert report(tmp_path / "coarse")["labels"]["name"] == "limbs14"
    tracks = [body["track"] for frame in report(tmp_path / "coarse")["each"] for body in frame["bodies"]]
    assert tracks == [1] * 5 and "track" not in report(tmp_path / "fine")["each"][0]["bodies"][0]


def test_people_of_several_recordings_have_numbers_of_their_own(recording: Path, tmp_path: Path) -> None:
    (other := tmp_path / "other").mkdir()
    shutil.copy(recording / "9.png", other)
    for _ in range(2):
        assert run(recording, other, "--focal", "100", "--out", tmp_path / "out", "--video") == 0
        tracks = [body["track"] for frame in report(tmp_path / "out")["each"] for body in frame["bodies"]]
        assert tracks == [1] * 5 + [2]


def test_a_recording_is_labelled(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "out"
    assert run(recording, "--focal", "100", "--out", out, "--fps", "5") == 0
    written = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    names = [str(number) for number in range(7, 12)]
    assert written == {
        *(f"labels/{name}.png" for name in names),
        *(f"persons/{name}.png" for name in names),
        *(f"overlay/{name}.png" for name in names),
        "legend.png",
        "preview.gif",
        "summary.json",
    }
    for name in names:
        frame, labels, overlay = (
            pixels(folder / f"{name}.png") for folder in (recording, out / "labels", out / "overlay")
        )
        assert labels.dtype == np.uint8 and labels.shape == frame.shape and overlay.shape == (60, 80, 3)
        np.testing.assert_array_equal(labels != BACKGROUND, frame == 2000)
        assert len(np.unique(labels)) > 10
    with Image.open(out / "preview.gif") as animation:
        assert (getattr(animation, "n_frames"), animation.info["duration"]) == (5, 200)  # noqa: B009  not in its type

    facts = report(out)
    assert facts["network"] == {"file": "shipped", "network": "places", "seed": 3}
    assert (
        facts["camera"]["focal_px"] == 100 and facts["camera"]["origin"] == "given" and not facts["camera"]["mirrored"]
    )
    assert facts["labels"] == json.loads(json.dumps(PARTS33.to_json()))
    assert facts["unit_m"] == 0.001 and facts["background"]["mode"] == "people"
    assert facts["peak_mb"] > 50, "this process alone takes more"
    assert facts["rig"] == json.loads(json.dumps(SMALL.to_json()))
    assert (facts["frames"], facts["people"], facts["pixels"]) == (5, 5, 5 * 480)
    assert [frame["name"] for frame in facts["each"]] == names
    assert {"read", "find", "resample", "network", "back", "write", "frame"} < set(facts["ms"])
    assert facts["flicker"]["shared_pixels"] == 4 * 10 * 40 and facts["flicker"]["changed"] < 0.03
    said = capsys.readouterr().err
    assert "wrote 5 frames to" in said and "1 person a frame, mean confidence 100%" in said and "assumed" not in said


def test_a_folder_and_its_files_give_the_same_labels(recording: Path, tmp_path: Path) -> None:
    files = sorted(recording.iterdir(), reverse=True)
    for out, frames in (("a", [recording]), ("b", files)):
        assert run(*frames, "--focal", "100", "--out", tmp_path / out) == 0
    for name in ("labels", "overlay"):
        for file in (tmp_path / "a" / name).iterdir():
            assert file.read_bytes() == (tmp_path / "b" / name / file.name).read_bytes()
    order = [[frame["name"] for frame in report(tmp_path / out)["each"]] for out in "ab"]
    assert order == [["7", "8", "9", "10", "11"]] * 2


def test_a_video_is_carried_along_within_each_recording(recording: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    shutil.copytree(recording, again)
    assert run(recording, again, "--focal", "100", "--video", "--out", tmp_path / "out") == 0
    facts = report(tmp_path / "out")
    assert facts["video"]["keep"] == 0.9 and facts["ms"]["video"]["mean"] > 0
    first, second = (
        [pixels(file) for file in sorted((tmp_path / "out/labels").glob(f"{folder.name}/*.png"))]
        for folder in (recording, again)
    )
    assert len(first) == len(second) == 5
    np.testing.assert_array_equal(first, second, "the second recording starts anew")
    assert run(recording, "--focal", "100", "--out", tmp_path / "alone") == 0
    assert report(tmp_path / "alone")["video"] is None


def test_a_unit_and_a_rig_may_be_given(tmp_path: Path, network: Places) -> None:
    frame = np.zeros((640, 329), np.uint16)
    frame[100:400, 114:215] = 25000
    save(tmp_path / "a.png", frame)
    assert run(tmp_path / "a.png", "--units", "0.1mm", "--rig", "paper", "--out", tmp_path / "out") == 0
    (body,) = report(tmp_path / "out")["each"][0]["bodies"]
    assert (body["pixels"], body["box"]) == (30300, [100, 114, 400, 215])
    assert (body["range_m"], body["turn_deg"], body["scale"]) == (2.5, 0.0, 0.25)
    assert [tuple(view.shape) for view in network.seen] == [(1, 1, 160, 82 + STEP)]


def test_a_run_may_be_given(recording: Path, tmp_path: Path) -> None:
    settings = {"patch": 8, "widths": [4], "blocks": [0]}
    save_network(tmp_path / "network.safetensors", build("compact", settings), "compact", {"seed": 9, "secret": 1})
    out = tmp_path / "out"
    assert run(recording / "7.png", "--focal", "100", "--run", tmp_path, "--out", out, "--device", "cpu") == 0
    digest = hashlib.sha256((tmp_path / "network.safetensors").read_bytes()).hexdigest()
    assert report(out)["network"] == {
        "file": str(tmp_path),
        "network": "compact",
        "seed": 9,
        "weights_sha256": digest,
    }
    labels = pixels(out / "labels" / "7.png")
    np.testing.assert_array_equal(labels != BACKGROUND, pixels(recording / "7.png") == 2000)


@pytest.mark.parametrize(("able", "expected"), [(True, "bfloat16"), (False, "float32")])
def test_the_network_is_computed_in_bfloat16_where_the_processor_does_unless_another_precision_is_asked_for(
    able: bool, expected: str, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backends, "computes_bfloat16", lambda: able)
    frame = recording / "7.png", "--focal", "100", "--device", "cpu"
    assert run(*frame, "--out", tmp_path / "quick") == 0
    assert report(tmp_path / "quick")["runtime"]["precision"] == expected
    for precision in ("float32", "bfloat16"):
        assert run(*frame, "--precision", precision, "--out", tmp_path / precision) == 0
        assert report(tmp_path / precision)["runtime"]["precision"] == precision
    one, other = (pixels(tmp_path / name / "labels" / "7.png") for name in ("quick", expected))
    np.testing.assert_array_equal(one, other)


def test_confidence_limits_and_mirrors_are_options(recording: Path, tmp_path: Path, network: Places) -> None:
    network.sure_m = 2.0
    frame, options = recording / "7.png", ("--focal", "100")
    assert run(frame, *options, "--confidence", "0.7", "--out", tmp_path / "sure") == 0
    assert (pixels(tmp_path / "sure" / "labels" / "7.png") == BACKGROUND).all()
    facts = report(tmp_path / "sure")
    assert (facts["pixels"], facts["labelled"], facts["least_confidence"]) == (480, 0, 0.7)
    assert facts["mean_confidence"] == pytest.approx(0.525, abs=0.001)
    assert run(frame, *options, "--background", "limits", "--near", "3", "--far", "4", "--out", tmp_path / "wall") == 0
    np.testing.assert_array_equal(pixels(tmp_path / "wall" / "labels" / "7.png") == BACKGROUND, pixels(frame) == 2000)
    assert report(tmp_path / "wall")["background"] == {"mode": "limits", "near_m": 3.0, "far_m": 4.0}
    assert run(frame, *options, "--mirrored", "--out", tmp_path / "mirrored") == 0
    assert report(tmp_path / "mirrored")["camera"]["mirrored"]


def test_the_mirror_image_may_be_labelled_too(recording: Path, tmp_path: Path, network: Places) -> None:
    frame, options = recording / "7.png", ("--focal", "100")
    assert run(frame, *options, "--out", tmp_path / "one") == 0
    network.seen.clear()
    assert run(frame, *options, "--flip-average", "--out", tmp_path / "both") == 0
    view, mirrored = network.seen[-1]
    assert torch.equal(view, mirrored.flip(2)) and (view > 0).any()
    assert (
        report(tmp_path / "both")["runtime"]["flip_average"]
        and "flip_average" not in report(tmp_path / "one")["runtime"]
    )
    one, both = (pixels(tmp_path / name / "labels" / "7.png") for name in ("one", "both"))
    # Labels of this network do not depend on the side, so left and right parts of a row get half each.
    np.testing.assert_array_equal(np.minimum(one, PART_CLASSES.mirrored[one]), both)
    assert report(tmp_path / "both")["mean_confidence"] < report(tmp_path / "one")["mean_confidence"]


def test_frames_of_a_camera_with_lens_distortion_are_undistorted(recording: Path, tmp_path: Path) -> None:
    rig = tmp_path / "bent.toml"
    lens = 'distortion = {model = "brown_conrady", k1 = 0.1, p2 = 0.01}'
    rig.write_text(
        f'format = "bodyseg rig 1"\nname = "bent"\n[camera]\nrows = 60\ncolumns = 80\nfocal_px = 100\n{lens}\n'
    )
    out = tmp_path / "out"
    assert run(recording, "--rig", rig, "--out", out) == 0
    frame, found = pixels(recording / "7.png"), pixels(out / "undistorted" / "7.png")
    expected = Undistortion(load_sensor(rig).camera)(frame)
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == np.uint16 and not np.array_equal(found, frame)
    np.testing.assert_array_equal(pixels(out / "labels" / "7.png") != BACKGROUND, found == 2000)
    distortion = {"model": "brown_conrady", "k1": 0.1, "k2": 0.0, "p1": 0.0, "p2": 0.01, "k3": 0.0}
    assert report(out)["camera"]["distortion"] == distortion
    assert run(recording, "--focal", "100", "--out", tmp_path / "plain") == 0
    assert not (tmp_path / "plain" / "undistorted").exists()


def test_frames_may_have_cameras_of_their_own(recording: Path, tmp_path: Path, network: Places) -> None:
    """A frame of another size and lens, and one whose camera has 1.5 times the focal length: its body is smaller."""
    save(recording / "8.png", standing(5, 2000, (90, 120)))
    own = {"fx": 100.0, "fy": 100.0, "cx": 59.5, "cy": 44.5, "distortion": [0.1, 0, 0, 0]}
    (recording / "8.json").write_text(json.dumps(own))
    (recording / "9.json").write_text(json.dumps({"fx": 150.0, "fy": 150.0, "cx": 39.5, "cy": 29.5}))
    (recording / "cameras.json").write_text(json.dumps({"default": {"fx": 100.0, "fy": 100.0, "cx": 39.5, "cy": 29.5}}))
    out = tmp_path / "out"
    assert run(recording, "--out", out) == 0
    facts = report(out)
    assert facts["camera"] == {"origin": "each frame's own", "frames_with_their_own": 5, "mirrored": False}
    assert [frame["camera"]["focal_px"] for frame in facts["each"]] == [100, 100, 150, 100, 100]
    scales = [frame["bodies"][0]["scale"] for frame in facts["each"]]
    assert scales[::2] == pytest.approx([1.515, 1.01, 1.515], rel=0.03)
    with Image.open(out / "preview.gif") as animation:
        assert getattr(animation, "n_frames") == 4, "those of one size"  # noqa: B009  not in its type
    assert facts["each"][1]["flicker"] is None and facts["each"][3]["flicker"] is not None
    lens = cameras_beside(find_frames([recording / "8.png"]))[0]
    assert lens is not None
    expected = Undistortion(lens.frame_camera((90, 120)).camera)(pixels(recording / "8.png"))
    np.testing.assert_array_equal(pixels(out / "undistorted" / "8.png"), expected)
    np.testing.assert_array_equal(pixels(out / "undistorted" / "7.png"), pixels(recording / "7.png"))


def test_a_camera_that_is_given_is_that_of_all_frames(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (recording / "8.json").write_text("{")
    out = tmp_path / "out"
    assert "8.json is not JSON" in refused(capsys, recording, "--out", out)
    assert not out.exists()
    assert run(recording, "--focal", "100", "--out", out) == 0
    assert all("camera" not in frame for frame in report(out)["each"])


def test_frames_of_one_name_go_to_folders_of_their_own(recording: Path, tmp_path: Path) -> None:
    other = shutil.copytree(recording, tmp_path / "other")
    save(other / "7.png", standing(60, 2000))
    assert run(recording, other, "--focal", "100", "--out", tmp_path / "out") == 0
    for folder in (recording, other):
        labels = pixels(tmp_path / "out" / "labels" / folder.name / "7.png")
        np.testing.assert_array_equal(labels != BACKGROUND, pixels(folder / "7.png") == 2000)
    each = report(tmp_path / "out")["each"]
    assert [frame["name"] for frame in each][::5] == ["recording/7", "other/7"]
    assert each[5]["flicker"] is None, "another recording begins"


def test_an_out_that_is_not_segments_is_refused_and_kept(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.read_bytes() for path in recording.iterdir()}
    for out in (recording, tmp_path, recording / "labelled"):
        assert "--out must lie outside the frames' folders" in refused(
            capsys, recording, "--focal", "100", "--out", out
        )
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "network.json").write_text("{}")
    assert "holds network.json" in refused(capsys, recording, "--focal", "100", "--out", tmp_path / "run")
    assert {path: path.read_bytes() for path in recording.iterdir()} == before
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["network.json"]


def test_a_later_frame_of_another_size_is_refused_by_name_before_it_is_undistorted(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = tmp_path / "bent.toml"
    rig.write_text(
        'format = "bodyseg rig 1"\nname = "bent"\n[camera]\nrows = 60\ncolumns = 80\nfocal_px = 100\n'
        'distortion = {model = "brown_conrady", k1 = 0.1}\n'
    )
    save(recording / "8.png", standing(5, 2000, (60, 81)))
    assert run(recording, "--rig", rig, "--out", tmp_path / "out") == 2
    assert "8.png: a frame must have the camera's size, 60 x 80, found 60 x 81" in capsys.readouterr().err


@pytest.mark.parametrize(
    "frame",
    [np.zeros((480, 640)), np.full((480, 640), 65535), np.full((480, 640), 4000), np.full((480, 640), 1)],
    ids=["empty", "saturated", "constant", "nearly nothing"],
)
def test_where_nobody_is_results_are_empty(frame: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save(tmp_path / "a.png", frame.astype(np.uint16))
    assert run(tmp_path / "a.png", "--turned", "auto", "--out", tmp_path / "out") == 0
    assert (pixels(tmp_path / "out" / "labels" / "a.png") == BACKGROUND).all()
    facts = report(tmp_path / "out")
    assert facts["people"] == 0 and facts["mean_confidence"] is None
    said = capsys.readouterr().err
    assert "nobody was found: are --units, --near and --far right?" in said
    assert "--turned auto: 0, as no frame tells" in said
    assert "camera assumed: Kinect v1, by the frames' size: give --focal or --rig if it is another" in said


def test_a_bad_frame_stops_a_sequence_and_leaves_what_was_written(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, options = tmp_path / "out", ("--focal", "100", "--out", tmp_path / "out")
    assert run(recording, *options) == 0
    shutil.rmtree(out / "labels")
    whole = (recording / "10.png").read_bytes()
    bad = {
        whole[:-20]: "a PNG must be whole, found it cut off after",
        b"": "a frame must be a 16-bit grey PNG, found nothing at all",
        png(standing(5, 2000, (60, 81))): "must have the camera's size, 60 x 80, found 60 x 81",
        png(np.zeros((60, 80), np.uint8)): "a frame must be a 16-bit grey PNG, found 8-bit grey",
    }
    for data, message in bad.items():
        (recording / "10.png").write_bytes(data)
        said = refused(capsys, recording, *options)
        assert message in said and str(recording / "10.png") in said
        assert sorted(path.name for path in (out / "labels").iterdir()) == ["7.png", "8.png", "9.png"]
        assert not (out / "summary.json").exists(), "a summary is of all that is there"


def test_a_body_that_no_view_can_hold_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save(tmp_path / "a.png", np.full((480, 640), 16000, np.uint16))
    said = refused(capsys, tmp_path / "a.png", "--focal", "130", "--background", "keep", "--out", tmp_path / "out")
    assert said.startswith(f"{tmp_path / 'a.png'}: a body's view must be at most 2048 pixels wide and high")
    assert not list((tmp_path / "out" / "labels").iterdir())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--units", "inch"], "a unit must be a length"),
        (["--fps", "0"], "a preview shows 0.1 to 50 frames per second, found 0"),
        (["--fps", "nan", "--no-overlay"], "a preview shows 0.1 to 50 frames per second, found nan"),
        (["--confidence", "70"], "a confidence must be 0 to 1, found 70"),
        (
            ["--near", "3", "--far", "2"],
            "the near limit must be at least 0 m and less than the far one, found 3 and 2 m",
        ),
        (
            ["--background", "keep", "--far", "2"],
            "--near and --far limit what is kept: they contradict --background keep",
        ),
        (["--rig", "paper"], "give either --rig or --focal and --centre"),
        (["--centre", "3"], "--centre takes two numbers"),
        (["--device", "abacus"], "cannot compute on the device 'abacus'"),
        (
            ["--run", "nowhere"],
            "a network is compact, large, finder, a run's folder or a .safetensors file, found nowhere,",
        ),
        (["--run", "finder"], "a network with focal_px sees whole frames: it is for --finder or --background frame"),
        (["--background", "none"], 'Invalid value "none" for --background'),
    ],
)
def test_bad_options_are_one_line(
    words: list[str], message: str, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert message in refused(capsys, recording, "--focal", "100", "--out", tmp_path / "out", *words)
    assert not (tmp_path / "out").exists(), "nothing is made for options that cannot be"


def test_an_out_that_cannot_be_written_is_named(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    assert f"cannot write {tmp_path / 'file'}" in refused(
        capsys, recording, "--focal", "100", "--out", tmp_path / "file"
    )
    assert run(recording, "--focal", "100", "--out", tmp_path / "out") == 0
    (tmp_path / "out" / "labels" / "9.png").unlink()
    (tmp_path / "out" / "labels" / "9.png").mkdir()
    said = refused(capsys, recording, "--focal", "100", "--out", tmp_path / "out")
    assert said == f"cannot write {tmp_path / 'out' / 'labels' / '9.png'}: Is a directory"


def test_help_has_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--help") == 0
    assert segment.EXAMPLE in capsys.readouterr().out


def test_without_overlays_labels_and_summary_are_left(recording: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run(recording, "--focal", "100", "--out", out) == 0
    labels = {path.name: pixels(path).tolist() for path in (out / "labels").iterdir()}
    assert run(recording, "--focal", "100", "--out", out, "--no-overlay") == 0
    assert {path.name: pixels(path).tolist() for path in (out / "labels").iterdir()} == labels and len(labels) == 5
    assert {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()} == {
        *(f"labels/{name}" for name in labels),
        *(f"persons/{name}" for name in labels),
        "summary.json",
    }
    assert report(out)["frames_per_second"] > 0


def test_an_interruption_leaves_the_frames_before_it_and_a_repetition_replaces_them(
    recording: Path,
    tmp_path: Path,
    network: Places,
    prepared: list[Rig],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out, label = tmp_path / "out", network.scores

    def interrupted(range_m: torch.Tensor) -> torch.Tensor:
        if len(network.seen) == 3:
            raise KeyboardInterrupt
        return label(range_m)

    monkeypatch.setattr(network, "scores", interrupted)
    assert run(recording, "--focal", "100", "--out", out) == 130
    assert prepared == [SMALL]
    assert sorted(path.name for path in (out / "labels").iterdir()) == ["7.png", "8.png", "9.png"]
    assert (out / "unfinished.json").exists() and not (out / "summary.json").exists()
    assert capsys.readouterr().err.splitlines()[-1] == "bodyseg segment: interrupted"
    monkeypatch.setattr(network, "scores", label)
    assert run(recording, "--focal", "100", "--out", out) == 0
    assert report(out)["frames"] == len(list((out / "labels").iterdir())) == 5


@pytest.mark.parametrize("threads", ["1", "2"])
def test_an_interruption_while_the_next_frame_is_read_leaves_this_one_whole(
    threads: str, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = Skipping.read

    def interrupted(skipping: Skipping, file: Any) -> Any:
        if file.name == "10":
            raise KeyboardInterrupt
        return read(skipping, file)

    monkeypatch.setattr(Skipping, "read", interrupted)
    assert run(recording, "--focal", "100", "--threads", threads, "--out", tmp_path / "out") == 130
    assert sorted(path.name for path in (tmp_path / "out/labels").iterdir()) == ["7.png", "8.png", "9.png"]


def test_frames_that_are_labelled_at_the_same_time_have_the_same_labels(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = []
    for count in (1, 5):
        threads: set[str] = set()
        label = Segmenter.__call__

        def noted(segmenter: Segmenter, frame: Any, label: Any = label, threads: set[str] = threads) -> Any:
            threads.add(f"{threading.current_thread().name} {torch.get_num_threads()}")
            return label(segmenter, frame)

        with monkeypatch.context() as patched:
            patched.setattr(Segmenter, "__call__", noted)
            out = tmp_path / f"out{count}"
            assert run(recording, "--focal", "100", "--threads", str(count), "--out", out) == 0
        assert all(name.startswith("labelling") == (count > 1) and name.endswith(" 1") for name in threads)
        assert len(threads) <= 4
        found.append([pixels(file) for file in sorted((out / "labels").iterdir())])
    np.testing.assert_array_equal(found[0], found[1])


def test_what_the_network_doubts_is_a_thing(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    unsure = Trained(Places(0, 5, sure_m=0.1), {"rig": SMALL.to_json(), "least_confidence_of_people": 0.9})
    monkeypatch.setattr(runtimes, "load_network", lambda run, dense=False: unsure)
    assert run(recording, "--focal", "100", "--out", tmp_path / "out") == 0
    facts = report(tmp_path / "out")
    assert facts["finder"] == {"weights_sha256": "1", "least_confidence_of_people": 0.9}
    assert (facts["people"], facts["things"], facts["labelled"], facts["mean_confidence"]) == (0, 5, 0, None)
    (thing,) = facts["each"][0]["things"]
    assert thing["pixels"] == 480 and thing["box"] == [10, 14, 50, 26]
    assert thing["person"] == pytest.approx(0.999, abs=1e-3) and 0 < thing["mean_confidence"] < 0.6
    assert (pixels(tmp_path / "out" / "labels" / "7.png") == BACKGROUND).all()
    assert "1 things a frame that look like people got no label" in capsys.readouterr().err
    assert run(recording, "--focal", "100", "--keep-things", "--out", tmp_path / "all") == 0
    facts = report(tmp_path / "all")
    assert (facts["people"], facts["things"], facts["labelled"]) == (5, 0, 5 * 480)
    assert facts["finder"]["least_confidence_of_people"] == 0


def test_what_no_view_can_show_is_not_said_to_get_labels_by_an_option(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def narrow(range_m: Any, pixels: Any, *given: Any) -> Any:
        if len(pixels) > 1:
            raise BadConfig("too large")
        return view_body(range_m, pixels, *given)

    monkeypatch.setattr("bodyseg_model.segmentation.segmenter.view_body", narrow)
    assert run(recording / "7.png", "--focal", "100", "--out", tmp_path / "out") == 0
    assert report(tmp_path / "out")["things"] == 1 and "--keep-things" not in capsys.readouterr().err


def test_people_are_found_whatever_classes_a_network_has(
    recording: Path, tmp_path: Path, network: Places, monkeypatch: pytest.MonkeyPatch
) -> None:
    turned_round = LabelMap("turned round", tuple((name, (name,)) for name in reversed(LANDMARKS)))
    card = {"labels": turned_round.to_json(), "rig": SMALL.to_json()}
    monkeypatch.setattr(
        runtimes, "load_network", lambda run, dense=False: load_network(run) if run else Trained(network, card)
    )
    assert run(recording, "--focal", "100", "--out", tmp_path / "out") == 0
    assert report(tmp_path / "out")["people"] == 5


def test_another_finder_may_be_given(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    body = build("compact", {"patch": 8, "widths": [8], "blocks": [0], "classes": 2}, seed=1)
    save_network(tmp_path / "body.safetensors", body, "compact", {"labels": load_label_map("people").to_json()})
    said = refused(
        capsys, recording, "--focal", "100", "--finder", tmp_path / "body.safetensors", "--out", tmp_path / "out"
    )
    assert said.startswith("a finder of people needs 2 classes and the setting focal_px, found 2 classes and")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["limbs14", "densepose24"])
def test_a_network_of_classes_names_and_colours_them(recording: Path, tmp_path: Path, name: str) -> None:
    limbs = load_label_map(name)
    network = build("compact", {"patch": 16, "widths": [8], "blocks": [0], "classes": len(limbs)}, seed=1)
    save_network(tmp_path / "limbs.safetensors", network, "compact", {"labels": limbs.to_json()})
    out = tmp_path / "out"
    assert run(recording, "--focal", "100", "--out", out, "--run", tmp_path / "limbs.safetensors") == 0
    assert report(out)["labels"] == limbs.to_json()
    legend = {tuple(colour) for colour in pixels(out / "legend.png").reshape(-1, 3).tolist()}
    assert {tuple(colour) for colour in limbs.colours.tolist()} <= legend
    labels, overlay = pixels(out / "labels" / "7.png"), pixels(out / "overlay" / "7.png")
    body = labels != BACKGROUND
    assert body.sum() == 480 and labels[body].max() < len(limbs)
    np.testing.assert_allclose(overlay[body], limbs.colours[labels[body]], atol=1)
    trained = load_network(tmp_path / "limbs.safetensors")
    for each in (FrameLabeller(trained, device="cpu"), Segmenter(trained, trained.rig.camera)):
        assert each.background.mode == "people"
    words = "export-labels", str(out), "--out", str(tmp_path / "coco"), "--format", "coco"
    assert cli.main([*words]) == 0
    found = json.loads((tmp_path / "coco" / "annotations.json").read_text())["annotations"]
    assert {each["instance"] for each in found} == {1}, "people, not stuff"


def test_frames_that_are_skipped_at_the_end_are_counted(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (recording / "11.png").write_bytes(b"no picture")
    assert run(recording, "--focal", "100", "--skip-unreadable", "1", "--out", tmp_path / "out") == 0
    said = capsys.readouterr().err
    assert "segmenting: 5 of 5 frames" in said and "wrote 4 frames" in said
    assert [frame["name"] for frame in report(tmp_path / "out")["each"]] == ["7", "8", "9", "10"]


@pytest.mark.parametrize("listed", [False, True])
def test_a_frame_that_is_not_there_costs_no_other(
    listed: bool, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (recording / "8.png").unlink()
    if listed:  # as in sets of TUM's form that were copied in part
        (recording / "a").mkdir()
        for frame in recording.glob("*.png"):
            frame.rename(recording / "a" / frame.name)
        (recording / "depth.txt").write_text("".join(f"{n} a/{n}.png\n" for n in range(7, 12)))
    else:
        (recording / "8.png").symlink_to(tmp_path / "moved.png")
    words = (recording, "--focal", "100", "--out", tmp_path / "out")
    assert refused(capsys, *words).endswith("8.png: the file cannot be read: No such file or directory")
    assert not (tmp_path / "out").exists()
    assert run(*words, "--skip-unreadable", "1") == 1
    assert "8.png: the file cannot be read" in capsys.readouterr().err
    assert [frame["name"] for frame in report(tmp_path / "out")["each"]] == ["7", "9", "10", "11"]
