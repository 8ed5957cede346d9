"""Frames from files and folders, whatever strangers put into them."""

from __future__ import annotations

import os
import pickle
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bags import image, write_mcap, write_ros1, write_ros2
from kinect_mkv import write_mkv
from PIL import Image
from pngs import RAMP, png

from bodyseg_data.core import BadConfig
from bodyseg_model.recordings import Frame, evenly_apart, find_frames, metres_a_step, to_metres


def refusal(*paths: Path) -> str:
    with pytest.raises(BadConfig) as caught:
        find_frames(paths)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def names(frames: list[Frame]) -> list[str]:
    return [frame.name for frame in frames]


def test_a_frame_is_read_without_loss(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(png())
    (frame,) = find_frames([tmp_path / "a.png"])
    image = frame.read()
    assert image.dtype == np.uint16
    np.testing.assert_array_equal(image, RAMP)


def test_numbers_in_names_are_counted(tmp_path: Path) -> None:
    for name in ("f10", "f9", "f2b", "f2a", "f02c", "f", "g1", "f100"):
        (tmp_path / f"{name}.png").write_bytes(png())
    assert names(find_frames([tmp_path])) == ["f", "f2a", "f2b", "f02c", "f9", "f10", "f100", "g1"]


def test_folders_keep_only_frames_that_are_seen(tmp_path: Path) -> None:
    for name in ("1.png", "2.PNG", ".3.png", "._1.png", "notes.txt", "legend.jpg"):
        (tmp_path / name).write_bytes(png())
    (tmp_path / "4.png").mkdir()
    assert names(find_frames([tmp_path])) == ["1", "2"]


def test_files_come_first_and_groups_as_they_are_given(tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("z", "a")]
    for folder in folders:
        folder.mkdir()
        for number in (10, 9):
            (folder / f"{folder.name}{number}.png").write_bytes(png())
    recording = tmp_path / "m.npy"
    np.save(recording, np.stack([RAMP, RAMP]))
    for name in ("x11.png", "x3.png"):
        (tmp_path / name).write_bytes(png())
    found = find_frames([folders[0], recording, tmp_path / "x11.png", folders[1], tmp_path / "x3.png"])
    assert names(found) == ["x3", "x11", "z9", "z10", "0000", "0001", "a9", "a10"]


def test_what_is_not_there_or_empty_is_named(tmp_path: Path) -> None:
    assert refusal(tmp_path / "no.png") == f"cannot read {tmp_path / 'no.png'}: No such file or directory"
    kinds = ".bag, .db3, .mcap, .npy, .npz, .tif, .tiff, .mkv"
    assert (
        refusal(tmp_path)
        == f"a folder of frames must hold .png files or recordings ({kinds}), found none in {tmp_path}"
    )
    os.mkfifo(tmp_path / "pipe.png")
    assert refusal(tmp_path / "pipe.png") == f"cannot read {tmp_path / 'pipe.png'}: not a regular file"


def test_a_folder_that_cannot_be_listed_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "iterdir", refuse)
    assert refusal(tmp_path) == f"cannot read {tmp_path}: Permission denied"


def frames_in(folder: Path, *stems: str) -> Path:
    folder.mkdir(parents=True)
    for stem in stems:
        (folder / f"{stem}.png").write_bytes(png())
    return folder


def test_frames_of_one_name_get_the_names_of_their_folders(tmp_path: Path) -> None:
    left, right = frames_in(tmp_path / "left", "1", "2"), frames_in(tmp_path / "right", "1")
    found = find_frames([left, right])
    assert names(found) == ["left/1", "left/2", "right/1"]
    assert [frame.sequence for frame in found] == [1, 1, 2]
    assert names(find_frames([left / "1.png", right / "1.png"])) == ["left/1", "right/1"]
    recordings = [tmp_path / name for name in ("a.npy", "b.npy")]
    for recording in recordings:
        np.save(recording, np.stack([RAMP, RAMP]))
    assert names(find_frames(recordings)) == ["a/0000", "a/0001", "b/0000", "b/0001"]
    assert names(find_frames([left, frames_in(tmp_path / "other", "3")])) == ["1", "2", "3"]


@pytest.mark.parametrize("suffix", ["png", "npy", "tif"])
def test_files_of_one_frame_are_one_input_in_the_order_of_folders_and_names(suffix: str, tmp_path: Path) -> None:
    places = [tmp_path / folder / f"{name}.{suffix}" for folder in ("b2", "b10") for name in ("f2", "f10")]
    for path in places:
        path.parent.mkdir(exist_ok=True)
        if suffix == "npy":
            np.save(path, RAMP)
        else:
            Image.fromarray(RAMP).save(path)
    np.save(tmp_path / "a.npy", np.stack([RAMP, RAMP]))
    found = find_frames([tmp_path / "a.npy", *sorted(places)])
    assert [(frame.path, frame.sequence) for frame in found[:4]] == [(path, 0) for path in places]
    assert [(frame.index, frame.sequence) for frame in found[4:]] == [(0, 1), (1, 1)]


def test_as_many_folders_as_needed_tell_frames_apart(tmp_path: Path) -> None:
    folders = [frames_in(tmp_path / day / "left", "1") for day in ("monday", "tuesday")]
    assert names(find_frames(folders)) == ["monday/left/1", "tuesday/left/1"]


def test_one_frame_given_twice_is_refused(tmp_path: Path) -> None:
    left = frames_in(tmp_path / "left", "1")
    message = refusal(left, left / "1.png")
    assert message == f"two frames must not have one name, as their results would: {left / '1.png'}, {left / '1.png'}"


