from __future__ import annotations

import gc
import io
import json
import os
import pickle
import shutil
import tarfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import webdataset
from samples import GOOD

from bodyseg_data.commands import main
from bodyseg_data.core import BadSample, BadShard
from bodyseg_data.shards import (
    BODY_FIELDS,
    MANIFEST_NAME,
    LocalFolder,
    ShardReader,
    TarWriter,
    encode_sample,
    find_faults,
    read_manifest,
    record_from_json,
    record_to_json,
)
from bodyseg_data.shards.codecs.png import encode_png
from bodyseg_data.shards.manifest import _digest
from bodyseg_data.shards.tar import _read_header, parse_members


@pytest.fixture
def copy(figures_set: Path, tmp_path: Path) -> Path:
    """A set that a test may spoil."""
    return Path(shutil.copytree(figures_set, tmp_path / "copy"))


# webdataset leaves closing its files to the garbage collector.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
def test_plain_webdataset_reads_every_sample(figures_set: Path) -> None:
    urls = sorted(map(str, figures_set.glob("*.tar")))
    manifest = read_manifest(figures_set)
    seen = {sample["__key__"]: sample for sample in webdataset.WebDataset(urls, shardshuffle=False)}
    assert sorted(seen) == sorted(key for shard in manifest.shards for key in shard.keys)
    gc.collect()
    for sample in seen.values():
        members = {name for name in sample if not name.startswith("__")}
        assert members == {"json", "bsi"}
        assert json.loads(sample["json"])["source"] == "open"


def test_plain_tarfile_reads_the_same_bytes_as_the_reader(figures_set: Path) -> None:
    manifest = read_manifest(figures_set)
    shard = manifest.shards[0]
    with tarfile.open(figures_set / shard.name) as tar:
        names = tar.getnames()
        first = {name.partition(".")[2]: tar.extractfile(name).read() for name in names[:2]}  # type: ignore[union-attr]
        assert all((member.mtime, member.uid, member.uname) == (0, 0, "") for member in tar)
    assert len(names) == 2 * len(shard)
    assert encode_sample(ShardReader(figures_set, manifest).read(0, 0)) == first


def test_a_manifest_says_what_is_there(figures_set: Path) -> None:
    manifest = read_manifest(figures_set)
    assert (manifest.samples(), manifest.samples("train"), manifest.samples("test")) == (24, 16, 8)
    assert [shard.name for shard in manifest.shards] == [
        *(f"train-0000{number}.tar" for number in range(4)),
        "test-00000.tar",
        "test-00001.tar",
    ]
    assert sorted(path.name for path in figures_set.iterdir()) == sorted(
        [MANIFEST_NAME, *(shard.name for shard in manifest.shards)]
    )


def test_a_reader_survives_pickling(figures_set: Path) -> None:
    reader = ShardReader(figures_set, read_manifest(figures_set))
    first = reader.read(0, 0)
    assert np.array_equal(pickle.loads(pickle.dumps(reader)).read(0, 0).range, first.range)


def test_a_sound_set_has_no_fault(figures_set: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(figures_set)]) == 0
    assert "24 samples in 6 shards" in capsys.readouterr().out


def test_a_manifest_and_its_records_print_in_one_line(figures_set: Path) -> None:
    manifest = read_manifest(figures_set)
    shard = manifest.shards[0]
    assert repr(shard) == f"ShardRecord({shard.name!r}, {len(shard.keys)} samples, {shard.size} bytes)"
    assert repr(manifest).startswith(f"Manifest({manifest.samples()} samples in {len(manifest.shards)} shards, codec=")
    assert len(repr(manifest)) < 200
    assert replace(manifest, shards=[shard]).counts == f"{len(shard)} samples in 1 shard"


def test_a_shard_cut_at_any_block_is_reported(copy: Path) -> None:
    manifest = read_manifest(copy)
    shard = manifest.shards[-1]
    path = copy / shard.name
    whole = path.read_bytes()
    assert len(whole) == shard.size
    for length in range(0, len(whole), 512):
        path.write_bytes(whole[:length])
        faults = list(find_faults(LocalFolder(copy), manifest, shard))
        hurt = [
            key
            for key, start, size in zip(shard.keys, shard.offsets, shard.lengths, strict=True)
            if start + size > length
        ]
        assert [fault.key for fault in faults] == [*hurt, "-"], length
        assert all(fault.shard == shard.name for fault in faults)
        assert [fault.offset for fault in faults[:-1]] == [shard.offsets[shard.keys.index(key)] for key in hurt]
        assert f"{shard.size} bytes expected, found {length}" in faults[-1].problem


