"""`ShardWriter`: scenes as arrays become a set that streams in every variant, whatever they came as."""

from __future__ import annotations

import errno
import json
import re
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bodyseg_data import VARIANTS, BadConfig, BadSample, ColumnWriter, RangeImages, ShardWriter, loader
from bodyseg_data.artifacts import lit_pixels
from bodyseg_data.commands import cli
from bodyseg_data.core import BadShard, BodysegError
from bodyseg_data.files import part_beside
from bodyseg_data.rigs import Camera, Rig
from bodyseg_data.shards import ShardRecord, shard_name

CAMERA = Camera(16, 20, 24.0, (10.0, 8.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
PROJECTOR = Camera(24, 30, 36.0, (15.0, 12.0), (0.2, 0.0, 0.0), (0.2, 0.0, 1.0))
RIG = Rig("bench", 1.5, CAMERA, PROJECTOR)
TWO = replace(RIG, second_projector=replace(PROJECTOR, position_m=(-0.2, 0.0, 0.0), aims_at_m=(-0.2, 0.0, 1.0)))
CLASSES = ["floor", "arm", "box"]

Scenes = Iterable[int]


def scene(number: int = 0, **changed: Any) -> dict[str, Any]:
    """A wall 2 m away with a plate before it, seen by both devices; label 1 on the plate, 2 on empty rows."""
    range_m = np.full((16, 20), 2.0, np.float32)
    labels = np.zeros((16, 20), np.int64)
    left = 6 + number % 3
    range_m[4:12, left:12] = 1.2
    labels[range_m == np.float32(1.2)] = 1
    range_m[:2], labels[:2] = 0, 2
    projector = np.full((24, 30), 2.0)
    # The plate lies 0.2 m * 36 px / 1.2 m = 6 px further left, and all is larger by 36 / 24.
    projector[6:18, round(1.5 * (left - 10) + 15 - 6) : 12] = 1.2
    made = {"key": f"scene-{number:03d}", "range_m": range_m, "labels": labels, "projector_range_m": projector}
    return made | {"split": "test" if number % 4 == 3 else "train", "fields": {"robot": f"r{number % 2}"}} | changed


def write(out: Path, scenes: Scenes = range(5), rig: Any = RIG, **options: Any) -> Path:
    with ShardWriter(out, rig=rig, classes=CLASSES, **options) as writer:
        for number in scenes:
            writer.write(**scene(number))
    return out


def one(out: Path, rig: Any = RIG, options: dict[str, Any] | None = None, **changed: Any) -> Any:
    """The clean sample of a set of one scene."""
    with ShardWriter(out, rig=rig, classes=CLASSES, **(options or {})) as writer:
        writer.write(**scene(**changed))
    return RangeImages(out, "none").clean(0)


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_scenes_stream_in_every_variant_with_their_own_classes(tmp_path: Path) -> None:
    out = write(tmp_path / "set")
    assert cli.main(["verify", str(out)]) == 0
    assert RangeImages(out).manifest.classes.names == ("floor", "arm", "box")
    for variant in VARIANTS:
        for batch in loader(RangeImages(out, variant), 2, 0):
            assert batch["range"].shape[1:] == (1, 16, 20)
    sample = RangeImages(out, "none", split="train").clean(0)
    assert sample.info.robot == "r0" and sample.key == "scene-000"
    assert (sample.range[:2] == 0).all() and (sample.labels[:2] == 255).all()
    assert (sample.range[2:4] == 20000).all() and (sample.labels[4:12, 6:12] == 1).all()
    lit = RangeImages(out, "occ", split="train").image(0)
    shaded = (lit.range == 0) & (sample.range > 0)
    # The plate's shadow lies on the wall, on the side away from the projector.
    assert shaded[6:10, 1:6].any() and not shaded[:, 12:].any() and not shaded[4:12, 6:12].any()


def test_labels_agree_with_what_was_measured(tmp_path: Path) -> None:
    labels = scene()["labels"]
    labels[5, 5], labels[6, 6] = 255, 254
    one(tmp_path / "set", labels=labels)
    stored = RangeImages(tmp_path / "set", "none", unlabelled=True).clean(0).labels
    assert (stored[:2] == 255).all() and stored[5, 5] == stored[6, 6] == 254


@pytest.mark.parametrize("kind", [torch.from_numpy, lambda array: array.tolist(), np.asfortranarray])
def test_arrays_may_be_tensors_or_lists(kind: Callable[[Any], Any], tmp_path: Path) -> None:
    plain = scene()
    given = {name: kind(value) if isinstance(value, np.ndarray) else value for name, value in plain.items()}
    for name, each in (("plain", plain), ("given", given)):
        with ShardWriter(tmp_path / name, rig=RIG, classes=CLASSES) as writer:
            writer.write(**each)
            for array in plain.values():
                if isinstance(array, np.ndarray) and name == "given":
                    array[...] = 0  # a buffer that is used again
    assert files(tmp_path / "plain") == files(tmp_path / "given")


@pytest.mark.parametrize("rig", [RIG, TWO])
def test_a_projector_that_is_a_function_is_asked_for_what_is_needed(rig: Rig, tmp_path: Path) -> None:
    asked, given = [], scene()["projector_range_m"]
    if rig is TWO:
        given = np.concatenate([given, given[:, ::-1]])

    def projector(rows: Any, columns: Any) -> Any:
        asked.append(len(rows))
        return given[rows, columns]

    for kind in ("shadow", "exact"):
        options = {"projector": kind}
        one(tmp_path / f"{kind}-given", rig, options, projector_range_m=given)
        one(tmp_path / f"{kind}-asked", rig, options, projector_range_m=None, projector=projector)
        assert files(tmp_path / f"{kind}-given") == files(tmp_path / f"{kind}-asked")
    assert sum(asked[:-1]) < asked[-1] == given.size


def test_what_the_projector_sees_is_kept_as_asked(tmp_path: Path) -> None:
    kept = {kind: one(tmp_path / kind, options={"projector": kind}) for kind in ("shadow", "exact")}
    assert np.array_equal(kept["exact"].projector_range, np.rint(scene()["projector_range_m"] * 10000))
    assert (kept["shadow"].projector_range > 0).sum() < (kept["exact"].projector_range > 0).sum()
    assert np.array_equal(lit_pixels(RIG, kept["shadow"]), lit_pixels(RIG, kept["exact"]))
    none = one(tmp_path / "none", projector_range_m=None)
    assert none.projector_range is None and RangeImages(tmp_path / "none", "none").manifest.projector == "none"
    with pytest.raises(BodysegError, match="projector"):
        RangeImages(tmp_path / "none", "occ")


def test_facing_comes_from_bits_from_normals_or_from_the_range_image(tmp_path: Path) -> None:
    measured = scene()["range_m"] > 0
    found = one(tmp_path / "range")
    assert np.array_equal(found.faces_projector, measured)  # all surfaces are square to the camera
    normals = np.zeros((16, 20, 3))
    normals[..., 2] = -1
    assert np.array_equal(one(tmp_path / "normals", normals=normals).faces_projector, measured)
    bits = np.indices((16, 20)).sum(axis=0) % 2 == 0
    assert np.array_equal(one(tmp_path / "bits", facing=bits).faces_projector, bits & measured)
    both = one(tmp_path / "both", TWO, projector_range_m=None, facing=[bits, ~bits])
    assert np.array_equal(both.faces_projector, bits & measured)
    assert np.array_equal(both.faces_second, ~bits & measured)
    assert RangeImages(tmp_path / "range").manifest.renderer == "external, facing from range images"
    assert RangeImages(tmp_path / "bits").manifest.renderer == "external"


def test_more_rigs_than_a_manifest_may_list_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(BadShard, match="a set has at most 4096 rigs"):
        ShardWriter(tmp_path / "set", rig=[TWO] * 4097, classes=CLASSES)
    assert not (tmp_path / "set").exists()


def test_two_projectors_several_rigs_planes_and_fields(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    turned = replace(TWO, name="turned", camera=replace(CAMERA, roll_deg=5.0))
    both = np.concatenate([scene()["projector_range_m"]] * 2)
    planes = {"instances": np.full((16, 20), 300, np.int32), "material": np.ones((16, 20), np.uint8)}
    fields = {"age": np.int64(3), "mesh": np.arange(3), "height": np.float32(0.5), "left": np.bool_(True)}
    given = {"projector_range_m": both, "planes": planes}
    with ShardWriter(tmp_path / "set", rig=[TWO, turned], classes=CLASSES, workers=0) as writer:
        writer.write(**scene(0, **given, fields=fields))
        with pytest.raises(BadSample, match="scene-001: of several rigs, the field 'rig' holds .*, 1: .*, found 'arm'"):
            writer.write(**scene(1, **given, fields={"rig": "arm"}, rig=1))
        writer.write(**scene(1, **given, fields={"height": 2, "rig": 1}, rig=1))  # as `describe` gives it
    assert cli.main(["verify", str(tmp_path / "set")]) == 0
    images = RangeImages(tmp_path / "set", "none")
    assert images.manifest.planes == {"instances": "uint16", "material": "uint8"}
    assert RangeImages(tmp_path / "set", "none", where="rig=1").keys == ["scene-001"]
    with pytest.raises(
        BadConfig, match=rf"^rig \(0 {TWO.name}, 1 turned\) is compared with numbers, .*, found 'rig=tu"
    ):
        RangeImages(tmp_path / "set", "none", where="rig=turned")
    first, second = images.clean(0), images.clean(1)
    assert first.info.fields == {"age": 3, "mesh": (0.0, 1.0, 2.0), "height": 0.5, "left": True, "rig": 0}
    assert second.info.fields == {"height": 2.0, "rig": 1}
    assert (first.planes["instances"] == 300).all() and first.faces_second is not None
    assert first.occluder_range().shape == (48, 30)
    capsys.readouterr()
    assert cli.main(["inspect", str(tmp_path / "set"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["fields"]
    assert told.keys() == {*fields, "rig"} and told["mesh"] == {"(0.0, 1.0, 2.0)": 1, "None": 1}


@pytest.mark.parametrize("count", [1, 2, 3])
def test_joined_parts_are_the_same_files_however_they_were_divided(count: int, tmp_path: Path) -> None:
    whole = write(tmp_path / "whole", range(13), shard_samples=3)
    for part in range(count):
        # In an order of its own each, and in shards of another size.
        write(tmp_path / "parts", range(part, 13, count)[::-1], part=(part, count), shard_samples=2)
    assert cli.main(["join", str(tmp_path / "parts"), "--out", str(tmp_path / "set"), "--shard-samples", "3"]) == 0
    assert cli.main(["verify", str(tmp_path / "set")]) == 0
    assert files(whole) == files(tmp_path / "set")


def test_a_part_may_get_no_scenes_and_some_later(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def joined(out: str) -> int:
        return cli.main(["join", str(tmp_path / "parts"), "--out", str(tmp_path / out)])

    write(tmp_path / "parts", [], part=(1, 2))
    write(tmp_path / "parts", [], part=(0, 2))
    assert joined("nobody") == 2 and "join needs the folder of at least one part" in capsys.readouterr().err
    write(tmp_path / "parts", [0, 1], part=(0, 2))
    assert joined("set") == 0
    assert files(tmp_path / "set") == files(write(tmp_path / "whole", [0, 1]))
    write(tmp_path / "parts", [2], part=(1, 2))
    assert joined("all") == 0
    assert files(tmp_path / "all") == files(write(tmp_path / "three", range(3)))


def test_parts_that_do_not_belong_together_are_refused(
    tmp_path: Path, small_set: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def said(*words: Any) -> str:
        assert cli.main(["join", *map(str, words), "--out", str(tmp_path / "set")]) == 2
        assert not list((tmp_path / "set").glob("*"))
        return capsys.readouterr().err.partition("join: ")[2].strip().splitlines()[-1].replace(f"{tmp_path}/", "")

    parts = write(tmp_path / "parts", [0], part=(0, 3)).parent / "parts"
    write(parts, [1], part=(2, 3))
    assert said(parts) == "parts must hold 3 parts: part-00001-of-00003 is missing"
    write(parts, [2], part=(1, 3))
    (parts / "part-00002-of-00003").rename(parts / "part-00002-of-00004")
    assert said(parts) == "parts must hold 3 parts: part-00002-of-00003 is missing"
    write(parts, [1], part=(2, 3))
    assert said(parts) == "parts must hold 3 parts: found 4 parts"
    first = write(tmp_path / "first", [0])
    assert said(first, first) == "a part is joined once: a folder is given twice"
    assert said(first, write(tmp_path / "again", [0])) == "scene-000 is in first and in again"
    other = write(tmp_path / "other", [1], source="blender")
    assert said(first, other) == "other and first are no parts of one set: their options of their writers differ"
    with ShardWriter(tmp_path / "kind", rig=RIG, classes=CLASSES) as writer:
        writer.write(**scene(1, fields={"robot": 7}))
    assert said(first, tmp_path / "kind").startswith("kind: field 'robot' is int, elsewhere text: ")
    assert said(first, tmp_path / "nothing") == "no such folder: nothing"
    assert ": parts are sets that a ShardWriter wrote, found one rendered by 'raster'" in said(small_set)
    with ColumnWriter(other, "visit", "int") as column:
        column.write("scene-001", 3)
    assert said(other) == "other: parts must have no columns, found 'visit': write it for the joined set"


def test_a_damaged_shard_of_a_part_names_the_part(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Shards of all parts have the same names."""
    for number in range(2):
        write(tmp_path / "parts", [number], part=(number, 2))
    part = tmp_path / "parts" / "part-00001-of-00002"
    shard = next(part.glob("*.tar"))
    shard.write_bytes(shard.read_bytes().replace(b"scene-001", b"scene-002", 1))
    assert cli.main(["join", str(tmp_path / "parts"), "--out", str(tmp_path / "set")]) == 2
    assert f"join: {part}: {shard.name}: scene-001: offset 0: altered: CRC-32 " in capsys.readouterr().err


def test_a_join_that_was_stopped_carries_on(tmp_path: Path) -> None:
    whole, parts = write(tmp_path / "whole", range(13), shard_samples=3), tmp_path / "parts"
    for part in range(2):
        write(parts, range(part, 13, 2), part=(part, 2))
    shard = parts / "part-00000-of-00002" / "train-00000.tar"
    sound = shard.read_bytes()
    shard.write_bytes(sound.replace(b"scene-006", b"scene-999", 1))
    words = ["join", str(parts), "--out", str(tmp_path / "set"), "--shard-samples", "3"]
    assert cli.main(words) == 2
    (made,) = (tmp_path / "set").glob("*.tar")
    before = made.stat()
    shard.write_bytes(sound)
    assert cli.main(words) == 0
    assert files(whole) == files(tmp_path / "set")
    assert (made.name, made.stat().st_ino, made.stat().st_mtime_ns) == (
        "train-00000.tar",
        before.st_ino,
        before.st_mtime_ns,
    )


def test_a_writer_that_was_stopped_carries_on(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole", range(11), shard_samples=3)
    out = tmp_path / "set"
    with (
        pytest.raises(RuntimeError, match="out of film"),
        ShardWriter(out, rig=RIG, classes=CLASSES, shard_samples=3) as writer,
    ):
        for number in range(11):
            if number == 10:
                raise RuntimeError("out of film")
            writer.write(**scene(number))
    left = files(out)
    assert "train-00000.tar" in left and not any(name.endswith((".part", "manifest.json")) for name in left)
    learned = out / ".packing" / "learned.json"
    light = learned.read_bytes().replace(b"shadow", b"light")
    for damaged in (b"{", b"[]", light, b'{"fields": {"a": "b"}}', b'{"fields": null}'):
        learned.write_bytes(damaged)
        with pytest.raises(BadConfig, match="learned.json cannot be read: delete"):
            write(out, shard_samples=3)
    learned.write_bytes(left[".packing/learned.json"])
    with ShardWriter(out, rig=RIG, classes=CLASSES, shard_samples=3) as writer:
        known = [number for number in range(11) if f"scene-{number:03d}" in writer]
        taken = [number for number in range(11) if writer.write(**scene(number))]
    assert known and sorted(known + taken) == list(range(11))
    assert files(whole) == files(out)


def test_work_for_a_scene_does_not_grow_with_the_shards_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = Counter[str]()

    def counted(function: Any) -> Any:
        def call(*given: Any) -> Any:
            work[function.__name__] += 1
            return function(*given)

        return call

    monkeypatch.setattr("bodyseg_data.packing.shard_writer.shard_name", counted(shard_name))
    monkeypatch.setattr(ShardRecord, "__len__", counted(ShardRecord.__len__))
    told: list[int] = []
    out = write(tmp_path / "set", range(40), shard_samples=1, progress=lambda done, total: told.append(done))
    assert told == list(range(1, 41))
    assert work["shard_name"] == 40 and work["__len__"] < 10 * 40
    work.clear()
    assert cli.main(["verify", str(out)]) == 0
    assert work["__len__"] < 10 * 40


def test_a_set_may_have_more_than_a_hundred_thousand_shards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "bodyseg_data.packing.shard_writer.shard_name", lambda split, number: shard_name(split, number + 99_998)
    )
    images = RangeImages(write(tmp_path / "set", range(3), shard_samples=1), "none")
    assert images.keys == ["scene-000", "scene-001", "scene-002"]
    assert [Path(url).name for url in images.urls()][1:] == ["train-99999.tar", "train-100000.tar"]


def test_a_full_disk_at_the_first_scene_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, data: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with (
        pytest.raises(BadConfig, match="cannot write shards in .*: No space left on device"),
        ShardWriter(tmp_path / "set", rig=RIG, classes=CLASSES) as writer,
    ):
        monkeypatch.setattr("bodyseg_data.packing.shard_writer.write_atomically", full)
        writer.write(**scene(0))


def test_hidden_files_of_others_stay_and_those_of_a_killed_writer_go(tmp_path: Path) -> None:
    others = {".lock": b"of an editor", ".large.safetensors.part": b"of a download", ".coco.01234567.part/a": b"export"}
    for name, data in others.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(data)
    part_beside(tmp_path / "manifest.json").write_bytes(b"half")
    held = files(write(tmp_path))
    assert {name: held.pop(name) for name in others} == others
    assert held.keys() == {"manifest.json", "test-00000.tar", "train-00000.tar"}


def test_threads_that_share_a_writer_write_whole_sets(tmp_path: Path) -> None:
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        with (
            ShardWriter(tmp_path / "set", rig=RIG, classes=CLASSES, shard_samples=3, workers=0) as writer,
            ThreadPoolExecutor(4) as threads,
        ):
            assert all(threads.map(lambda number: writer.write(**scene(number)), range(80)))
    finally:
        sys.setswitchinterval(interval)
    images = RangeImages(tmp_path / "set", "none")
    assert sorted(images.keys) == [scene(number)["key"] for number in range(80)]
    for index, key in enumerate(images.keys):
        given, found = scene(int(key[-3:])), images.clean(index)
        np.testing.assert_array_equal(found.labels == 1, given["labels"] == 1)
        assert (found.info.robot, found.info.split) == (given["fields"]["robot"], given["split"])


def test_a_finished_set_stays_and_a_damaged_shard_is_written_again(tmp_path: Path) -> None:
    out = write(tmp_path / "set", range(11), shard_samples=3)
    before = files(out)
    again = rf"^nothing was written: {out} held a finished set with all scenes; to write them anew, delete it or give"
    with pytest.warns(UserWarning, match=again):
        write(out, range(11), shard_samples=3)
    with pytest.warns(UserWarning, match=again), ShardWriter(out, rig=RIG, classes=CLASSES, shard_samples=3) as writer:
        writer.write_all({"scene-003": 3}, scene)
    with ShardWriter(out, rig=RIG, classes=CLASSES, shard_samples=3) as writer:
        assert "scene-003" in writer  # whoever asks first is not warned
    assert files(out) == before
    for count in (2, 4):
        with pytest.raises(BadConfig, match="already holds a set of shards packed with other options"):
            write(out, range(11), shard_samples=count)
    with pytest.raises(BadConfig, match=r"scene-011: .* holds a finished set without it"):
        write(out, range(12), shard_samples=3)
    assert files(out) == before
    (out / "train-00001.tar").write_bytes(b"")
    with pytest.raises(BadSample, match="key"), ShardWriter(out, rig=RIG, classes=CLASSES, shard_samples=3) as writer:
        writer.write(**scene(4, key="bad key"))
    assert files(out) == {**before, "train-00001.tar": b""}, "the manifest stays until a scene is there in its place"
    with ShardWriter(out, rig=RIG, classes=CLASSES, shard_samples=3) as writer:
        assert "scene-000" in writer and "scene-004" not in writer
    assert files(out) == {**before, "train-00001.tar": b""}, "and names the shard that is to be mended"
    write(out, range(11), shard_samples=3)
    assert files(out) == before
    with pytest.raises(BadConfig, match="packed with other options"):
        write(out, source="blender")


@pytest.mark.parametrize("own", [False, True])
def test_scenes_may_be_made_where_they_are_encoded(own: bool, tmp_path: Path) -> None:
    made: list[int] = []
    failed = threading.Event()

    def make(number: int) -> dict[str, Any]:
        if number == 10 and not failed.is_set():
            failed.set()
            raise RuntimeError("out of film")
        made.append(number)
        return {name: value for name, value in scene(number).items() if name != "key"}

    whole = write(tmp_path / "whole", range(11), shard_samples=3)
    scenes = {f"scene-{number:03d}": number for number in range(11)}
    with ThreadPoolExecutor(1) as pool:
        options = {"rig": RIG, "classes": CLASSES, "shard_samples": 3, "executor": pool if own else None}
        with pytest.raises(RuntimeError, match="out of film"), ShardWriter(tmp_path / "set", **options) as writer:
            writer.write_all(scenes, make)
        with ShardWriter(tmp_path / "set", **options) as writer:
            writer.write_all(scenes, make)
        again = pytest.raises(BadSample, match="^scene-002: this key was written before$")
        with again, ShardWriter(tmp_path / "twice", **options) as writer:
            writer.write_all(dict(list(scenes.items())[:3]), make)
            writer.write_all({"scene-002": 2}, make)
    assert files(whole) == files(tmp_path / "set")
    assert {*made} == {*range(11)} and len(made) < 24, "what was written is not made anew"


@pytest.mark.parametrize("late", [False, True])
def test_a_file_that_a_function_of_scenes_lacks_is_not_taken_for_a_fault_of_the_folder(
    late: bool, tmp_path: Path
) -> None:
    def make(number: int) -> dict[str, Any]:
        if number == (4 if late else 1):
            (tmp_path / "render.npz").read_bytes()
        return {name: value for name, value in scene(number).items() if name != "key"}

    scenes = {f"scene-{number:03d}": number for number in range(5)}
    with (
        pytest.raises(FileNotFoundError, match=r"render\.npz"),
        ShardWriter(tmp_path / "set", rig=RIG, classes=CLASSES) as writer,
    ):
        writer.write_all(scenes, make)


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "size": ({"range_m": np.ones((15, 20))}, "range_m must be 16 x 20, as the rig says, found 15 x 20"),
    "masked": (
        {"range_m": np.ma.masked_less(np.tile([0.5, 2.0], (16, 10)), 1.0)},
        "range_m must have no masked values, but a number for them: 0 as a range, 255 as a label",
    ),
    "millimetres": (
        {"range_m": np.full((16, 20), 2000, np.uint16)},
        "range_m must be floats of 32 or 64 bits, in metres, found uint16",
    ),
    "halves": (
        {"range_m": np.full((16, 20), 2, np.float16)},
        "range_m must be floats of 32 or 64 bits, in metres, found float16",
    ),
    "far": (
        {"range_m": np.full((16, 20), 2000.0)},
        "range_m must be metres, 0 to 6.5535, found 2000 at row 0, column 0",
    ),
    "infinite": (
        {"range_m": np.full((16, 20), np.inf)},
        "range_m must be metres, 0 to 6.5535, found inf at row 0, column 0",
    ),
    "no array": ({"range_m": [[1.0], [1.0, 2.0]]}, "range_m must be an array: "),
    "label": (
        {"labels": np.full((16, 20), 3)},
        "labels must be 0 to 2, 254 or 255, found 3 at row 0, column 0",
    ),
    "fractions": ({"labels": np.zeros((16, 20))}, "labels must be whole numbers, found float64"),
    "split": ({"split": "val"}, "'split' must be one of train, test, found 'val'"),
    "field": ({"fields": {"age": 3}}, "the set has the fields robot, found 'age': name it in 'fields'"),
    "kind": ({"fields": {"robot": 3}}, "field 'robot' must be of the kind text, found 3, int"),
    "value": ({"fields": {"robot": None}}, "field 'robot' must be text, a whole number, a number, true or false, "),
    "plane": (
        {"planes": {"instances": np.zeros((16, 20), int)}},
        "the samples of the set have the planes none, found instances",
    ),
    "rig": ({"rig": 1}, "rig must number one of the set's 1 rigs, found 1"),
    "no projector": (
        {"projector_range_m": None},
        "the samples of the set come with projector_range_m or projector, found neither of the two",
    ),
    "projector's size": (
        {"projector_range_m": np.ones((16, 20))},
        "projector_range_m must be 24 x 30, as the rig says, found 16 x 20",
    ),
    "facing": (
        {"facing": np.ones((16, 20), bool)},
        "samples of the set come with neither facing nor normals, found facing or normals",
    ),
    "key": ({"key": "a.b"}, "a sample key must be 1 to 80 letters, digits, '_', '+' or '-', found 'a.b'"),
    "key of another kind": ({"key": 7}, "a sample key must be 1 to 80 letters, digits, '_', '+' or '-', found '<7>'"),
    "again": ({"key": "scene-000"}, "this key was written before"),
}


def test_a_scene_that_breaks_a_rule_is_one_line_and_the_writer_goes_on(tmp_path: Path) -> None:
    with ShardWriter(tmp_path / "set", rig=RIG, classes=CLASSES) as writer:
        writer.write(**scene())
        for name, (changed, message) in WRONG.items():
            key = "" if name.startswith("key") else f"{changed.get('key', 'scene-001')}: "
            with pytest.raises(BadSample, match=f"^{re.escape(key + message)}"):
                writer.write(**scene(1, **changed))
        writer.write(**scene(2))
    assert RangeImages(tmp_path / "set").keys == ["scene-000", "scene-002"]


def test_names_of_the_first_scene_that_are_none_are_of_a_bad_sample(tmp_path: Path) -> None:
    plane = np.zeros((16, 20), int)
    with ShardWriter(tmp_path / "set", rig=RIG, classes=CLASSES) as writer:
        with pytest.raises(BadSample, match="^scene-000: a field must have .* like 'subject', none of"):
            writer.write(**scene(fields={"Lamp": "left"}))
        with pytest.raises(BadSample, match="^scene-000: a plane has .* like 'instances', none of"):
            writer.write(**scene(planes={"Instances": plane}))
        writer.write(**scene())


def test_what_an_index_could_not_hold_is_refused_before_it_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    many = {f"f{number}": "int" for number in range(4097)}
    with pytest.raises(BadShard, match="^a set has at most 4096 fields, found 4097$"):
        ShardWriter(tmp_path / "set", rig=RIG, classes=CLASSES, fields=many)
    monkeypatch.setattr("bodyseg_data.shards.index.LARGEST_PIECE", 50)
    told = pytest.raises(BadShard, match="^train-00000.tar: its index takes [0-9]+ bytes, at most 50: use smaller")
    with told, ShardWriter(tmp_path / "set", rig=RIG, classes=CLASSES, shard_samples=1, workers=0) as writer:
        writer.write(**scene())
    assert not list(tmp_path.rglob("*.tar*"))


def test_a_key_too_long_for_the_name_of_a_plane_is_one_line_and_the_writer_goes_on(tmp_path: Path) -> None:
    planes = {"material_ids": np.zeros((16, 20), np.uint8)}
    with ShardWriter(tmp_path / "set", rig=RIG, classes=CLASSES) as writer:
        for number in range(2):
            with pytest.raises(BadSample, match="^k{78}: a key and the name of a plane must .* 78 and 12 of the plane"):
                writer.write(**scene(key="k" * 78, planes=planes))
            writer.write(**scene(key=f"{number}" * 77, planes=planes))
    assert RangeImages(tmp_path / "set").keys == ["0" * 77, "1" * 77]
    assert cli.main(["verify", str(tmp_path / "set")]) == 0


@pytest.mark.parametrize(
    ("given", "stored"),
    [
        (torch.tensor(7), 7),
        (np.array(7), 7),
        (np.int64(7), 7),
        (torch.tensor(True), True),
        (torch.tensor(0.5, requires_grad=True), 0.5),
        (np.array("left"), "left"),
        (torch.tensor(2**53 - 1), 2**53 - 1),
        (np.arange(2), (0.0, 1.0)),
    ],
)
def test_fields_keep_the_kind_of_single_numbers(given: Any, stored: Any, tmp_path: Path) -> None:
    found = one(tmp_path / "set", fields={"frame": given}).info.frame
    assert found == stored and type(found) is type(stored)


@pytest.mark.parametrize("given", [["7", "42"], np.array(["7"]), [None], np.array([1 + 2j])])
def test_a_list_of_what_are_no_numbers_is_refused(given: Any, tmp_path: Path) -> None:
    with pytest.raises(BadSample, match="field 'frame' must be"):
        one(tmp_path / "set", fields={"frame": given})


def test_facing_normals_and_functions_of_another_kind_are_one_line(tmp_path: Path) -> None:
    bits, normals = np.ones((16, 20), bool), np.zeros((16, 20, 3))
    normals[..., 2] = -1
    holed = np.where(np.arange(3) == 1, np.nan, normals)
    for number, (right, wrongs) in enumerate(
        (
            (
                {"facing": bits},
                [
                    ({"facing": bits.astype(np.uint8)}, "facing must be bool [16, 20], found uint8 (16, 20)"),
                    ({"facing": bits[1:]}, "facing must be bool [16, 20], found bool (15, 20)"),
                    ({"facing": [bits, bits]}, "facing must be bool [16, 20], found bool (2, 16, 20)"),
                ],
            ),
            (
                {"normals": normals},
                [
                    ({"normals": normals.astype(int)}, "normals must be floats [16, 20, 3], found int64 (16, 20, 3)"),
                    (
                        {"normals": normals[..., :2].tolist()},
                        "normals must be floats [16, 20, 3], found float64 (16, 2",
                    ),
                    ({"normals": holed}, "normals must be finite where range_m is above 0"),
                ],
            ),
            ({}, [({"projector_range_m": None, "projector": 2.0}, "projector must be a function of rows and columns")]),
        )
    ):
        with ShardWriter(tmp_path / str(number), rig=RIG, classes=CLASSES) as writer:
            writer.write(**scene(**right))
            for wrong, message in wrongs:
                with pytest.raises(BadSample, match=f"^scene-001: {re.escape(message)}"):
                    writer.write(**scene(1, **wrong))


def test_facing_of_two_projectors_is_of_both(tmp_path: Path) -> None:
    rule = re.escape("scene-000: facing must be bool [2, 16, 20], found bool (16, 20)")
    with pytest.raises(BadSample, match=f"^{rule}$"):
        one(tmp_path / "set", TWO, projector_range_m=None, facing=np.ones((16, 20), bool))


def test_normals_of_another_frame_are_seen(tmp_path: Path) -> None:
    normals = np.zeros((16, 20, 3))
    normals[..., 2] = 1
    with (
        pytest.raises(BadConfig, match="no scene was written"),
        ShardWriter(tmp_path / "set", rig=RIG, classes=CLASSES) as writer,
    ):
        with pytest.raises(BadSample, match="towards the camera: 280 of 280 point away"):
            writer.write(**scene(normals=normals))
        with pytest.raises(BadSample, match="facing and normals are alternatives, found both"):
            writer.write(**scene(normals=normals, facing=np.ones((16, 20), bool)))


def test_options_out_of_range_are_one_line(tmp_path: Path) -> None:
    def opened(**options: Any) -> ShardWriter:
        return ShardWriter(**{"out": tmp_path / "set", "rig": RIG, "classes": CLASSES, **options})

    for options, message in (
        ({"projector": "half"}, "projector must be one of shadow, exact, none, None, found 'half'"),
        ({"rig": []}, r"a set needs at least one rig, .*, found \[\]"),
        ({"rig": CAMERA}, r"a set needs at least one rig, a Rig or its name or file, found Camera\("),
        ({"classes": "floor"}, "classes must be a list of names"),
        ({"codec": "jpeg"}, "the codec must be one of"),
        ({"part": (2, 2)}, r"part must be \(i, n\), i from 0 to n - 1, found \(2, 2\)"),
        ({"planes": {"instances": "int32"}}, "the plane 'instances' must be of the type uint8 or uint16"),
        ({"fields": {"age": "number"}}, "kind of field 'age' must be one of text, int"),
        ({"shard_samples": 0}, "shard_samples must be a whole number of at least 1"),
        ({"source": ""}, "source must be a name"),
        ({"source": 3}, "source must be a name"),
        ({"planes": ["instances"]}, r"planes must give a kind for each name, found \['instances'\]"),
        ({"fields": ["age"]}, r"fields must give a kind for each name, found \['age'\]"),
        (
            {"out": ""},
            "out must be the path of a folder of this machine, found ''",
        ),  # not the folder that a program runs in
        ({"out": None}, "out must be the path of a folder of this machine, found None"),
    ):
        with pytest.raises(BodysegError, match=message):
            opened(**options)
    with pytest.raises(BadConfig, match="a ShardWriter writes in a with statement"):
        opened().write(**scene())
    with opened() as writer:
        writer.write(**scene())
        with pytest.raises(BadConfig, match="another packing is at work"), opened():
            pass
