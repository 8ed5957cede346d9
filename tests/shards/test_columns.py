"""Columns: planes and fields that a set gets later, beside its files."""

from __future__ import annotations

import hashlib
import json
import pickle
import shutil
from array import array
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from open_sets import cell_rig
from servers import web_server

from bodyseg_data import BadConfig, BadSample, BadShard, ColumnWriter, RangeImages, ShardWriter, loader
from bodyseg_data.shards import LocalFolder, columns, find_faults, read_manifest, write_manifest
from bodyseg_data.shards import manifest as manifests
from bodyseg_data.shards.columns import read_column
from bodyseg_data.shards.manifest import _digest
from bodyseg_model.commands import main


@pytest.fixture
def copy(small_set: Path, tmp_path: Path) -> Path:
    """A set that a test may spoil."""
    return Path(shutil.copytree(small_set, tmp_path / "set"))


def instances(key: str, shape: tuple[int, int]) -> np.ndarray[Any, Any]:
    """A plane that follows from a sample's key."""
    return np.full(shape, int.from_bytes(hashlib.sha256(key.encode()).digest()[:2], "little"), np.uint16)


BOTH = ("instances", "age")


def with_both(folder: Path) -> Path:
    """Give a set a plane, in reverse order, and a field."""
    images = RangeImages(folder, "none")
    with ColumnWriter(folder, "instances", "uint16") as column:
        for key in reversed(images.keys):
            column.write(key, instances(key, images.shape))
    with ColumnWriter(folder, "age", "int") as column:
        for number, key in enumerate(images.keys):
            column.write(key, np.int32(20 + number))
    return folder