def test_one_flipped_byte_anywhere_is_reported_at_its_sample(copy: Path) -> None:
    manifest = read_manifest(copy)
    shard = manifest.shards[0]
    path = copy / shard.name
    whole = path.read_bytes()
    generator = np.random.default_rng(0)
    places = [0, 156, 511, 512, shard.offsets[1], shard.size - 1, *generator.integers(0, shard.size, 40).tolist()]
    end = shard.offsets[-1] + shard.lengths[-1]
    for place in places:
        spoiled = bytearray(whole)
        spoiled[place] ^= 1 << int(generator.integers(8))
        path.write_bytes(spoiled)
        faults = list(find_faults(LocalFolder(copy), manifest, shard))
        assert len(faults) == 1, place
        if place < end:
            index = int(np.searchsorted(shard.offsets, place, side="right")) - 1
            assert (faults[0].key, faults[0].offset) == (shard.keys[index], shard.offsets[index])
            assert f"CRC-32 {shard.crc32[index]:08x} expected, found" in faults[0].problem
            with pytest.raises(
                BadShard, match=f"{shard.name}: {shard.keys[index]}: offset {shard.offsets[index]}: alter"
            ):
                ShardReader(copy, manifest).read(0, index)
        else:
            assert (faults[0].key, faults[0].offset) == ("-", end)
            assert "SHA-256" in faults[0].problem


def test_faults_are_one_line_each_on_the_command_line(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spoiled = bytearray((copy / "train-00001.tar").read_bytes())
    spoiled[700] ^= 1
    (copy / "train-00001.tar").write_bytes(spoiled)
    (copy / "test-00000.tar").unlink()
    (copy / "stray.tar").write_bytes(b"")
    (copy / "._train-00000.tar").write_bytes(b"")  # as macOS leaves beside files on other disks
    assert main(["verify", str(copy)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    assert lines[0].startswith("train-00001.tar: open-")
    assert lines[0].count("offset") == 1
    assert ": offset 0: altered: CRC-32" in lines[0]
    assert lines[1] == "test-00000.tar: -: offset 0: cannot be read: No such file or directory"
    assert lines[2] == "stray.tar: -: offset 0: not in the manifest"


def test_a_reader_names_a_shard_that_is_gone(copy: Path) -> None:
    manifest = read_manifest(copy)
    (copy / "train-00000.tar").unlink()
    with pytest.raises(BadShard, match=r"train-00000.tar: open-.*: offset 0: cannot be read"):
        ShardReader(copy, manifest).read(0, 0)
    (copy / "train-00000.tar").write_bytes(b"")
    with pytest.raises(BadShard, match=r"offset 0: cut short: \d+ bytes expected, found 0"):
        ShardReader(copy, manifest).read(0, 0)


def _edit(key: str, value: object) -> Callable[[bytes], bytes]:
    return lambda data: json.dumps({**json.loads(data), key: value}).encode()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda data: data[:-20], "cannot be read"),
        (
            lambda data: b"[]",
            "'format' must be one of 'bodyseg shards 5', .*, 'bodyseg shards 7', found 'list'",
        ),
        (lambda data: b"\xff\xfe", "cannot be read"),
        (lambda data: b"[" * 100_000, "cannot be read"),
        (
            lambda data: b"\n<!DOCTYPE html><html>sign in</html>",
            "cannot be read: found a web page .HTML.: is the address",
        ),
        (
            _edit("format", "bodyseg shards 3"),
            "'bodyseg shards 6', 'bodyseg shards 7', found 'bodyseg shards 3'",
        ),
        (_edit("codec", "png"), "altered after it was written: stored digest [0-9a-f]{64}, computed [0-9a-f]{64}"),
        (lambda data: data.replace(b'"samples":5', b'"samples":6', 1), "altered after it was written"),
    ],
)
def test_a_broken_manifest_is_one_line_and_exit_status_1(
    copy: Path, capsys: pytest.CaptureFixture[str], spoil: Callable[[bytes], bytes], message: str
) -> None:
    path = copy / MANIFEST_NAME
    before = path.read_bytes()
    path.write_bytes(spoil(before))
    assert path.read_bytes() != before
    with pytest.raises(BadShard, match=message):
        read_manifest(copy)
    assert main(["verify", str(copy)]) == 1
    assert len(capsys.readouterr().out.splitlines()) == 1


