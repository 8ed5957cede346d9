"""Recordings in NPY, NPZ and TIFF files and in folders with times, and what is refused of them."""

from __future__ import annotations

import io
import os
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pngs import RAMP, png

from bodyseg_data.core import BadConfig
from bodyseg_model.recordings import find_frames, to_metres
from bodyseg_model.recordings.camera_files import cameras_beside
from bodyseg_model.recordings.formats.tiff import open_tiff
from bodyseg_model.recordings.frames import open_recording

STACK = np.stack([RAMP, RAMP[::-1], RAMP // 2])


def refusal(path: Path, topic: str | None = None) -> str:
    with pytest.raises(BadConfig) as caught:
        open_recording(path, topic)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def broken(path: Path, index: int = 0) -> str:
    with pytest.raises(BadConfig) as caught:
        open_recording(path)[index].read()
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    return str(caught.value)


def check_stack(path: Path, topic: str | None = None) -> None:
    recording = open_recording(path, topic)
    assert len(recording) == 3 and recording[0].camera is None and recording[0].step_m == 1e-3
    for number in (0, 2, 1):
        pixels = recording[number].read()
        assert pixels.dtype == np.uint16
        np.testing.assert_array_equal(pixels, STACK[number])
    assert len({frame.path_id for frame in recording}) == 3


def test_an_array_of_frames_is_read_frame_by_frame(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", STACK)
    check_stack(tmp_path / "a.npy")
    np.save(tmp_path / "big.npy", STACK.astype(">u2"))
    check_stack(tmp_path / "big.npy")
    for number, one in enumerate((STACK[:, None], STACK[..., None])):
        np.save(tmp_path / f"one-{number}.npy", one)
        check_stack(tmp_path / f"one-{number}.npy")
        np.savez(tmp_path / f"one-{number}.npz", depth=one)
        check_stack(tmp_path / f"one-{number}.npz")
    np.savez_compressed(tmp_path / "a.npz", depth=STACK, K=np.eye(3), note=np.array("x"))
    check_stack(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", f10=STACK[2], f9=STACK[1], f1=STACK[0])
    check_stack(tmp_path / "b.npz")
    np.savez(tmp_path / "c.npz", depth=STACK, infrared=STACK // 3)
    check_stack(tmp_path / "c.npz", "depth")
    check_stack(tmp_path / "c.npz")
    np.savez(tmp_path / "d.npz", left=STACK, right=STACK // 3)
    assert "choose one by --topic: left, right" in refusal(tmp_path / "d.npz")
    assert "one of depth, infrared, found 'colour'" in refusal(tmp_path / "c.npz", "colour")
    (tmp_path / "unnamed").write_bytes((tmp_path / "a.npy").read_bytes())
    check_stack(tmp_path / "unnamed")


def test_floating_point_is_metres(tmp_path: Path) -> None:
    metres = np.zeros((60, 84))
    metres[0, :8] = 1.2345, 16.5, -1, np.nan, np.inf, 0.0001, 2.0, 16.38
    expected = [1.2345, 0, 0, 0, 0, 0, 2.0, 16.38]
    for kind in (np.float64, np.float32):
        np.save(tmp_path / "a.npy", metres.astype(kind))
        (frame,) = find_frames([tmp_path / "a.npy"])
        assert frame.name == "a" and frame.member is None
        np.testing.assert_allclose(to_metres(frame.read(), frame.step_m)[0, :8], expected, atol=1.3e-4)
    half = np.linspace(0.5, 16.3, 5000).astype(np.float16).reshape(50, 100)  # steps of it have no 16 bits of their own
    np.save(tmp_path / "half.npy", half)
    (frame,) = open_recording(tmp_path / "half.npy")
    np.testing.assert_allclose(frame.read() * frame.step_m, half.astype(float), atol=1.3e-4)
    (frame,) = find_frames([tmp_path / "a.npy"], step_m=1e-3)  # floating point in millimetres
    assert to_metres(frame.read() * 1, frame.step_m)[0, 7] == pytest.approx(0.0165, abs=2e-4)


def test_times_come_with_arrays_and_lists(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", depth=STACK, times=np.array([5.0, 5.5, 6.25]))
    assert [frame.time_s for frame in open_recording(tmp_path / "a.npz")] == [5.0, 5.5, 6.25]
    np.savez(tmp_path / "b.npz", depth=STACK, times=np.array([5.0, 5.5]))
    assert "times must be as many as frames, found 2 for 3" in refusal(tmp_path / "b.npz")
    np.savez(tmp_path / "c.npz", depth=STACK, times=np.eye(3))
    assert "'times' must hold one time a frame, seconds" in refusal(tmp_path / "c.npz")
    np.savez(tmp_path / "d.npz", depth=STACK, times=np.array([0, 1, 2]) + 1_700_000_000_000)
    said = "'times' must hold seconds, found 1.7e+12: are they milli- or nanoseconds?"
    assert said in refusal(tmp_path / "d.npz"), "no message can have such a time"
    for time, written in ((2**31, "2.14748e+09"), (-(2**31), "-2.14748e+09"), (np.nan, "nan")):
        np.savez(tmp_path / "e.npz", depth=STACK, times=np.array([0, time, 1]))
        assert f"seconds, found {written}: are" in refusal(tmp_path / "e.npz")
    np.savez(tmp_path / "f.npz", depth=STACK, times=np.array([0, 2**31 - 1, 1 - 2**31]))
    assert open_recording(tmp_path / "f.npz")[2].time_s == 1 - 2**31


def tum(folder: Path, lines: str) -> Path:
    (folder / "depth").mkdir(parents=True)
    for name in ("1.25", "0.75"):
        (folder / "depth" / f"{name}.png").write_bytes(png())
    (folder / "depth.txt").write_text(lines)
    return folder


def test_a_list_with_times_gives_order_and_unit(tmp_path: Path) -> None:
    folder = tum(tmp_path / "a", "# depth maps\n\n1.25 depth/1.25.png\n0.75  depth/0.75.png\n")
    frames = find_frames([folder])
    assert [(frame.name, frame.time_s, frame.step_m) for frame in frames] == [
        ("1.25", 1.25, 1 / 5000),
        ("0.75", 0.75, 1 / 5000),
    ]
    np.testing.assert_array_equal(frames[0].read(), RAMP)
    assert find_frames([folder], step_m=0.01)[0].step_m == 0.01
    (folder / "depth.txt").write_text("-2147483647.5 depth/1.25.png\n2147483647.5 depth/0.75.png\n")
    assert [frame.time_s for frame in find_frames([folder])] == [0.5 - 2**31, 2**31 - 0.5]
    (folder / "seen.png").write_bytes(png())
    assert [frame.name for frame in find_frames([folder])] == ["seen"], "a folder's own PNGs come first, as ever"


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("1.25 ../../etc/passwd", "a line must hold a time, seconds, and a file in the folder"),
        ("1.25 /etc/passwd", "a line must hold a time, seconds, and a file in the folder"),
        ("nan depth/1.25.png", "a line must hold a time"),
        ("2147483648 depth/1.25.png", "a line must hold a time, seconds, and"),
        ("depth/1.25.png", "a line must hold a time"),
        ("# nothing", "must name at least one, found none"),
    ],
)
def test_lists_of_frames_are_checked(tmp_path: Path, lines: str, message: str) -> None:
    assert message in refusal(tum(tmp_path / "a", lines))


def test_a_listed_frame_that_is_not_there_tells_so_when_it_is_read(tmp_path: Path) -> None:
    assert "No such file" in broken(tum(tmp_path / "a", "1.25 depth/1.25.png\n1.5 depth/no.png"), 1)


def test_a_list_that_is_no_text_is_refused(tmp_path: Path) -> None:
    folder = tum(tmp_path / "a", "")
    (folder / "depth.txt").write_bytes(b"\xff\xfe")
    assert "a list of frames must be text" in refusal(folder)
    with (folder / "depth.txt").open("wb") as file:
        file.truncate(1 << 27)
    assert "depth.txt is larger than 67108864 bytes" in refusal(folder)
    assert "found a folder with depth.txt" in refusal(folder, "a")


def save_tiff(path: Path, pages: list[np.ndarray[Any, Any]]) -> Path:
    first, *others = (Image.fromarray(page) for page in pages)
    first.save(path, save_all=True, append_images=others)
    return path


def test_pages_of_a_tiff_are_frames(tmp_path: Path) -> None:
    check_stack(save_tiff(tmp_path / "a.tif", list(STACK)))
    path = save_tiff(tmp_path / "b.tiff", [np.full((4, 6), 1.5, np.float32)])
    (frame,) = open_recording(path)
    assert (frame.read() == 6000).all() and frame.step_m == 2.5e-4
    path = save_tiff(tmp_path / "c.tif", [np.zeros((4, 6, 3), np.uint8)])
    assert "found 'RGB' of 4 x 6" in refusal(path)
    assert "found a TIFF" in refusal(path, "a")


def test_recordings_in_a_folder_go_on_where_their_times_do(tmp_path: Path) -> None:
    untimed, times_of = {"0": None, "5": None}, {"1": [0.0, 0.1], "2": [0.1, 1.0], "3": [2.1, 2.2], "4": [2.0, 2.5]}
    for name, times in {**untimed, **times_of}.items():
        np.savez(tmp_path / f"{name}.npz", depth=STACK[:2], **({} if times is None else {"timestamps": times}))
    np.save(tmp_path / "6.npy", STACK[:2])
    assert [frame.sequence for frame in open_recording(tmp_path)] == [0, 0, 1, 1, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
    np.save(tmp_path.parent / "other.npy", STACK[:2])
    found = find_frames([tmp_path, tmp_path.parent / "other.npy"])
    assert [frame.sequence for frame in found] == [1, 1, 2, 2, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7]
    np.save(tmp_path / "7.npy", STACK[0])
    np.save(tmp_path / "8.npy", STACK[1])
    assert [frame.sequence for frame in open_recording(tmp_path)][12:] == [5, 5, 6, 6]


def test_a_folder_of_recordings_is_one(tmp_path: Path) -> None:
    for number in (10, 9):
        np.save(tmp_path / f"f{number}.npy", STACK[number - 9])
    (tmp_path / "notes.txt").write_text("x")
    frames = find_frames([tmp_path])
    assert [frame.name for frame in frames] == ["f9", "f10"] and {frame.sequence for frame in frames} == {1}
    np.testing.assert_array_equal(frames[1].read(), STACK[1])
    np.save(tmp_path / "f11.npy", STACK)
    assert [frame.name for frame in find_frames([tmp_path])][2:] == ["0000", "0001", "0002"]


@pytest.mark.parametrize(
    ("depth", "colour"),
    [
        ("frame-{:06d}.depth.png", "frame-{:06d}.color.png"),  # 7-Scenes
        ("scene_{}_depth.png", "scene_{}.png"),
        ("depth_{}.png", "rgb_{}.png"),
        ("depth{:03d}.png", "colour{:03d}.png"),
        ("depth/{}.png", "color/{}.jpg"),  # ScanNet, exported
        ("depth_raw/{}.png", "rgb/{}.png"),
    ],
)
def test_depth_beside_colour_is_read_alone(tmp_path: Path, depth: str, colour: str) -> None:
    for number in range(3):
        for name, data in ((depth, png(STACK[number])), (colour, png(np.zeros((4, 6), np.uint8)))):
            path = tmp_path / "recording" / name.format(number)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
    (tmp_path / "recording" / "frame-000000.pose.txt").write_text("1 0 0 0")
    frames = find_frames([tmp_path / "recording"])
    assert len(frames) == 3
    for frame, values in zip(frames, STACK, strict=True):
        np.testing.assert_array_equal(frame.read(), values)


def test_infrared_beside_depth_of_another_format_is_no_range(tmp_path: Path) -> None:
    """PNGs come first only among files of one kind: frames of infrared show nobody."""
    for number in range(3):
        (tmp_path / f"ir_{number}.png").write_bytes(png())
        np.save(tmp_path / f"depth_{number}.npy", STACK[number])
    assert [frame.name for frame in find_frames([tmp_path])] == ["depth_0", "depth_1", "depth_2"]


def test_depth_beside_colour_is_read_alone_whatever_arrays_are_beside_it(tmp_path: Path) -> None:
    for number in range(3):
        for kind in ("color", "depth"):
            (tmp_path / f"{kind}_{number}.png").write_bytes(png())
        for kind in ("pose", "mask", "normals", "camera"):
            np.save(tmp_path / f"{kind}_{number}.npy", STACK[number])
    assert [frame.name for frame in find_frames([tmp_path])] == ["depth_0", "depth_1", "depth_2"]


def test_one_name_with_depth_among_many_chooses_nothing(tmp_path: Path) -> None:
    for name in ("0", "1", "2", "3", "depth"):
        (tmp_path / f"{name}.png").write_bytes(png())
    assert len(find_frames([tmp_path])) == 5


def test_a_camera_beside_a_file_is_that_of_all_its_frames(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", STACK)
    (tmp_path / "a.json").write_text('{"fx": 100, "fy": 100, "cx": 42, "cy": 30}')
    cameras = cameras_beside(find_frames([tmp_path / "a.npy"]))
    assert [camera.fx for camera in cameras if camera is not None] == [100.0] * 3


def test_arrays_of_other_shapes_and_types_are_refused(tmp_path: Path) -> None:
    wrong = {
        "float16 is read": (np.ones((4, 6), np.float16), None),
        "8 bits": (np.ones((4, 6), np.uint8), "say by --units what a step is, found uint8"),
        "complex": (np.ones((4, 6), np.complex64), "found complex64"),
        "text": (np.full((4, 6), "a"), "found <U1"),
        "one number": (np.array(3.0), "found one number"),
        "too many sides": (np.ones((2, 2, 4, 6)), "found 2 x 2 x 4 x 6"),
        "too large": (np.zeros((1, 5000), np.uint16), "found 1 x 5000"),
        "no frame": (np.zeros((0, 4, 6), np.uint16), "a recording must hold 1 to 1048576 frames, found none"),
    }
    for values, message in wrong.values():
        np.save(tmp_path / "a.npy", values)
        if message is None:
            assert (open_recording(tmp_path / "a.npy")[0].read() == 4000).all()
        else:
            assert message in refusal(tmp_path / "a.npy")
    np.savez(tmp_path / "a.npz", a1=np.ones((9, 9), np.uint16), a2=np.ones((9, 9)))
    assert "must all be whole numbers or all floating point" in refusal(tmp_path / "a.npz")
    assert "found an NPY file" in refusal(tmp_path / "a.npy", "a")
    with pytest.raises(BadConfig, match="recordings that hold several, found PNG files"):
        (tmp_path / "a.png").write_bytes(png())
        open_recording(tmp_path / "a.png", "a")


def test_floating_point_in_millimetres_is_no_empty_room(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", 1500 + RAMP.astype(np.float32) / 100)
    with pytest.raises(BadConfig, match="a.npy.*: a frame must be in metres, found nothing nearer than 1500: "):
        open_recording(tmp_path / "a.npy")[0].read()
    assert open_recording(tmp_path / "a.npy", None, 0.001)[0].read().all()


@pytest.mark.parametrize("kind", [np.int16, np.int32, np.uint32, np.int64, np.uint64, ">i4"])
def test_whole_numbers_of_any_size_are_steps(tmp_path: Path, kind: str) -> None:
    """What is below 0 was not measured; what 16 bits cannot hold is refused, not wrapped around."""
    values = RAMP.astype(kind)
    if values.dtype.kind == "i":
        values[0, :2] = -1, -32768
    expected = np.where(values.astype(np.int64) > 0, RAMP, 0)
    np.save(tmp_path / "a.npy", values)
    save_tiff(tmp_path / "a.tif", [values.astype(np.int32)])
    for name in ("a.npy", "a.tif"):
        np.testing.assert_array_equal(open_recording(tmp_path / name)[0].read(), expected)
    if values.dtype.itemsize > 2:
        values[3, 3] = 70_000
        np.save(tmp_path / "a.npy", values)
        assert "steps must be at most 65535, found 70000" in broken(tmp_path / "a.npy")


def test_eight_bits_are_steps_of_a_given_unit(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.full((6, 8), 25, np.uint8))
    np.savez(tmp_path / "a.npz", depth=np.full((6, 8), 25, np.uint8))
    for name in ("a.npy", "a.npz"):
        (frame,) = open_recording(tmp_path / name, step_m=0.1)
        np.testing.assert_allclose(to_metres(frame.read(), frame.step_m), 2.5)
        assert "--units" in refusal(tmp_path / name)


def test_a_last_side_of_one_is_no_side_and_colours_are_refused(tmp_path: Path) -> None:
    for order in ("C", "F"):
        one, several = RAMP[..., np.newaxis].copy(order), STACK[..., np.newaxis].copy(order)
        np.save(tmp_path / "several.npy", several)
        check_stack(tmp_path / "several.npy")
        np.savez(tmp_path / "several.npz", depth=several)
        check_stack(tmp_path / "several.npz")
        np.save(tmp_path / "one.npy", one)
        np.savez(tmp_path / "one.npz", depth=one, colour=np.zeros((60, 84, 3), np.uint8))
        for name in ("one.npy", "one.npz"):
            (frame,) = open_recording(tmp_path / name)
            np.testing.assert_array_equal(frame.read(), RAMP)
            assert frame.read().flags.c_contiguous
    for last in (2, 3, 4):
        for kind in (np.uint16, np.float32):
            np.save(tmp_path / "a.npy", np.ones((60, 84, last), kind))
            found = refusal(tmp_path / "a.npy")
            assert f"frames must be H x W or N x H x W, found 60 x 84 x {last}" in found


def test_arrays_in_fortrans_order_are_read(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.asfortranarray(STACK))
    check_stack(tmp_path / "a.npy")
    np.savez_compressed(tmp_path / "a.npz", depth=np.asfortranarray(STACK))
    check_stack(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", **{f"f{number}": np.asfortranarray(STACK[number]) for number in range(3)})
    check_stack(tmp_path / "b.npz")
    assert open_recording(tmp_path / "a.npz")[1].read().flags.c_contiguous


@pytest.mark.parametrize(
    ("depth", "beside"),
    [
        ("depth", ("infrared",)),
        ("depth", ("confidence", "rgb_grey")),
        ("depth_m", ("depth_confidence", "depth_mask")),
        ("z", ("amplitude",)),
        ("range", ("intensity", "ir")),
        ("rawDepth", ("IR",)),
    ],
)
def test_arrays_beside_the_range_are_no_frames(tmp_path: Path, depth: str, beside: tuple[str, ...]) -> None:
    near = RAMP % 9000
    for floating in (False, True):
        values, others = (each.astype(np.float32) if floating else each for each in (near, np.full_like(near, 900)))
        np.savez(tmp_path / "a.npz", **{depth: values / 1000 if floating else values}, **dict.fromkeys(beside, others))
        (frame,) = open_recording(tmp_path / "a.npz")
        np.testing.assert_allclose(frame.read() * frame.step_m, near / 1000, atol=1.3e-4)
    np.savez(tmp_path / "a.npz", depth=RAMP, mask=RAMP > 3)
    assert len(open_recording(tmp_path / "a.npz")) == 1, "a mask is no frame"
    many = {f"{name}_{number}": RAMP // (number + 1) for name in (depth, *beside) for number in range(3)}
    np.savez(tmp_path / "many.npz", **many)
    frames = open_recording(tmp_path / "many.npz")
    assert len(frames) == 3
    np.testing.assert_array_equal(frames[2].read(), RAMP // 3)


def test_arrays_of_several_names_are_asked_for(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", first=RAMP, amplitude=RAMP)
    found = refusal(tmp_path / "a.npz")
    assert found == f"several arrays hold frames, choose one by --topic: amplitude, first ({tmp_path / 'a.npz'})"
    (frame,) = open_recording(tmp_path / "a.npz", "first")
    np.testing.assert_array_equal(frame.read(), RAMP)
    np.savez(tmp_path / "b.npz", left_0=RAMP, left_1=RAMP, right_0=RAMP, right_1=RAMP)
    assert "choose one by --topic: left, right" in refusal(tmp_path / "b.npz")
    assert len(open_recording(tmp_path / "b.npz", "left")) == 2
    (frame,) = open_recording(tmp_path / "b.npz", "left_1")
    assert frame.where == f"{tmp_path / 'b.npz'}: left_1"
    np.savez(tmp_path / "c.npz", depth1=STACK, depth2=STACK // 2)
    assert "choose one by --topic: depth1, depth2" in refusal(tmp_path / "c.npz"), "each is a recording"
    np.savez(tmp_path / "d.npz", frames=STACK, mean=RAMP, pose=np.eye(4), K=np.eye(5, dtype=np.uint8)[:4])
    check_stack(tmp_path / "d.npz")
    np.savez(tmp_path / "e.npz", first=RAMP, pose=np.eye(4))
    assert len(open_recording(tmp_path / "e.npz")) == 1


def test_pages_of_64_bits_are_metres(tmp_path: Path) -> None:
    tifffile = pytest.importorskip("tifffile")
    for order in "<>":
        metres = np.where(RAMP % 3, 1.25, np.nan)
        tifffile.imwrite(tmp_path / "a.tif", metres.astype(f"{order}f8"), byteorder=order)
        (frame,) = open_recording(tmp_path / "a.tif")
        np.testing.assert_array_equal(frame.read(), np.where(RAMP % 3, 5000, 0))
    save_tiff(tmp_path / "b.tif", [np.zeros((4, 6), np.uint8)])
    assert refusal(tmp_path / "b.tif").startswith(f"{tmp_path / 'b.tif'}: a page must be grey of 16 or 32 bits")


@pytest.mark.parametrize("kind", ["u2", "i2", "i4", "f4", "f8"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_compressed_pages_are_read_in_their_order_of_bytes(tmp_path: Path, order: str, kind: str) -> None:
    tifffile = pytest.importorskip("tifffile")
    steps = RAMP // 5
    values = steps / 1000 if kind[0] == "f" else steps
    tifffile.imwrite(tmp_path / "a.tif", values.astype(order + kind), byteorder=order, compression="zlib")
    (frame,) = open_recording(tmp_path / "a.tif")
    np.testing.assert_allclose(frame.read() * frame.step_m, steps / 1000, atol=1e-6)


def test_pickled_objects_are_never_loaded(tmp_path: Path) -> None:
    objects = np.array([print, None], dtype=object)
    np.save(tmp_path / "a.npy", objects, allow_pickle=True)
    assert "must be a whole NPY file of numbers" in refusal(tmp_path / "a.npy")


def test_a_header_that_is_no_python_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", STACK)
    data = (tmp_path / "a.npy").read_bytes().replace(b"(3, 60, 84)", b"((((((((((3")
    (tmp_path / "a.npy").write_bytes(data)
    assert "must be a whole NPY file of numbers" in refusal(tmp_path / "a.npy")


def test_truncated_files_are_one_line(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", STACK)
    np.savez_compressed(tmp_path / "a.npz", depth=STACK)
    save_tiff(tmp_path / "a.tif", list(STACK))
    for name, title in (("a.npy", "a whole NPY file"), ("a.npz", "a whole NPZ file"), ("a.tif", "a whole TIFF")):
        path = tmp_path / name
        whole = path.read_bytes()
        for size in (10, len(whole) // 2):
            path.write_bytes(whole[:size])
            assert title in refusal(path)
        path.write_bytes(whole)
        frame = open_recording(path)[0]
        if name != "a.npy":  # a map into memory must not be cut
            path.write_bytes(whole[:100])
            with pytest.raises(BadConfig, match="cannot be read|must be whole"):
                frame.read()
        path.write_bytes(b"")
        refusal(path)


def test_an_array_that_shrinks_while_it_is_read_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    np.save(path, np.full((4, 480, 640), 2000, np.uint16))
    frames, size = open_recording(path), path.stat().st_size
    assert frames[3].read().max() == 2000
    os.truncate(path, 1000)
    with pytest.raises(BadConfig, match=rf"a.npy, frame 3: the file must still have the {size} bytes it had, found 10"):
        frames[3].read()
    path.unlink()
    with pytest.raises(BadConfig, match=r"a.npy, frame 3: the file cannot be read"):
        frames[3].read()


def test_damage_within_a_zip_is_of_its_frames(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", depth=np.random.default_rng(0).integers(0, 999, (5, 90, 90), np.uint16))
    data = bytearray((tmp_path / "a.npz").read_bytes())
    data[len(data) // 2] ^= 255
    (tmp_path / "a.npz").write_bytes(bytes(data))
    assert "the array 'depth' must be whole" in broken(tmp_path / "a.npz", 4)
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": "<u2", "fortran_order": False, "shape": (9, 60, 84)})
    with zipfile.ZipFile(tmp_path / "b.npz", "w") as archive:
        archive.writestr("depth.npy", buffer.getvalue() + bytes(60 * 84 * 2))
    assert "bytes that it declares, found 9 x 60 x 84 of uint16, in 10208 bytes" in refusal(tmp_path / "b.npz")


@pytest.mark.parametrize("packing", [None, "tiff_adobe_deflate", "tiff_lzw"])
@pytest.mark.parametrize("big", [False, True])
def test_a_page_is_read_by_its_offset(packing: str | None, big: bool, tmp_path: Path) -> None:
    pages, path = [Image.fromarray(image) for image in STACK], tmp_path / "stack"
    pages[0].save(path, "TIFF", save_all=True, append_images=pages[1:], compression=packing, big_tiff=big)
    check_stack(path)
    data = bytearray(path.read_bytes())
    head = open_tiff(path, None, None)[1].source.starts[1]  # type: ignore[attr-defined]
    second = int.from_bytes(head[len(head) // 2 :], "little")
    data[second + 8 : second + 24] = b"\xff" * 16  # its tags, but not how many
    path.write_bytes(data)
    assert np.array_equal(open_recording(path)[2].read(), STACK[2])
    assert "page 1 of the TIFF cannot be read" in broken(path, 1)


def test_a_page_that_libtiff_cannot_read_is_not_empty(tmp_path: Path) -> None:
    """Pillow leaves the pixels of a compressed page that does not say where its data are, and raises nothing."""
    pages, path = [Image.fromarray(image) for image in STACK], tmp_path / "stack.tif"
    pages[0].save(path, save_all=True, append_images=pages[1:], compression="tiff_lzw")
    data = path.read_bytes()
    start = int.from_bytes(open_tiff(path, None, None)[1].source.starts[1][4:], "little")  # type: ignore[attr-defined]
    entry = data.index(struct.pack("<H", 273), start)
    path.write_bytes(data[:entry] + bytes(2) + data[entry + 2 :])
    assert "page 1 of the TIFF cannot be read" in broken(path, 1)
    assert np.array_equal(open_recording(path)[2].read(), STACK[2])


def tiff(rest: bytes, **tags: int) -> bytes:
    """A TIFF of 16 x 16 pixels of 16 bits; tags: further ones, as "t322"."""
    known = {256: 16, 257: 16, 258: 16, 259: 8, 262: 1, 277: 1} | {int(name[1:]): tags[name] for name in tags}
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, known[tag]) for tag in sorted(known))
    return b"II*\0" + struct.pack("<IH", 8, len(known)) + entries + rest


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"II*\0" + struct.pack("<IH", 8, 65535) + bytes(99), "page 0 lies beyond its end: byte 8"),
        (b"II+\0" + struct.pack("<HHQQ", 8, 0, 16, 1 << 62) + bytes(99), "page 0 lies beyond its end: byte 16"),
        (b"MM\0*" + bytes(3), "page 0 lies beyond its end"),
        (b"II*\0" + struct.pack("<IHI", 8, 0, 1 << 31), "page 1 lies beyond its end: byte 2147483648"),
        (
            b"II*\0" + b"".join(struct.pack("<IH", 8 + 6 * page, 0) for page in range(9)) + bytes(4),
            "more than 8 pages",
        ),
        (tiff(bytes(4), t256=40_000, t257=40_000), "page 0 of the TIFF cannot be read"),
        (tiff(bytes(4), t322=32_768, t323=32_768, t324=8, t325=8), "at most 4096 a side"),
    ],
)
def test_tiffs_that_lie(data: bytes, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bodyseg_model.recordings.formats.tiff.MOST_FRAMES", 8)
    (tmp_path / "a.tif").write_bytes(data)
    assert message in refusal(tmp_path / "a.tif")


def test_a_zip_is_listed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = {f"f{number}": RAMP + np.uint16(number) for number in range(12)}
    np.savez(tmp_path / "stored.npz", **images)
    np.savez_compressed(tmp_path / "packed.npz", **images)
    np.savez(tmp_path / "stack.npz", depth=np.stack([*images.values()]))
    opened, opener = [], zipfile.ZipFile

    def count(*words: Any, **options: Any) -> zipfile.ZipFile:
        opened.append(words)
        return opener(*words, **options)

    monkeypatch.setattr(zipfile, "ZipFile", count)
    for name in ("stored", "packed", "stack"):
        opened.clear()
        frames = open_recording(tmp_path / f"{name}.npz")
        for number in (0, 11, 3, 3, 4):
            assert np.array_equal(frames[number].read(), images[f"f{number}"])
        assert len(opened) == 2


@pytest.mark.parametrize("shape", [(10**9, 10, 10), (10**9, 8, 8, 1), (-1, 9, 9), (10**5, 10**5)])
def test_an_array_has_the_bytes_that_it_declares(shape: tuple[int, ...], tmp_path: Path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<u2", "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("depth.npy", header.getvalue())
    size = (tmp_path / "a.npz").stat().st_size
    assert size < 400 and "an array must have the bytes that it declares" in refusal(tmp_path / "a.npz")


def test_frames_are_counted_before_they_are_listed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bodyseg_model.recordings.recording.MOST_FRAMES", 2)
    np.save(tmp_path / "a.npy", STACK)
    np.savez_compressed(tmp_path / "a.npz", STACK)
    for name in ("a.npy", "a.npz"):
        assert "1 to 2 frames, found 3" in refusal(tmp_path / name)