def hashes(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def test_columns_come_without_a_change_of_the_set_and_are_read_with_it(
    copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = hashes(copy)
    with_both(copy)
    after = hashes(copy)
    assert {name: after[name] for name in before} == before
    assert sorted(set(after) - set(before)) == sorted(
        ["age.column.json", "instances.column.json", "columns.json"]
        + [name.replace(".tar", f".{column}.tar") for name in before if name.endswith(".tar") for column in BOTH]
    )
    images = RangeImages(copy, "none", columns=("instances", "age"))
    for index, key in enumerate(images.keys):
        sample = images.clean(index)
        assert np.array_equal(sample.planes["instances"], instances(key, images.shape))
        assert sample.info.age == images.describe(index)["age"] == 20 + index
    assert images.table()["age"].tolist() == [*range(20, 44)]
    wanted = [key for index, key in enumerate(images.keys) if 25 <= 20 + index <= 40 and "-d215-" in key]
    assert RangeImages(copy, "none", where=("age=25..40", "distance_cm=215")).keys == wanted
    assert pickle.loads(pickle.dumps(images)).table()["age"].tolist() == [*range(20, 44)]
    assert "columns" in images.identity() and "columns" not in RangeImages(copy, "none").identity()
    assert main(["verify", str(copy)]) == 0
    assert "columns: age, instances: no fault" in capsys.readouterr().out
    assert main(["inspect", str(copy), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["columns"] == ["age", "instances"]


def test_images_are_the_same_bits_with_columns(copy: Path, small_set: Path) -> None:
    with_both(copy)
    plain, more = RangeImages(small_set, "all"), RangeImages(copy, "all", columns=("instances", "age"))
    for ours, theirs in zip(loader(more, 5, num_workers=1), loader(plain, 5), strict=True):
        assert torch.equal(ours["range"], theirs["range"]) and torch.equal(ours["labels"], theirs["labels"])


@pytest.mark.parametrize(
    ("kind", "given", "stored"),
    [
        ("text", "left", "left"),
        ("float", 3, 3.0),
        ("float", np.float32(0.5), 0.5),
        ("flag", True, True),
        ("numbers", [1, 2.5], (1.0, 2.5)),
        ("numbers", np.eye(2)[0], (1.0, 0.0)),
        ("numbers", [np.float32(0.5), np.int64(2)], (0.5, 2.0)),
        ("numbers", torch.tensor([0.5]), (0.5,)),
        ("numbers", torch.tensor([0.5], dtype=torch.bfloat16), (0.5,)),
        ("numbers", array("d", [0.5]), (0.5,)),
        ("uint8", torch.ones(160, 82, dtype=torch.int64), np.ones((160, 82), np.uint8)),
    ],
)
def test_values_are_taken_as_users_have_them(copy: Path, kind: str, given: Any, stored: Any) -> None:
    images = RangeImages(copy, "none")
    if kind == "uint8":
        given, stored = given[: images.shape[0], : images.shape[1]], stored[: images.shape[0], : images.shape[1]]
    with ColumnWriter(copy, "mine", kind) as column:
        for key in images.keys:
            column.write(key, given)
    sample = RangeImages(copy, "none", columns="mine").clean(3)
    found = sample.planes["mine"] if kind == "uint8" else sample.info.mine
    assert np.array_equal(found, stored) and type(found) is type(stored)


def test_a_column_may_be_written_in_any_order_once_and_whole(copy: Path) -> None:
    images = RangeImages(copy, "none")

    def write(kind: str, *values: Any) -> None:
        with ColumnWriter(copy, "mine", kind) as column:
            for key, value in zip((*images.keys, images.keys[0]), values, strict=False):
                column.write(key, value)

    plane = np.zeros(images.shape, np.uint8)
    bad: list[tuple[str, list[Any], str]] = [
        ("int", [1] * 23, f"must have every sample of the set: 1 of 24 are missing, {images.keys[23]} the first"),
        ("int", [1] * 25, f"{images.keys[0]} was written before"),
        ("int", ["a"], "field 'mine' must be of the kind int, found 'a'"),
        ("float", [np.ma.masked], "field 'mine' must be text, a whole number, .*, found masked"),
        ("numbers", [np.ma.masked_equal([0.0, 1.0], 0)], "field .mine. must be text, .*, found masked_array"),
        ("uint8", [*[plane] * 8, plane + 0.5], r"plane 'mine' must hold whole numbers \(160, 82\), found float64"),
        ("uint8", [plane[:-1]], "found uint8"),
        ("uint8", [plane - np.int16(1)], "plane 'mine' must be uint8, found -1 to -1"),
        ("uint8", [np.ma.masked_equal(plane, 0)], "plane 'mine' must have no masked values, but a number for them"),
        ("uint8", [[[1, 2], [3]]], f"{images.keys[0]}: plane 'mine' must be an array: "),
        ("uint8", [torch.zeros(images.shape, requires_grad=True)], "must hold whole numbers .*, found float32"),
    ]
    before = hashes(copy)
    for kind, values, message in bad:
        with pytest.raises(BadSample, match=message.replace("160, 82", "{}, {}".format(*images.shape))):
            write(kind, *values)
        assert hashes(copy) == before, message
    with pytest.raises(BadSample, match="the set has no sample 'other'"), ColumnWriter(copy, "mine", "int") as column:
        column.write("other", 1)
    for name, kind, message in [
        ("Mine", "int", "a field must have a lower-case name"),
        ("range", "uint8", "a plane has a lower-case name"),
        (
            "mine",
            "int8",
            "a column is of the kind uint8 or uint16, or a field: .*'mine' .* text, .*, found 'int8'",
        ),
        ("subject", "text", "the set itself has 'subject' already"),
    ]:
        with pytest.raises(BadConfig, match=message):
            ColumnWriter(copy, name, kind)
    writer = ColumnWriter(copy, "other", "int")
    with pytest.raises(BadConfig, match="another ColumnWriter is at work"), ColumnWriter(copy, "mine", "int"):
        writer.__enter__()
    with_both(copy)
    with pytest.raises(BadConfig, match="has the column 'age': delete age.column.json to write it anew"):
        ColumnWriter(copy, "age", "int")


@pytest.mark.parametrize("kind", ["int", "uint8"])
def test_a_column_finished_since_the_writer_was_made_stays(copy: Path, kind: str) -> None:
    images = RangeImages(copy, "none")
    value: Any = np.ones(images.shape, np.uint8) if kind == "uint8" else 1
    first, late = ColumnWriter(copy, "mine", kind), ColumnWriter(copy, "mine", kind)
    with first:
        for key in images.keys:
            first.write(key, value)
    written = hashes(copy)
    for writer in (late, first):
        with pytest.raises(BadConfig, match="has the column 'mine': delete mine.column.json to"), writer:
            raise AssertionError("the block begins")
        assert hashes(copy) == written
    for path in [*copy.glob("*mine*"), copy / "columns.json"]:
        path.unlink()
    with late:  # once it is deleted
        for key in images.keys:
            late.write(key, value)
    assert hashes(copy) == written


def test_a_column_whose_writer_was_killed_before_it_was_listed_is_written_anew(copy: Path) -> None:
    written = hashes(with_both(copy))
    (copy / "columns.json").write_text('{"columns": ["instances"]}')
    with ColumnWriter(copy, "age", "int") as column:
        for number, key in enumerate(RangeImages(copy, "none").keys):
            column.write(key, 20 + number)
    assert hashes(copy) == written


def test_a_column_that_cannot_be_listed_leaves_nothing(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = hashes(copy)

    def full(path: Path, data: bytes) -> None:
        if path.name == "columns.json":
            raise OSError(28, "No space left on device")
        path.write_bytes(data)

    monkeypatch.setattr(columns, "write_atomically", full)
    with pytest.raises(BadConfig, match="No space left on device"), ColumnWriter(copy, "age", "int") as column:
        for number, key in enumerate(RangeImages(copy, "none").keys):
            column.write(key, number)
    assert hashes(copy) == before


def test_a_writer_without_a_block_says_so(copy: Path) -> None:
    """Its column would be tars without a manifest."""
    before = sorted(copy.iterdir())
    writer = ColumnWriter(copy, "quality", "text")
    for _ in range(2):
        with pytest.raises(BadConfig, match=r"writes in a with statement: with ColumnWriter\(...\) as column"):
            writer.write(RangeImages(copy, "none").keys[0], "good")
        with pytest.raises(RuntimeError, match="left"), writer:
            raise RuntimeError("left")
    assert sorted(path for path in copy.iterdir() if path.name != ".lock") == before


def test_a_key_too_long_for_a_plane_is_told_at_once(tmp_path: Path) -> None:
    rig = cell_rig()
    ranges, key = np.ones((rig.camera.rows, rig.camera.columns)), "k" * 80
    with ShardWriter(tmp_path / "set", rig=rig, classes=["a"], projector="none") as out:
        out.write(key=key, range_m=ranges, labels=np.zeros_like(ranges, np.uint8))
    plane = np.zeros(ranges.shape, np.uint8)
    with ColumnWriter(tmp_path / "set", "nine_long", "uint8") as column:
        column.write(key, plane)
    with ColumnWriter(tmp_path / "set", "a_longer_field", "int") as column:
        column.write(key, 1)
    message = f"^{key}: a key and the name of a plane must have 89 characters at most, found 80 and 10 of .*'ten_lon.*$"
    with pytest.raises(BadSample, match=message), ColumnWriter(tmp_path / "set", "ten_longer", "uint8") as column:
        column.write(key, plane)
    assert main(["verify", str(tmp_path / "set")]) == 0


def test_a_field_beyond_those_that_a_description_may_have_is_refused(tmp_path: Path) -> None:
    rig, fields = cell_rig(), {f"f{number}": number for number in range(64)}
    ranges = np.ones((rig.camera.rows, rig.camera.columns))
    labels = np.zeros(ranges.shape, np.uint8)
    with ShardWriter(tmp_path / "set", rig=rig, classes=["a"], projector="none") as out:
        out.write(key="scene", range_m=ranges, labels=labels, fields=fields)
    refused = pytest.raises(BadSample, match="^scene: a description has at most 64 fields, found 65$")
    with refused, ColumnWriter(tmp_path / "set", "more", "int") as column:
        column.write("scene", 3)
    with ShardWriter(tmp_path / "one_left", rig=rig, classes=["a"], projector="none") as out:
        fewer = {**fields}
        del fewer["f0"]
        out.write(key="scene", range_m=ranges, labels=labels, fields=fewer)
    for name, kind, value in (("more", "int", 3), ("instances", "uint8", labels)):
        with ColumnWriter(tmp_path / "one_left", name, kind) as column:
            column.write("scene", value)
    refused = pytest.raises(BadSample, match="^scene: a description has at most 64 fields, found 65$")
    with refused, ColumnWriter(tmp_path / "one_left", "other", "int") as column:
        column.write("scene", 3)
    with ColumnWriter(tmp_path / "set", "instances", "uint8") as column:
        column.write("scene", labels)
    assert RangeImages(tmp_path / "set", "none", columns="instances").clean(0).info.fields == fields


def test_damage_of_a_column_is_one_line(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with_both(copy)
    capsys.readouterr()
    tar = copy / "train-00001.instances.tar"
    column = read_column(copy, read_manifest(copy), "instances").shards[1]
    whole = {path.name: path.read_bytes() for path in copy.iterdir()}

    def lines() -> list[str]:
        assert main(["verify", str(copy)]) == 1
        found = capsys.readouterr().out.splitlines()
        for name, data in whole.items():
            (copy / name).write_bytes(data)
        return found

    place = column.entry(3).offset + 600
    for at, key in ((place, column.entry(3).key), (len(whole[tar.name]) - 1, "-")):
        data = bytearray(whole[tar.name])
        data[at] ^= 1
        tar.write_bytes(data)
        if key != "-":
            with pytest.raises(BadShard, match=f"{tar.name}: {key}: offset .*: altered: CRC-32"):
                RangeImages(copy, "none", columns="instances").clean(11)
        (line,) = lines()
        assert line.startswith(f"{tar.name}: {key}: offset ") and "altered" in line
    tar.unlink()
    assert lines() == [f"{tar.name}: -: offset 0: cannot be read: No such file or directory"]
    (copy / "age.column.json").write_bytes(whole["age.column.json"].replace(b"43]", b"44]"))
    with pytest.raises(BadShard, match="age.column.json: altered after it was written"):
        RangeImages(copy, where="age>3")
    (line,) = lines()
    assert "age.column.json: altered after it was written" in line
    (copy / "age.column.json").unlink()
    assert lines() == [f"{copy} holds no age.column.json: no such column"]
    (copy / "columns.json").write_text("[]")
    assert lines()[0].startswith(f"{copy}/columns.json must be an object with the names of 'columns'")
    (copy / "test-00000.other.tar").write_bytes(b"")
    assert lines() == ["test-00000.other.tar: -: offset 0: not in the manifest"]


def test_a_column_of_another_set_is_refused(copy: Path, figures_set: Path, tmp_path: Path) -> None:
    other = Path(shutil.copytree(figures_set, tmp_path / "other"))
    with_both(copy)
    for name in ("age.column.json", "columns.json"):
        shutil.copy(copy / name, other / name)
    line = "age.column.json is a column of another set: digest [0-9a-f]{64}, here [0-9a-f]{64}"
    with pytest.raises(BadShard, match=line):
        RangeImages(other, columns="age")
    assert len(RangeImages(other, "none")) == 24  # which asks for none
    with pytest.raises(BadShard, match="holds no other.column.json: no such column"):
        RangeImages(copy, columns="other")
    with pytest.raises(BadShard, match="a field must have a lower-case name like .*, found '../age'"):
        RangeImages(copy, columns="../age")


def _renamed(tree: dict[str, Any]) -> None:
    tree["shards"][0]["name"] = "train-00000.other.tar"


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("age", lambda tree: tree.update(fields=[[["age", "float"]]]), "'age' must hold float or nothing"),
        ("age", lambda tree: tree.update(fields=[[["years", "int"]]]), "the plane or the field of its name"),
        ("instances", lambda tree: tree.update(planes={}), "a column must be the plane or the field of its name"),
        ("instances", lambda tree: tree["shards"].pop(), "must have a tar of as many samples for each shard"),
        ("instances", lambda tree: tree.update(codec="png"), "in the set's codec"),
        ("instances", _renamed, "must have a tar of as many samples for each shard"),
        ("instances", lambda tree: tree["shards"][0].update(size=3), "samples end at byte"),
    ],
)
def test_a_column_that_lies_consistently_is_refused(
    copy: Path, name: str, change: Callable[[dict[str, Any]], object], message: str
) -> None:
    with_both(copy)
    path = copy / f"{name}.column.json"
    tree = json.loads(path.read_bytes())
    del tree["digest"]
    change(tree)
    path.write_text(json.dumps({**tree, "digest": _digest(tree)}))
    with pytest.raises(BadShard, match=message):
        RangeImages(copy, columns=name)


def test_a_value_and_a_plane_that_differ_from_the_manifest_are_found(copy: Path) -> None:
    with_both(copy)
    store, manifest = LocalFolder(copy), read_manifest(copy)
    column = read_column(store, manifest, "age")
    other = replace(column, shards=[replace(column.shards[0], descriptions=column.shards[1].descriptions)])
    faults = [*map(str, find_faults(store, other, other.shards[0], is_column=True))]
    assert len(faults) == 8 and faults[0].endswith(
        "differs from the column's manifest: 'age' is 20, in the manifest 28"
    )
    plane = read_column(store, manifest, "instances")
    for changed in (replace(plane, planes={"instances": "uint8"}), replace(plane, planes={"other": "uint16"})):
        assert len([*find_faults(store, changed, plane.shards[0], is_column=True)]) == 8


def test_columns_travel_with_their_set(copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["push", str(copy), str(tmp_path / "there")]) == 0
    with_both(copy)
    assert main(["push", str(copy), str(tmp_path / "there")]) == 0
    pytest.importorskip("aiohttp")
    with web_server(copy) as server:
        assert main(["pull", server.url("good"), str(tmp_path / "back")]) == 0
        cache = tmp_path / "cache"
        remote = RangeImages(server.url("good"), "none", columns=BOTH, planes="instances", cache=cache)
        assert remote.clean(20).planes["instances"][0, 0] == instances(remote.keys[20], (1, 1))[0, 0]
        batches = loader(remote, 6)
        assert sum(len(batch["key"]) for batch in batches) == len(remote)
        assert batches.stats()["hits"] + batches.stats()["stalls"] == len(remote), "of two files, a sample counts once"
    assert hashes(tmp_path / "there") == hashes(tmp_path / "back") == hashes(copy)
    assert main(["verify", str(tmp_path / "back")]) == 0
    assert "columns: age, instances: no fault" in capsys.readouterr().out


def test_samples_of_a_set_with_an_index_may_have_few_each_of_many_fields(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(manifests, "INDEXED_FROM", 1)
    rig, kinds = cell_rig(), {f"f{number}": "int" for number in range(70)}
    ranges = np.ones((rig.camera.rows, rig.camera.columns))
    labels = np.zeros(ranges.shape, np.uint8)
    with ShardWriter(tmp_path / "set", rig=rig, classes=["a"], projector="none", fields=kinds) as out:
        for name in kinds:
            out.write(key=f"scene-{name}", range_m=ranges, labels=labels, fields={name: 3})
    images = RangeImages(tmp_path / "set", "none")
    assert images.manifest.index is not None
    assert [images.clean(index).info.fields for index in range(70)] == [{name: 3} for name in kinds]


def test_columns_belong_to_sets_with_an_index_too(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(manifests, "INDEXED_FROM", 1)
    write_manifest(read_manifest(copy), copy)
    with_both(copy)
    images = RangeImages(copy, "none", where="age=25..27", columns="instances")
    assert read_manifest(copy).index is not None and len(images) == 3
    again = pickle.loads(pickle.dumps(images))
    assert [again.describe(index)["age"] for index in range(3)] == [25, 26, 27]
    assert again.clean(1).planes["instances"][0, 0] == instances(images.keys[1], (1, 1))[0, 0]
    assert main(["verify", str(copy)]) == 0


def test_samples_in_any_order_read_an_index_no_more_often_than_in_its_own(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(manifests, "INDEXED_FROM", 1)
    write_manifest(read_manifest(copy), copy)
    keys = [shard.keys for shard in read_manifest(copy).shards]
    with ColumnWriter(copy, "age", "int") as column:
        for one_of_each in zip(*keys, strict=True):
            for key in one_of_each:
                column.write(key, 3)
        shards: Any = column._set.shards
        assert shards.whole.cache_info().misses == 2 * len(keys), "to begin, and where all of a shard is there"