def _with(change: Callable[[dict[str, Any]], object]) -> Callable[[dict[str, Any]], dict[str, Any]]:
    def changed(tree: dict[str, Any]) -> dict[str, Any]:
        change(tree)
        return tree

    return changed


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_with(lambda tree: tree.update(extra=1)), "has the fields"),
        (_with(lambda tree: tree.update(codec="jpg")), "'codec' must be one of bsi, png, found 'jpg'"),
        (_with(lambda tree: tree.update(classes=["nose"])), "'classes' must have a name and a list of classes"),
        (_with(lambda tree: tree["classes"].update(classes=[])), "a set has 1 to 254 classes, found 0"),
        (_with(lambda tree: tree["classes"]["classes"][0].update(sort=1)), "a class has a name, and may have colour"),
        (_with(lambda tree: tree["classes"]["classes"][0].update(mirror=[])), "the mirror image of 'Sellion'"),
        (_with(lambda tree: tree.update(projector="all")), "'projector' must be one of shadow, exact, none"),
        (_with(lambda tree: tree.update(planes=[])), "'planes' must be an object, found list"),
        (_with(lambda tree: tree.update(planes={"A": "uint8"})), "a plane has a lower-case name"),
        (_with(lambda tree: tree.update(planes={"a": "int8"})), "the plane 'a' must be of the type uint8 or uint16"),
        (_with(lambda tree: tree.update(rigs=[])), "'rigs' must be a list of 1 to 4096"),
        (_with(lambda tree: tree.update(rigs=tree["rigs"] * 4097)), "'rigs' must be a list of 1 to 4096"),
        (
            _with(lambda tree: tree["rigs"].append(tree["rigs"][0])),
            "with 2 rigs must have the field 'rig', a whole number",
        ),
        (_with(lambda tree: tree.update(fields={})), "'fields' must be lists of pairs"),
        (_with(lambda tree: tree["fields"][0].append(["mesh", "text"])), "a field of descriptions is named once"),
        (_with(lambda tree: tree["fields"][0][0].__setitem__(1, "word")), "kind of field 'source' must be one of text"),
        (_with(lambda tree: tree["fields"][0][0].__setitem__(0, "A b")), "a field must have a lower-case name"),
        (_with(lambda tree: tree.update(source=3)), "'source' must be text, found 3"),
        (_with(lambda tree: tree.update(shards={})), "'shards' must have the fields"),
        (_with(lambda tree: tree.update(shards=[])), "'shards' must be a list of at least one"),
        (
            _with(lambda tree: tree["rigs"][0]["camera"].update(rows=float("inf"))),
            "'rows' must be a finite number, found 'inf'",
        ),
        (_with(lambda tree: tree["shards"][0].update(size=1 << 70)), "'size' must be a number of bytes"),
        (_with(lambda tree: tree["shards"][0].update(size=512)), "samples end at byte"),
        (_with(lambda tree: tree["shards"][0].update(name="../x.tar")), "a shard's name must be like train-00000.tar"),
        (_with(lambda tree: tree["shards"][0].update(name="test-00009.tar")), "must be one of train, test and start"),
        (_with(lambda tree: tree["shards"][0].update(sha256="0")), "'sha256' must be 64 hexadecimal digits"),
        (_with(lambda tree: tree["shards"][0]["lengths"].__setitem__(0, 1 << 62)), "samples must follow each other"),
        (_with(lambda tree: tree["shards"][0]["offsets"].__setitem__(0, 512)), "samples must follow each other"),
        (_with(lambda tree: tree["shards"][0]["keys"].__setitem__(0, "a.b")), "a sample key must be"),
        (_with(lambda tree: tree["shards"][0]["crc32"].pop()), "'crc32' must have one entry a sample"),
        (_with(lambda tree: tree["shards"][0]["crc32"].__setitem__(0, "x")), "'crc32' must hold int only"),
        (_with(lambda tree: tree["shards"][0].update(notes=[3])), "'notes' must be a list of text"),
        (_with(lambda tree: tree["shards"][0].pop("notes")), "a shard's record must have the fields"),
        (_with(lambda tree: tree["shards"][0].pop("split")), "a shard's record must have the fields"),
        (_with(lambda tree: tree["shards"].append(tree["shards"][0])), "must be unique"),
        (_with(lambda tree: tree["shards"][0].pop("rows")), "a shard's record must have the fields"),
        (
            _with(lambda tree: tree["shards"][0]["rows"][0].pop()),
            "'rows' must have one whole number a sample and table",
        ),
        (_with(lambda tree: tree["shards"][0]["rows"][1].__setitem__(0, 0.0)), "'rows' must have one whole number"),
        (_with(lambda tree: tree["shards"][0].update(tables={})), "'tables' must be 3 lists"),
        (_with(lambda tree: tree["shards"][0].update(rows=[[]])), "'rows' must be 3 lists"),
        (_with(lambda tree: tree["shards"][0]["tables"].__setitem__(0, [])), "table 0 must be 5 lists of one length"),
        (_with(lambda tree: tree["shards"][0]["tables"][0].pop()), "table 0 must be 5 lists of one length"),
        (_with(lambda tree: tree["shards"][0]["tables"][0].__setitem__(0, "ab")), "table 0 must be 5 lists of one"),
        (_with(lambda tree: tree["shards"][0]["tables"][1][0].pop()), "table 1 must be 5 lists of one length"),
        (
            _with(lambda tree: tree["shards"][0]["tables"][0][2].__setitem__(0, 3)),
            "'subject' must hold text or nothing",
        ),
        (_with(lambda tree: tree["shards"][0]["tables"][1][2].__setitem__(0, True)), "'pitch_deg' must hold int or"),
        (
            _with(lambda tree: tree["shards"][0]["tables"][1][0].__setitem__(0, -(10**400))),
            r"field 'distance_cm' must be below 2\*\*53",
        ),
        (
            _with(lambda tree: [column.append(column[0]) for column in tree["shards"][0]["tables"][1]]),
            "table 1 must hold each row once",
        ),
        (
            _with(lambda tree: [column.append("a") for column in tree["shards"][0]["tables"][0]]),
            "'rows' must number the rows of table 0, all, in the order of their first use",
        ),
        (_with(lambda tree: tree["shards"][0]["rows"][1].__setitem__(0, 1)), "'rows' must number the rows of table 1"),
        (_with(lambda tree: tree["shards"][0]["rows"][1].__setitem__(1, -1)), "'rows' must number the rows of table 1"),
        (_with(lambda tree: tree["shards"][0]["rows"][1].__setitem__(1, 1 << 70)), "'rows' must number the rows"),
    ],
)
def test_a_manifest_that_lies_consistently_is_refused(
    copy: Path, change: Callable[[dict[str, Any]], dict[str, Any]], message: str
) -> None:
    tree = json.loads((copy / MANIFEST_NAME).read_bytes())
    del tree["digest"]
    tree = change(tree)
    (copy / MANIFEST_NAME).write_text(json.dumps({**tree, "digest": _digest(tree)}))
    with pytest.raises(BadShard, match=message):
        read_manifest(copy)


