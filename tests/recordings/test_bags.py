"""Recordings in ROS 1 bags, ROS 2 bags and MCAP files, written with the libraries of users' tools."""

from __future__ import annotations

import sqlite3
import struct
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from bags import (
    DEPTH,
    INFO,
    ROS2,
    Message,
    built,
    camera_info,
    compressed,
    compressed_depth,
    image,
    write_mcap,
    write_ros1,
    write_ros2,
)
from damaged_recordings import reads_or_refuses
from mcap.writer import CompressionType, IndexType, Writer
from pngs import RAMP, png
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rvl_encoder import encode_rvl

from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_data.labels import PARTS33
from bodyseg_data.rigs import load_rig
from bodyseg_model.recordings import FrameCameras, Skipping, Stamp, find_frames, labels_out, to_metres
from bodyseg_model.recordings import bag_files as mcap_files
from bodyseg_model.recordings import bag_files as ros1
from bodyseg_model.recordings import bag_files as sqlite_files
from bodyseg_model.recordings import bag_messages as compression
from bodyseg_model.recordings import bag_messages as messages
from bodyseg_model.recordings.bag_messages import typestore
from bodyseg_model.recordings.frames import open_recording

STACK = [RAMP, RAMP[::-1].copy(), RAMP // 2]
METRES = np.where(RAMP % 5 == 0, np.nan, RAMP / 10_000).astype(np.float32)
COLOUR = image(np.zeros((4, 15), np.uint8), "rgb8", topic="/camera/color/image_raw")

Writing = Callable[[Path, list[Message]], Path]

WRITERS: dict[str, Writing] = {
    "a.bag": write_ros1,
    "bz2.bag": lambda path, sent: write_ros1(path, sent, Ros1Writer.CompressionFormat.BZ2),
    "lz4.bag": lambda path, sent: write_ros1(path, sent, Ros1Writer.CompressionFormat.LZ4),
    "sqlite": write_ros2,
    "folder": lambda path, sent: write_ros2(path, sent, StoragePlugin.MCAP),
    "a.db3": lambda path, sent: next(write_ros2(path.with_suffix(""), sent).glob("*.db3")),
    "a.mcap": write_mcap,
    "lz4.mcap": lambda path, sent: write_mcap(path, sent, compression=CompressionType.LZ4),
    "plain.mcap": lambda path, sent: write_mcap(path, sent, compression=CompressionType.NONE),
    "unchunked.mcap": lambda path, sent: write_mcap(path, sent, use_chunking=False),
    "no_index.mcap": lambda path, sent: write_mcap(path, sent, index_types=IndexType.NONE),
    "no_summary.mcap": lambda path, sent: write_mcap(
        path, sent, repeat_channels=False, repeat_schemas=False, use_statistics=False, use_summary_offsets=False
    ),
    "ros1.mcap": lambda path, sent: write_mcap(path, sent, ros1=True),
}


def stream() -> list[Message]:
    """Three range images between other messages."""
    sent: list[Message] = [camera_info(RAMP.shape), COLOUR]
    for number, values in enumerate(STACK):
        sent += [image(values, "16UC1", 5 + number / 4), COLOUR, camera_info(RAMP.shape)]
    return sent


def refusal(path: Path, topic: str | None = None) -> str:
    with pytest.raises(BadConfig) as caught:
        open_recording(path, topic)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", WRITERS)
def test_range_images_come_back_with_times_and_camera(name: str, tmp_path: Path) -> None:
    path = WRITERS[name](tmp_path / name, stream())
    recording = open_recording(path)
    assert len(recording) == 3 and recording[0].step_m == 1e-3
    assert [frame.time_s for frame in recording] == pytest.approx([1.2, 1.5, 1.8])
    for number in (0, 1, 2, 0, 2, 1):
        frame = recording[number]
        np.testing.assert_array_equal(frame.read(), STACK[number])
        assert frame.stamp() == Stamp(5 * 10**9 + number * 250_000_000, "optical")
        assert str(path) in frame.where and DEPTH in frame.where
    camera = recording[0].camera
    assert camera is not None and (camera.fx, camera.fy, camera.cx, camera.cy) == (100, 101, 41.5, 29.5)
    assert camera.size == RAMP.shape and camera.distortion is None and INFO in camera.where
    assert [frame.name for frame in find_frames([path])] == ["0000", "0001", "0002"]
    other = open_recording(path, DEPTH[1:])
    assert [frame.path_id for frame in other] == [frame.path_id for frame in recording]
    assert "one of /camera/color/image_raw, /camera/depth/image_raw, found '/x'" in refusal(path, "/x")


def only(path: Path, *sent: Message) -> np.ndarray[Any, Any]:
    """Metres of the only frame of an MCAP file."""
    (frame,) = open_recording(write_mcap(path, list(sent)))
    return to_metres(frame.read(), frame.step_m)


def test_every_encoding_gives_the_same_metres(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    metres = RAMP.astype(np.float32) * np.float32(1e-3)
    np.testing.assert_array_equal(only(path, image(RAMP, "mono16")), metres)
    big = RAMP.astype(">u2")
    np.testing.assert_array_equal(only(path, image(big, "16UC1", is_bigendian=1)), metres)
    wide = np.pad(RAMP, ((0, 0), (0, 3)))
    np.testing.assert_array_equal(only(path, image(wide, "16UC1", width=RAMP.shape[1])), metres)
    np.testing.assert_array_equal(only(path, compressed(png(), "16UC1; png compressed ")), metres)
    np.testing.assert_array_equal(only(path, compressed(compressed_depth(RAMP), "16UC1; compressedDepth png")), metres)
    np.testing.assert_array_equal(only(path, compressed(compressed_depth(RAMP), "16UC1; compressedDepth")), metres)
    expected = np.where(np.isnan(METRES), 0, METRES)
    np.testing.assert_allclose(only(path, image(METRES, "32FC1")), expected, atol=1.3e-4)


def test_quantised_inverse_depth_is_undone(tmp_path: Path) -> None:
    """The transport's formula with its defaults: at most 10 m, resolved to 100 / 9999 at 1 m."""
    a = 100.0 * (100.0 + 1)
    b = 1 - a / 10.0
    ranges = np.linspace(0.6, 4, RAMP.size, dtype=np.float32).reshape(RAMP.shape)
    stored = np.rint(a / ranges + b).astype(np.uint16)
    stored[0] = 0
    found = only(tmp_path / "a.mcap", compressed(compressed_depth(stored, a, b), "32FC1; compressedDepth"))
    assert not found[0].any()
    np.testing.assert_allclose(found[1:], ranges[1:], atol=4**2 / a + 2e-4)


def test_topics_of_range_images_are_told_from_others(tmp_path: Path) -> None:
    infra = image(RAMP, "mono16", topic="/camera/ir/image_raw")
    path = write_mcap(tmp_path / "a.mcap", [*stream(), infra])
    said = refusal(path)
    assert said.startswith(
        "several topics have range images, choose one by --topic: /camera/depth/image_raw, /camera/ir"
    )
    assert len(open_recording(path, "/camera/ir/image_raw")) == 1
    path = write_mcap(tmp_path / "b.mcap", [COLOUR])
    assert "must have a topic of range images, found /camera/color/image_raw" in refusal(path)
    many = [image(RAMP[:4, :4], "16UC1", topic=f"/{number:02d}") for number in range(15)]
    assert refusal(write_mcap(tmp_path / "c.mcap", many)).count("/1") < 6 + str(tmp_path).count("/1")
    path = write_mcap(tmp_path / "d.mcap", [image(RAMP, "rgb8")])
    with pytest.raises(BadConfig, match="the encoding of an image must be one of 16UC1, mono16, 32FC1, found 'rgb8'"):
        open_recording(path, DEPTH)[0].read()


def test_channels_of_other_encodings_are_left_alone(tmp_path: Path) -> None:
    topic, kind, fields = image(RAMP, "16UC1")
    data = bytes(ROS2.serialize_cdr(built(ROS2, kind, fields), kind))
    text, _ = ROS2.generate_msgdef(kind, ros_version=2)
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(kind, "ros2msg", text.encode())
        others = ("/a", "json", 0), ("/b", "protobuf", schema), ("/c", "cdr", 0)
        for name, encoding, of in ((topic, "cdr", schema), *others):
            writer.add_message(writer.register_channel(name, encoding, of), 10**9, data, 10**9)
        writer.finish()
    (frame,) = open_recording(tmp_path / "a.mcap")
    np.testing.assert_array_equal(frame.read(), RAMP)


@pytest.mark.parametrize(("units", "step_m"), [(0.00025, 0.00025), (np.nan, 0.001), (1000.0, 0.001)])
def test_recordings_of_realsense_name_their_unit(tmp_path: Path, units: float, step_m: float) -> None:
    sensor = "/device_0/sensor_0"
    sent = [
        (f"{sensor}/option/Alternate_IR/value", "std_msgs/msg/Float32", {"data": 0.01}),
        camera_info(RAMP.shape, f"{sensor}/Depth_0/info/camera_info"),
        (f"{sensor}/option/Depth_Units/value", "std_msgs/msg/Float32", {"data": units}),
        image(RAMP, "mono16", topic=f"{sensor}/Depth_0/image/data"),
    ]
    recording = open_recording(write_ros1(tmp_path / "a.bag", sent))
    assert recording[0].step_m == pytest.approx(step_m) and recording[0].camera is not None
    assert open_recording(tmp_path / "a.bag", step_m=1e-4)[0].step_m == 1e-4


def with_info(path: Path, topic: str = DEPTH, **info: Any) -> Any:
    return open_recording(write_mcap(path, [camera_info(RAMP.shape, **info), image(RAMP, "16UC1", topic=topic)]))


def camera_of(path: Path, topic: str = DEPTH, **info: Any) -> Any:
    return with_info(path, topic, **info)[0].camera


def test_distortion_is_that_of_raw_images(tmp_path: Path) -> None:
    path, bent = tmp_path / "a.mcap", np.array([0.1, -0.2, 0.001, 0.002, 0.05])
    camera = camera_of(path, d=bent)
    assert [camera.distortion.k1, camera.distortion.p2, camera.distortion.k3] == [0.1, 0.002, 0.05]
    for name in ("image_rect", "image_rect_raw", "image_depth_rect", "image_depth_rect/compressedDepth"):
        rectified = camera_of(path, f"/camera/depth/{name}", d=bent)
        assert rectified.distortion is None and (rectified.fx, rectified.fy, rectified.cx) == (90, 90.5, 40)
    assert camera_of(path, "/camera/depth/image_direct", d=bent).distortion is not None
    assert camera_of(path, "/camera/depth/image_rect", p=np.zeros(12)).fx == 100, "that of the matrix K"
    assert camera_of(path, k=np.zeros(9)) is None, "not calibrated"
    assert [camera_of(path, height=60, width=side).size for side in (84, 0)] == [(60, 84), None]
    assert camera_of(path, model="equidistant", d=np.zeros(4)).distortion is None
    for wrong, message in (
        (
            {"model": "spherical", "d": bent[:4]},
            "distortion must be plumb_bob, of 4 or 5 coefficients, or one of brown_conrady",
        ),
        ({"d": np.ones(8)}, "found 'plumb_bob' of 8"),
        ({"binning_x": 2}, "images must be neither binned nor cut"),
        ({"binning_y": 2}, "images must be neither binned nor cut"),
        ({"roi": {"x_offset": 8}}, "images must be neither binned nor cut"),
        ({"roi": {"y_offset": 8}}, "images must be neither binned nor cut"),
        ({"k": np.array([-1.0, 0, 1, 0, 1, 1, 0, 0, 1])}, "focal lengths must be above 0"),
        (
            {"k": np.array([1.0, 0, 1, 0, 0, 1, 0, 0, 1])},
            "focal lengths must be above 0, and pixels square, found 'fx' 1 and 'fy' 0",
        ),
    ):
        frames = with_info(path, **wrong)
        given = FrameCameras(frames, None, 100.0, (), load_rig(), Skipping())
        assert given.first.camera.focal_px == 100, "a camera that is given takes its place"
        with pytest.raises(BadConfig) as caught:
            FrameCameras(frames, None, None, (), load_rig(), Skipping())
        assert message in str(caught.value) and INFO in str(caught.value)


@pytest.mark.parametrize(
    ("sent", "message"),
    [
        (image(RAMP, "16UC1", height=61), "an image of 61 x 84 16UC1 in rows of 168 bytes cannot have"),
        (image(RAMP[:, :50].copy(), "16UC1", width=84), "60 x 84 16UC1 in rows of 100 bytes cannot have"),
        (image(RAMP, "16UC1", width=2**31), "must have rows and columns, 1 to 4096 of each"),
        (compressed(b"short", "16UC1; compressedDepth"), "must begin with 12 bytes of header, found 5"),
        (compressed(compressed_depth(RAMP)[:300], "16UC1; compressedDepth"), "a PNG must be whole"),
        (compressed(compressed_depth(RAMP), "32FC1; compressedDepth"), "must have finite A above 0"),
        (compressed(bytes(20), "16UC1; compressedDepth rvl"), "1 to 4096 of each, found 0 x 0"),
        (compressed(b"", "16UC1; jpeg compressed"), "must be a 16-bit PNG or compressedDepth"),
        (compressed(png(np.zeros((4, 4), np.uint8)), "16UC1; png compressed"), "found 8-bit grey"),
    ],
)
def test_images_that_contradict_themselves_are_named(sent: Message, message: str, tmp_path: Path) -> None:
    (frame,) = open_recording(write_mcap(tmp_path / "a.mcap", [sent]))
    with pytest.raises(BadConfig) as caught:
        frame.read()
    assert message in str(caught.value) and str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)


def test_compressed_images_may_leave_their_encoding_out(tmp_path: Path) -> None:
    """cv_bridge in Python writes "png"; publishers of their own write the transport alone."""
    quantised = np.where(RAMP % 5 == 0, 0, RAMP // 2 + 4000).astype(np.uint16)
    a, b = 10_100.0, -1009.0
    metres = np.where(quantised, a / (quantised - b), 0)
    for number, (data, text, steps) in enumerate(
        (
            (png(RAMP), "png", True),
            (png(RAMP), "PNG compressed", True),
            (png(RAMP), "", True),
            (compressed_depth(RAMP), "compressedDepth", True),
            (compressed_depth(RAMP), "; compressedDepth png", True),
            (bytes(12) + encode_rvl(RAMP), "compressedDepth rvl", True),
            (bytes(12) + encode_rvl(RAMP), "16UC1; compressedDepth rvl", True),
            (compressed_depth(quantised, a, b), "compressedDepth", False),
            (compressed_depth(quantised, a, b)[:12] + encode_rvl(quantised), "32FC1; compressedDepth rvl", False),
        )
    ):
        sent = [COLOUR, compressed(data, text), compressed(png(np.zeros((4, 4), np.uint8)), "png", topic="/grey/png")]
        (frame,) = open_recording(write_mcap(tmp_path / f"{number}.mcap", sent))
        if steps:
            np.testing.assert_array_equal(frame.read(), RAMP)
        else:
            np.testing.assert_allclose(frame.read() * frame.step_m, metres, atol=1.3e-4)


def test_a_camera_may_be_calibrated_later(tmp_path: Path) -> None:
    sent = [camera_info(RAMP.shape, k=np.zeros(9)), camera_info(RAMP.shape, k=np.zeros(9)), camera_info(RAMP.shape)]
    (frame,) = open_recording(write_mcap(tmp_path / "a.mcap", [*sent, image(RAMP, "16UC1")]))
    assert frame.camera is not None and frame.camera.fx == 100


def test_a_change_of_encoding_is_of_its_frame(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", [image(RAMP, "16UC1"), image(METRES, "32FC1")])
    first, second = open_recording(path)
    assert first.read().any()
    with pytest.raises(BadConfig, match="must be of the first one's encoding, found float32"):
        second.read()


@pytest.mark.parametrize("name", ["a.bag", "lz4.bag", "a.db3", "a.mcap", "unchunked.mcap", "no_index.mcap"])
def test_bags_that_are_cut_or_altered_are_one_line(name: str, tmp_path: Path) -> None:
    path = WRITERS[name](tmp_path / name, stream())
    whole = path.read_bytes()
    random = np.random.default_rng(5)
    refused = 0
    for cut in (20, len(whole) // 3, len(whole) // 2, len(whole) - 40):
        refused += reads_or_refuses(path, whole[:cut])
    assert refused >= 3
    for _ in range(25):
        data = bytearray(whole)
        for place in random.integers(0, len(whole), 4):
            data[place] = random.integers(0, 256)
        reads_or_refuses(path, bytes(data))


def test_other_files_under_these_names_are_refused(tmp_path: Path) -> None:
    for name, message in (
        ("a.bag", "must be a whole ROS 1 bag with an index"),
        ("a.mcap", "mends a recording that was cut off): ValueError: its first bytes are others"),
        ("a.db3", "must be a whole file of a ROS 2 bag"),
    ):
        (tmp_path / name).write_bytes(b"no bag" * 1000)
        assert message in refusal(tmp_path / name)
    with sqlite3.connect(tmp_path / "b.db3") as base:
        base.execute("CREATE TABLE topics (id)")
        base.execute(
            "CREATE VIEW messages AS WITH RECURSIVE a(b) AS (SELECT 1 UNION ALL SELECT b FROM a) SELECT * FROM a"
        )
    base.close()
    assert "tables 'topics' and 'messages' are missing" in refusal(tmp_path / "b.db3")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "metadata.yaml").write_text("")
    assert "must hold .db3 or .mcap files, found none" in refusal(tmp_path / "folder")
    (tmp_path / "folder" / "a.db3").mkdir()
    assert refusal(tmp_path / "folder").startswith(f"cannot read {tmp_path / 'folder' / 'a.db3'}: ")
    (tmp_path / "folder" / "b.db3.zstd").write_bytes(b"")
    assert "must be decompressed first" in refusal(tmp_path / "folder")


def test_a_file_that_was_decompressed_is_read(tmp_path: Path) -> None:
    """`zstd -d` keeps the compressed file beside it."""
    path = next(write_ros2(tmp_path / "a", stream()).glob("*.db3"))
    path.with_suffix(".db3.zstd").write_bytes(b"")
    assert len(open_recording(tmp_path / "a")) == len(open_recording(path))


def test_messages_of_sqlite_may_be_compressed_or_lost(tmp_path: Path) -> None:
    path = next(write_ros2(tmp_path / "a", stream()).glob("*.db3"))
    base = sqlite3.connect(path)
    for row, data in base.execute("SELECT id, data FROM messages").fetchall():
        base.execute("UPDATE messages SET data=? WHERE id=?", (zstandard.compress(data), row))
    base.commit()
    frames = open_recording(path)
    np.testing.assert_array_equal(frames[2].read(), STACK[2])
    base.execute("UPDATE messages SET data='text'")
    base.commit()
    base.close()
    with pytest.raises(BadConfig, match="it is missing, or has more than"):
        open_recording(path, DEPTH)[0].read()


def test_files_of_one_bag_are_joined_in_the_order_of_time(tmp_path: Path) -> None:
    folder = write_ros2(tmp_path / "a", stream(), StoragePlugin.MCAP)
    write_mcap(folder / "a_10.mcap", [image(RAMP // 3, "16UC1"), COLOUR, COLOUR, COLOUR, image(RAMP // 5, "16UC1")])
    (folder / "._a_10.mcap").write_bytes(b"")  # as macOS leaves beside files on other disks
    recording = open_recording(folder)
    assert [frame.time_s for frame in recording] == pytest.approx([1.0, 1.2, 1.4, 1.5, 1.8])
    for frame, expected in zip(recording, (RAMP // 3, STACK[0], RAMP // 5, *STACK[1:]), strict=True):
        np.testing.assert_array_equal(frame.read(), expected)


def test_pieces_are_decompressed_up_to_a_limit(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    names = ("bz2.bag", "lz4.bag", "a.mcap", "lz4.mcap")
    paths = [WRITERS[name](tmp_path / name, stream()) for name in names]
    monkeypatch.setattr(compression, "LARGEST_MESSAGE", 1000)
    for path in paths:
        with pytest.raises(BadConfig, match="a piece must have at most 1000 bytes"):
            open_recording(path, DEPTH)[0].read()
    for module, name, message in (
        (ros1, "a.bag", "a chunk must have at most 1000 bytes"),
        (mcap_files, "plain.mcap", "is of kind 6 and has"),
        (sqlite_files, "a.db3", "it is missing, or has more than 1000 bytes"),
    ):
        path = WRITERS[name](tmp_path / name, [image(RAMP, "16UC1")])
        monkeypatch.setattr(module, "LARGEST_MESSAGE", 1000)
        with pytest.raises(BadConfig) as caught:
            open_recording(path, DEPTH)[0].read()
        assert message in str(caught.value)


@pytest.mark.parametrize(
    ("package", "action"),
    [
        ("rosbags.typesys", lambda folder: typestore("cdr")),
        ("mcap.writer", lambda folder: labels_out(folder / "out.mcap", PARTS33, 10.0).__enter__()),
        ("mcap.records", lambda folder: open_recording(folder / "a.mcap")),
        ("mcap.data_stream", lambda folder: open_recording(folder / "a.mcap")),
        ("lz4.frame", lambda folder: open_recording(folder / "lz4.mcap")),
    ],
)
def test_a_package_that_is_missing_is_named(
    package: str, action: Callable[[Path], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a.mcap", "lz4.mcap"):
        WRITERS[name](tmp_path / name, [image(RAMP, "16UC1")])
    typestore.cache_clear()
    monkeypatch.setitem(sys.modules, package, None)
    name, _, _ = package.partition(".")
    with pytest.raises(MissingLibrary, match=rf"'{name}': pip install 'bodyseg\[recordings\]'"):
        action(tmp_path)
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("name", ["bz2.bag", "lz4.bag", "a.db3", "a.mcap", "lz4.mcap", "unchunked.mcap"])
def test_a_recording_is_never_in_memory_as_a_whole(name: str, tmp_path: Path) -> None:
    values = np.zeros((200, 200), np.uint16)
    path = WRITERS[name](tmp_path / name, [image(values, "16UC1", number) for number in range(150)])
    open_recording(path)[0].read()  # libraries allocate when they are first used
    tracemalloc.start()
    try:
        for frame in open_recording(path):
            frame.read()
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    limit = 60 if name.endswith(".bag") else 10  # a chunk of a ROS 1 bag has 1 MB
    assert peak < limit * values.nbytes, "150 frames at once would be 150"


def test_a_topic_has_a_limit_of_messages(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", stream())
    monkeypatch.setattr(messages, "MOST_MESSAGES", 2)
    assert "a topic must have at most 2 messages, found 4" in refusal(path)


def test_a_camera_may_stand_below_its_topic(tmp_path: Path) -> None:
    sent = [camera_info(RAMP.shape, f"{DEPTH}/camera_info"), compressed(png(RAMP), "png", topic=f"{DEPTH}/compressed")]
    (frame,) = open_recording(write_mcap(tmp_path / "a.mcap", sent))
    assert frame.camera is not None and frame.camera.fx == 100


def chunk_of(data: bytes, claimed: int | None = None) -> bytes:
    """A record of MCAP: a chunk of these bytes, packed, with no index."""
    packed = zstandard.ZstdCompressor().compress(data)
    head = struct.pack("<QQQII", 0, 0, len(data) if claimed is None else claimed, 0, 4)
    body = head + b"zstd" + struct.pack("<Q", len(packed)) + packed
    return struct.pack("<BQ", 6, len(body)) + body


@pytest.mark.parametrize(
    ("chunks", "message"),
    [
        ([chunk_of(bytes(10_000_000))], "no record begins at byte 0"),
        ([chunk_of(struct.pack("<BQ", 9, 9_000_000) + bytes(9_000_000))] * 3, "claims 9000009 bytes of"),
        ([chunk_of(bytes(1 << 20), 99)], "a piece must have at most 99 bytes"),
        ([chunk_of(bytes(9), 1 << 60)], "claims 1152921504606846976 bytes of"),
        ([chunk_of(struct.pack("<BQHIQQ", 5, 22, 1, 0, 1, 1) * 1001)], "at most 1000 messages"),
        ([chunk_of(struct.pack("<BQHIQQ", 5, 22, 1, 0, 1 << 63, 1))], "must be a whole MCAP file"),
    ],
)
def test_chunks_are_bounded_before_they_are_believed(
    chunks: list[bytes], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bodyseg_model.recordings.bag_files._SCANNED", (20_000_000, 100))
    monkeypatch.setattr("bodyseg_model.recordings.bag_files.MOST_MESSAGES", 1000)
    path, footer = tmp_path / "a.mcap", struct.pack("<BQ", 2, 20) + bytes(20)
    path.write_bytes(b"\x89MCAP0\r\n" + b"".join(chunks) + footer)
    assert message in refusal(path)