@pytest.mark.parametrize("name", [" a.png", "a*b.png", "a\nb.png", "x" * 101 + ".png"])
def test_a_name_must_do_for_the_results(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(png())
    assert refusal(tmp_path / name).startswith("a frame's name, which its results get, must be")


@pytest.mark.parametrize("name", ["Jose\u0301", "\u092b\u094d\u0930\u0947\u092e", "2021-03-04T12:30:55,5 #1@a=b"])
def test_names_may_have_accents_of_their_own_and_times(name: str, tmp_path: Path) -> None:
    (tmp_path / f"{name}.png").write_bytes(png(RAMP))
    assert [frame.name for frame in find_frames([tmp_path])] == [name]


def test_a_frame_that_cannot_be_opened_or_has_shrunk_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(png())
    (frame,) = find_frames([path])
    path.write_bytes(png()[:-3])
    with pytest.raises(BadConfig, match=r"a\.png: the file must still have the \d+ bytes it had, found \d+$"):
        frame.read()
    path.unlink()
    with pytest.raises(BadConfig, match=r"a\.png: the file cannot be read: No such file"):
        frame.read()


def test_files_beyond_reason_are_not_read(tmp_path: Path) -> None:
    with (tmp_path / "a.png").open("wb") as file:
        file.truncate(1 << 29)
    assert f"a.png: a frame must have at most {1 << 28} bytes, found {1 << 29}" in refusal(tmp_path / "a.png")


# Units.


@pytest.mark.parametrize(
    ("unit", "metres"), [("mm", 1e-3), ("0.1mm", 1e-4), ("1 cm", 1e-2), (".2mm", 2e-4), ("0.001m", 1e-3), ("5mm", 5e-3)]
)
def test_units(unit: str, metres: float) -> None:
    assert metres_a_step(unit) == pytest.approx(metres, rel=1e-12)


@pytest.mark.parametrize(
    "unit", ["", "m", "inch", "0mm", "-1mm", "mm2", "1e-3m", "nan mm", "11cm", "0.0001mm", "9" * 400 + "mm"]
)
def test_what_is_no_unit(unit: str) -> None:
    with pytest.raises(BadConfig, match=f"^a unit must be .* found {unit!r}$"):
        metres_a_step(unit)


def test_nothing_and_too_much_are_nothing() -> None:
    ranges = to_metres(np.array([[0, 1, 2500, 65534, 65535]], np.uint16), 1e-3)
    assert ranges.dtype == np.float32
    np.testing.assert_allclose(ranges, [[0, 0.001, 2.5, 65.534, 0]], rtol=1e-6)
    with pytest.raises(BadConfig, match="^a frame's steps must be whole numbers, found float32: it may be in metres"):
        to_metres(ranges, 1e-3)  # type: ignore[arg-type]


def test_frames_are_chosen_evenly_from_the_first_to_the_last() -> None:
    assert evenly_apart(10, 3) == [0, 4, 9] and evenly_apart(2, 9) == [0, 1] and evenly_apart(5, 1) == [0]


def test_a_folder_of_any_bytes_has_a_hash(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"\xff")
    folder.mkdir()
    (folder / "1.png").write_bytes(png(RAMP))
    (frame,) = find_frames([folder])
    assert len(frame.path_id) == 16 and frame.path_id != replace(frame, path=tmp_path / "1.png").path_id


NOISE = np.random.default_rng(0).integers(1, 60000, (8, 60, 80), np.uint16)  # which nothing packs into one buffer


def written(kind: str, path: Path) -> list[Frame]:
    """Frames of `NOISE`, in a file that its reader keeps open or keeps pieces of."""
    path /= f"noise.{kind}"
    messages = [image(each, "16UC1", time_s) for time_s, each in enumerate(NOISE)]
    if kind == "npz":
        np.savez_compressed(path, depth=NOISE)
    elif kind == "mkv":
        write_mkv(path, {"DEPTH": NOISE})
    elif kind == "bag":
        write_ros1(path, messages, chunk_size=1)
    elif kind == "ros2":
        write_ros2(path, messages)
    else:
        write_mcap(path, messages, chunk_size=1)
    return find_frames([path])


@pytest.mark.parametrize("kind", ["npz", "mkv", "bag", "mcap"])
def test_threads_may_read_a_recording_at_once(kind: str, tmp_path: Path) -> None:
    frames, before = written(kind, tmp_path), sys.getswitchinterval()

    def read(number: int) -> bool:
        return np.array_equal(frames[number].read(), NOISE[number])

    try:
        sys.setswitchinterval(1e-6)
        with ThreadPoolExecutor(2) as pool:
            assert all(pool.map(read, [*range(8), *range(8)[::-1]] * 10))
    finally:
        sys.setswitchinterval(before)


@pytest.mark.parametrize("kind", ["npz", "mkv", "bag", "ros2", "mcap"])
def test_frames_are_pickled_after_some_are_read(kind: str, tmp_path: Path) -> None:
    frames = written(kind, tmp_path)
    frames[3].read()
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(frames))[4].read(), NOISE[4])
    np.testing.assert_array_equal(frames[4].read(), NOISE[4])


@pytest.mark.parametrize("kind", ["npz", "mkv", "bag"])
def test_a_fork_leaves_its_parents_recording_where_it_is(kind: str, tmp_path: Path) -> None:
    frames = written(kind, tmp_path)
    for number in range(7):
        np.testing.assert_array_equal(frames[number].read(), NOISE[number])
        child = os.fork()
        if not child:
            same = False
            try:
                same = all(np.array_equal(frames[n].read(), NOISE[n]) for n in range(number + 1, 8))
            finally:
                os._exit(0 if same else 1)
        assert os.waitpid(child, 0)[1] == 0
    np.testing.assert_array_equal(frames[7].read(), NOISE[7])