def test_a_folder_without_a_manifest_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(tmp_path)]) == 1
    assert "holds no manifest.json: not a set of shards, or its packing has not ended" in capsys.readouterr().out
    assert main(["verify", str(tmp_path / "none")]) == 2
    assert "bodyseg verify: no such folder" in capsys.readouterr().err


def test_a_writer_that_fails_leaves_nothing(tmp_path: Path) -> None:
    def write() -> None:
        with TarWriter(tmp_path / "train-00000.tar", tmp_path / "x.part", "train") as writer:
            writer.write(GOOD.key, encode_sample(GOOD))
            assert (tmp_path / "x.part").exists()
            writer.write("no.good", {})

    with pytest.raises(BadSample, match="a sample key"):
        write()
    assert list(tmp_path.iterdir()) == []


def test_notes_are_lines_whatever_was_noted(tmp_path: Path) -> None:
    with TarWriter(tmp_path / "train-00000.tar", tmp_path / "x.part", "train") as writer:
        writer.write(GOOD.key, encode_sample(GOOD))
        writer.note("a", ["read\nfrom \ud800"])
    assert writer.record.notes == (r"a: read\nfrom \ud800",)
    assert record_from_json(json.loads(json.dumps(record_to_json(writer.record))), BODY_FIELDS, "here") == writer.record


_DESCRIPTION = (
    b'{"azimuth_deg": %d, "distance_cm": 215, "mesh": "posture-00", "pose": "standing", "source": "open", '
    b'"split": "train", "subject": "A", "subset": "A"}'
)


def test_the_shard_bytes_are_pinned(tmp_path: Path) -> None:
    """Format drift is a failing test. The members here do not depend on any compressor's version."""
    with TarWriter(tmp_path / "train-00000.tar", tmp_path / "x.part", "train") as writer:
        writer.write("k1", {"json": _DESCRIPTION % 40, "range.bsi": b"r" * 600})
        writer.write("k2", {"json": _DESCRIPTION % 50})
    record = writer.record
    assert record is not None
    assert (record.keys, record.offsets, record.lengths, record.size) == (("k1", "k2"), (0, 2560), (2560, 1024), 10240)
    assert record.sha256 == "91976987675fdbf337279d7b4037e887fc7d85d54cfe8a7aa219caea32de9404"


def _tar(*members: tuple[str, bytes, bytes]) -> bytes:
    """A tar without its end, from (name, type, data)."""
    blocks = b""
    for name, kind, data in members:
        header = tarfile.TarInfo(name)
        header.type, header.size = kind, len(data)
        blocks += header.tobuf(tarfile.USTAR_FORMAT) + data + bytes(-len(data) % 512)
    return blocks


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (_tar(("k.json", tarfile.SYMTYPE, b"")), "plain files called k"),
        (_tar(("k.json", tarfile.LNKTYPE, b"")), "plain files called k"),
        (_tar(("../k.json", tarfile.REGTYPE, b"")), "plain files called k"),
        (_tar(("/k.json", tarfile.REGTYPE, b"")), "plain files called k"),
        (_tar(("k", tarfile.REGTYPE, b"")), "plain files called k"),
        (_tar(("k.json", tarfile.REGTYPE, b""), ("k.json", tarfile.REGTYPE, b"")), "once each, found 'k.json'"),
        (_tar(("k.json", tarfile.REGTYPE, b"x" * 600))[:1024], "k.json claims 600 bytes, the sample ends before"),
        (b"x" * 512, "no tar header at byte 0"),
        (bytes(512), "no tar header at byte 0"),
        (b"short", "no tar header at byte 0"),
    ],
)
def test_tricks_in_tars_are_refused(data: bytes, message: str) -> None:
    with pytest.raises(BadSample, match=f"^k: .*{message}"):
        parse_members("k", data)


@pytest.mark.parametrize("change", [{}, {"mode": 0o600}, {"mtime": 1}, {"uname": "me"}, {"name": "k.a\u00e9"}])
def test_headers_say_what_tarfile_says_whoever_wrote_them(change: dict[str, Any]) -> None:
    for name, size in (("k.bsi", 0), ("k" * 80 + ".projector.png", 8), ("k.json", 8**11 - 1)):
        header = tarfile.TarInfo(name)
        header.mode = 0o644
        header.size = size
        for field, value in change.items():
            setattr(header, field, value)
        block = header.tobuf(tarfile.USTAR_FORMAT, "utf-8")
        assert _read_header(block) == (header.name, tarfile.REGTYPE, size)
        for place in range(512):
            altered = bytearray(block)
            altered[place] ^= 1
            try:
                expected = tarfile.TarInfo.frombuf(bytes(altered), "utf-8", "strict")
            except tarfile.HeaderError:
                with pytest.raises(tarfile.HeaderError):
                    _read_header(bytes(altered))
            else:
                assert _read_header(bytes(altered)) == (expected.name, expected.type, expected.size)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"labels": np.full_like(GOOD.labels, 3)}, "labels must be 255 exactly where range is 0"),
        ({}, "range must be 160 x 82 as in the rig, found (2, 2)"),
    ],
)
def test_content_that_breaks_the_format_is_a_fault_though_its_checksums_are_right(
    change: dict[str, Any], problem: str, figures_set: Path, tmp_path: Path
) -> None:
    with TarWriter(tmp_path / "train-00000.tar", tmp_path / "x.part", "train") as writer:
        writer.write(GOOD.key, encode_sample(replace(GOOD, **change), "png"))  # which stores anything
    manifest = replace(read_manifest(figures_set), shards=(writer.record,))
    (fault,) = find_faults(LocalFolder(tmp_path), manifest, writer.record)
    assert (fault.key, fault.offset, fault.problem) == (GOOD.key, 0, problem)


def test_a_sample_of_another_rig_is_not_given_though_its_checksums_are_right(figures_set: Path, tmp_path: Path) -> None:
    good = read_manifest(figures_set)
    sample = ShardReader(figures_set, good).read(0, 0)
    members = encode_sample(sample, "png")
    few = encode_png(np.zeros((1, 1), np.uint8))
    with TarWriter(tmp_path / "train-00000.tar", tmp_path / "x.part", "train") as writer:
        writer.write(GOOD.key, encode_sample(GOOD))
        writer.write(sample.key, members | {"labels.png": few})
    reader = ShardReader(tmp_path, replace(good, shards=(writer.record,)))
    with pytest.raises(
        BadShard, match=rf"^train-00000.tar: {GOOD.key}: offset 0: .*range must be 160 x 82 as in the rig"
    ):
        reader.read(0, 0, projector=False)
    with pytest.raises(BadShard, match=r"labels must be 160 x 82 as in the rig, found \(1, 1\)"):
        reader.read(0, 1)


def test_a_pipe_in_place_of_a_shard_keeps_nobody_waiting(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (copy / "train-00000.tar").unlink()
    os.mkfifo(copy / "train-00000.tar")
    with pytest.raises(BadShard, match="offset 0: cannot be read: Illegal seek"):
        ShardReader(copy, read_manifest(copy)).read(0, 0)
    assert main(["verify", str(copy)]) == 1
    assert "train-00000.tar: -: offset 0: cannot be read: Illegal seek" in capsys.readouterr().out


def test_a_sample_stored_in_the_wrong_split_is_a_fault(copy: Path) -> None:
    manifest = read_manifest(copy)
    shard = manifest.shards[0]
    faults = list(find_faults(LocalFolder(copy), manifest, replace(shard, split="test")))
    assert [fault.problem for fault in faults] == ["belongs to train, stored among test"] * len(shard)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"planes": {"instances": "uint16"}}, "the set has the planes {'instances': 'uint16'}, found none"),
        ({"projector": "none"}, "the set's projector range is 'none', the sample says otherwise"),
    ],
)
def test_samples_that_hold_other_images_than_the_set_says_are_faults(
    figures_set: Path, changes: dict[str, Any], problem: str
) -> None:
    manifest = replace(read_manifest(figures_set), **changes)
    shard = manifest.shards[0]
    assert [fault.problem for fault in find_faults(LocalFolder(figures_set), manifest, shard)] == [problem] * len(shard)


def test_the_manifest_describes_every_sample_as_it_describes_itself(figures_set: Path) -> None:
    manifest = read_manifest(figures_set)
    reader = ShardReader(figures_set, manifest)
    for number, shard in enumerate(manifest.shards):
        described = [shard.descriptions.info(index, shard.split) for index in range(len(shard))]
        assert described == [reader.read(number, index).info for index in range(len(shard))]
    first = manifest.shards[0].descriptions
    assert repr(first) == "Descriptions(12 fields, [2, 4, 1] rows)"
    assert first.rows == ((0, 0, 0, 0, 1), (0, 1, 2, 3, 0), (0,) * 5)


@pytest.mark.parametrize(
    ("table", "column", "value", "field"),
    [
        (0, 4, "sitting", "'pose' is 'standing', in the manifest 'sitting'"),
        (1, 3, 7, "'roll_deg' is 0, in"),
    ],
)
def test_a_description_that_differs_from_the_samples_own_is_a_fault(
    copy: Path, capsys: pytest.CaptureFixture[str], table: int, column: int, value: object, field: str
) -> None:
    tree = json.loads((copy / MANIFEST_NAME).read_bytes())
    del tree["digest"]
    tree["shards"][0]["tables"][table][column][0] = value
    (copy / MANIFEST_NAME).write_text(json.dumps({**tree, "digest": _digest(tree)}))
    shard = read_manifest(copy).shards[0]
    row = shard.descriptions.rows[table]
    assert main(["verify", str(copy)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == row.count(0) > 0
    assert all(f": the description differs from the manifest's: {field}" in line for line in lines)
    assert lines[0].startswith(f"train-00000.tar: {shard.keys[0]}: offset 0: the description")


def test_a_sample_without_a_description_is_not_written(tmp_path: Path) -> None:
    members = encode_sample(GOOD)
    for wrong in ({"bsi": members["bsi"]}, members | {"json": b"{}"}):
        with (
            pytest.raises(BadSample, match=f"^{GOOD.key}: "),
            TarWriter(tmp_path / "train-00000.tar", tmp_path / "x.part", "train") as writer,
        ):
            writer.write(GOOD.key, wrong)
    assert list(tmp_path.iterdir()) == []


def test_members_of_a_sample_come_back(tmp_path: Path) -> None:
    data = _tar(("k.json", tarfile.REGTYPE, b"{}"), ("k.range.bsi", tarfile.REGTYPE, b"x" * 700))
    assert parse_members("k", data) == {"json": b"{}", "range.bsi": b"x" * 700}
    with tarfile.open(fileobj=io.BytesIO(data + bytes(1024))) as tar:
        assert tar.getnames() == ["k.json", "k.range.bsi"]
