"""Sets with an index: the same samples as without one, read piece by piece, and every damage found."""

from __future__ import annotations

import json
import pickle
import random
import shutil
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import pytest
from benches.cards.croissant import croissant
from benches.cards.facts import Publication, set_facts

from bodyseg_data import RangeImages, loader
from bodyseg_data.commands import main
from bodyseg_data.core import BadShard
from bodyseg_data.samples import ViewGrid
from bodyseg_data.shards import (
    BODY_FIELDS,
    MANIFEST_NAME,
    LocalFolder,
    Manifest,
    RemoteFolder,
    ShardRecord,
    Unreachable,
    index,
    manifest,
    read_manifest,
    record_from_json,
    record_to_json,
    write_manifest,
)
from bodyseg_data.shards.index import (
    INDEX_NAME,
    LARGEST_PIECE,
    IndexedShards,
    Piece,
    ShardTable,
    encode_piece,
    table_from_json,
)
from bodyseg_data.transfer import LocalTarget, set_bundle, transfer

Count = Callable[[str], int]


@pytest.fixture(scope="module")
def indexed_set(small_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the small set, with an index."""
    folder = tmp_path_factory.mktemp("indexed") / "shards"
    shutil.copytree(small_set, folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(manifest, "INDEXED_FROM", 24)
        write_manifest(read_manifest(folder), folder)
    return folder


@pytest.fixture
def copied(indexed_set: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(indexed_set, tmp_path / "copied"))


def table_of(folder: Path) -> ShardTable:
    table = read_manifest(folder).index
    assert table is not None
    return table


def test_records_and_digest_are_those_that_were_written(small_set: Path, indexed_set: Path) -> None:
    plain, found = read_manifest(small_set), read_manifest(indexed_set)
    assert [record_to_json(shard) for shard in found.shards] == [record_to_json(shard) for shard in plain.shards]
    assert (found.index is None, plain.index is None) == (False, True)
    assert found.digest == json.loads((indexed_set / MANIFEST_NAME).read_bytes())["digest"]
    assert (found.samples(), found.samples("test"), found.notes()) == (24, plain.samples("test"), plain.notes())
    assert repr(found.shards[0]) == repr(plain.shards[0])
    assert [shard.name for shard in found.shards[1:]] == [shard.name for shard in plain.shards[1:]]
    assert found.shards[-1].entry(0) == plain.shards[-1].entry(0)
    copy = pickle.loads(pickle.dumps(found))
    assert [shard.keys for shard in copy.shards] == [shard.keys for shard in plain.shards]
    assert record_to_json(pickle.loads(pickle.dumps(found.shards[1]))) == record_to_json(plain.shards[1])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"split": "train"},
        {"split": "test", "only": "*-d215-*"},
        {"where": ["azimuth_deg=0..180", "pose!=x*"]},
        {"split": "train", "val_share": 0.3},
        {"split": "val", "val_share": 0.3, "where": "distance_cm<=255"},
    ],
)
def test_a_set_is_the_same_with_and_without_an_index(
    options: dict[str, Any], small_set: Path, indexed_set: Path
) -> None:
    plain, found = RangeImages(small_set, **options), RangeImages(indexed_set, **options)
    assert found.keys == plain.keys
    assert found.identity() == plain.identity()
    assert [found.location(at) for at in range(len(found))] == [plain.location(at) for at in range(len(plain))]
    assert found.stored_bytes() == plain.stored_bytes()
    assert found.requests(3).part(0, len(found)) == plain.requests(3).part(0, len(plain))
    assert found[0]["range"].equal(plain[0]["range"])


def test_a_loader_goes_on_with_the_state_of_the_set_without_an_index(small_set: Path, indexed_set: Path) -> None:
    plain = loader(RangeImages(small_set, split="train"), 4)
    batches = iter(plain)
    next(batches)
    other = loader(RangeImages(indexed_set, split="train"), 4)
    other.load_state_dict(plain.state_dict())
    assert next(iter(other))["key"] == next(batches)["key"]


def test_opening_a_set_reads_no_piece(indexed_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And one sample reads one piece: what is read grows with what is asked for."""
    read: list[str] = []
    plain = LocalFolder.read

    def counted(self: LocalFolder, name: str, offset: int, length: int) -> bytes:
        read.append(name)
        return plain(self, name, offset, length)

    monkeypatch.setattr(LocalFolder, "read", counted)
    images = RangeImages(indexed_set, split="train")
    order = images.batches(4, rank=0, world_size=1)
    next(iter(order))
    assert read == []
    for _ in range(3):
        images.image(len(images) - 1)
    assert read.count(INDEX_NAME) == 1


def test_a_remote_index_is_fetched_by_pieces_and_then_whole(
    indexed_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fsspec = pytest.importorskip("fsspec")
    files = fsspec.filesystem("memory")
    for file in indexed_set.iterdir():
        files.pipe_file(f"/sets/indexed/{file.name}", file.read_bytes())
    address, kept = "memory://sets/indexed", tmp_path / f"{table_of(indexed_set).sha256}.tar"
    local = RangeImages(indexed_set, split=None)
    for few, held in ((64, False), (1, True)):
        monkeypatch.setattr(index, "FETCHED_PIECES", few)
        images = RangeImages(address, split=None, cache=tmp_path)
        assert not kept.exists(), "opening needs no piece"
        assert images.keys == local.keys
        assert kept.exists() == held
    assert kept.read_bytes() == (indexed_set / INDEX_NAME).read_bytes()
    assert RangeImages(address, cache=tmp_path, cache_bytes=0)[0]["key"] == local.keys[0]
    files.pipe_file(f"/sets/indexed/{INDEX_NAME}", bytes(table_of(indexed_set).size))
    with pytest.raises(BadShard, match=r"samples.index: train-00000.tar: offset 0: altered: CRC-32"):
        RangeImages(address, cache_bytes=0).location(0)
    files.rm(f"/sets/indexed/{INDEX_NAME}")
    with pytest.raises(Unreachable, match=r"sets/indexed/samples\.index"):
        RangeImages(address, cache_bytes=0).location(0)


def test_without_a_cache_a_remote_index_is_held_in_memory(indexed_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = pytest.importorskip("fsspec").filesystem("memory")
    for file in indexed_set.iterdir():
        files.pipe_file(f"/sets/held/{file.name}", file.read_bytes())
    read: list[tuple[int, int]] = []
    plain = RemoteFolder.read

    def counted(self: RemoteFolder, name: str, offset: int, length: int) -> bytes:
        read.append((offset, length))
        return plain(self, name, offset, length)

    monkeypatch.setattr(RemoteFolder, "read", counted)
    monkeypatch.setattr(index, "FETCHED_PIECES", 1)
    monkeypatch.setattr(index, "HELD_PIECES", 1)
    images = RangeImages("memory://sets/held", split=None, cache_bytes=0)
    for _ in range(2):
        assert images.keys == RangeImages(indexed_set, split=None).keys
    table = table_of(indexed_set)
    assert read == [(0, int(table.ends[0])), (0, table.size)], "a piece, and then once all of them"
    whole = files.cat_file(f"/sets/held/{INDEX_NAME}")
    altered = iter([bytes(table.size), whole])
    monkeypatch.setattr(RemoteFolder, "read", lambda *_: next(altered))
    monkeypatch.setattr(index, "FETCHED_PIECES", 0)
    again = RangeImages("memory://sets/held", split=None, cache_bytes=0)
    assert again.keys == images.keys, "what a network altered is fetched again"


def test_one_thread_fetches_the_index_that_is_held_in_memory(
    indexed_set: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = pytest.importorskip("fsspec").filesystem("memory")
    for file in indexed_set.iterdir():
        files.pipe_file(f"/sets/one/{file.name}", file.read_bytes())
    plain, size = RemoteFolder.read, table_of(indexed_set).size
    begun, other_read = threading.Event(), threading.Event()

    def slow(self: RemoteFolder, name: str, offset: int, length: int) -> bytes:
        if length == size:
            assert not begun.is_set(), "once"
            begun.set()
            assert other_read.wait(20)
        return plain(self, name, offset, length)

    monkeypatch.setattr(RemoteFolder, "read", slow)
    monkeypatch.setattr(index, "FETCHED_PIECES", 0)
    images, local = RangeImages("memory://sets/one", split=None, cache_bytes=0), RangeImages(indexed_set, split=None)
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(images.location, 0)
        assert begun.wait(20)
        assert images.location(len(images) - 1) == local.location(len(images) - 1)
        other_read.set()
        assert first.result() == local.location(0)
    assert images.keys == local.keys


def test_descriptions_one_by_one_parse_a_shard_once(indexed_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parsed: list[str] = []

    def counted(tree: dict[str, Any], *given: Any) -> ShardRecord:
        parsed.append(tree["name"])
        return record_from_json(tree, *given)

    monkeypatch.setattr(index, "record_from_json", counted)
    images = RangeImages(indexed_set)
    found = [images.describe(number)["key"] for number in range(len(images))]
    assert parsed == [shard.name for shard in images.manifest.shards]
    assert found == images.keys


def test_small_sets_have_no_index(copied: Path, small_set: Path) -> None:
    write_manifest(read_manifest(copied), copied)
    assert (copied / MANIFEST_NAME).read_bytes() == (small_set / MANIFEST_NAME).read_bytes()
    assert not (copied / INDEX_NAME).exists()


def test_an_index_that_cannot_be_written_leaves_none(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = {path.name: path.read_bytes() for path in copied.iterdir()}
    monkeypatch.setattr(manifest, "INDEXED_FROM", 24)
    found = read_manifest(copied)
    monkeypatch.setattr("bodyseg_data.shards.index.LARGEST_PIECE", 100)
    with pytest.raises(BadShard, match="train-00000.tar: its index takes [0-9]+ bytes, at most 100: use smaller"):
        write_manifest(found, copied)
    assert {path.name: path.read_bytes() for path in copied.iterdir()} == before


def test_verify_knows_the_index(copied: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = table_of(copied)
    whole = bytearray((copied / INDEX_NAME).read_bytes())
    assert main(["verify", str(copied)]) == 0
    assert "24 samples in 3 shards" in capsys.readouterr().out
    second = table.entry(1)

    def faults(data: bytes | bytearray) -> list[str]:
        (copied / INDEX_NAME).write_bytes(data)
        assert main(["verify", str(copied)]) == 1
        return capsys.readouterr().out.splitlines()

    whole[second.offset + 20] ^= 1
    altered = faults(whole)
    assert altered[0].startswith(f"{INDEX_NAME}: {second.key}: offset {second.offset}: altered: CRC-32")
    assert altered[1].startswith(f"{second.key}: -: offset 0: its samples are not known: ")
    whole[second.offset + 20] ^= 1
    assert faults(whole + b"x") == [
        f"{INDEX_NAME}: -: offset {table.size}: {table.size} bytes expected, found {table.size + 1}"
    ]
    assert f"{INDEX_NAME}: {second.key}: offset {second.offset}: cut short" in faults(whole[: second.offset])[0]
    (copied / INDEX_NAME).unlink()
    assert main(["verify", str(copied)]) == 1
    assert capsys.readouterr().out.startswith(f"{INDEX_NAME}: -: offset 0: cannot be read: ")


def test_verify_finds_a_key_that_two_samples_have(
    copied: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second, *rest = read_manifest(copied).shards
    plain = record_from_json(record_to_json_lists(second), BODY_FIELDS, "here")
    twice = replace(plain, keys=(first.keys[0], *plain.keys[1:]))
    monkeypatch.setattr(manifest, "INDEXED_FROM", 24)
    write_manifest(replace(read_manifest(copied), shards=(first, twice, *rest)), copied)
    assert main(["verify", str(copied)]) == 1
    line = f"{second.name}: {first.keys[0]}: offset 0: a sample before it has the same key"
    assert line in capsys.readouterr().out.splitlines()


def record_to_json_lists(record: ShardRecord) -> dict[str, Any]:
    """A record as it is in a file."""
    tree: dict[str, Any] = json.loads(json.dumps(record_to_json(record)))
    return tree


def test_a_transfer_takes_the_index_before_the_manifest(indexed_set: Path, tmp_path: Path) -> None:
    source = LocalFolder(indexed_set)
    bundle = set_bundle(source)
    assert (bundle.files[0].name, bundle.index) == (INDEX_NAME, MANIFEST_NAME)
    transfer(bundle, LocalTarget(tmp_path / "there", source), lambda done: None)
    assert RangeImages(tmp_path / "there").keys == RangeImages(indexed_set).keys
    (tmp_path / "there" / INDEX_NAME).write_bytes(b"half of it")
    outcome = transfer(bundle, LocalTarget(tmp_path / "there", source), lambda done: None)
    assert outcome.kept == len(bundle.files) - 1
    assert (tmp_path / "there" / INDEX_NAME).read_bytes() == (indexed_set / INDEX_NAME).read_bytes()


def test_a_set_without_an_index_takes_the_place_of_one_with_it(small_set: Path, copied: Path) -> None:
    source = LocalFolder(small_set)
    transfer(set_bundle(source), LocalTarget(copied, source), lambda done: None, replace=True)
    assert not (copied / INDEX_NAME).exists()
    assert read_manifest(copied).index is None


def test_cards_list_the_index(small_set: Path, indexed_set: Path) -> None:
    found, plain = set_facts(read_manifest(indexed_set)), set_facts(read_manifest(small_set))
    assert (found.splits, found.views, found.sources) == (plain.splits, plain.views, plain.sources)
    assert found.version.startswith("7.0.0+")
    files = [each for each in croissant(found, Publication("A", date(2026, 1, 31)))["distribution"] if "sha256" in each]
    assert [each["name"] for each in files] == [*(shard.name for shard in plain.manifest.shards), INDEX_NAME]
    assert files[-1]["sha256"] == table_of(indexed_set).sha256
    assert files[-1]["encodingFormat"] == "application/octet-stream"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda tree: tree.pop("size"), "'shards' must have the fields"),
        (lambda tree: tree.update(index={}), "'index' must have the name 'samples.index', a size and a SHA-256"),
        (lambda tree: tree["index"].update(name="../x"), "'index' must have the name"),
        (lambda tree: tree["index"].update(sha256="0"), "'sha256' must be 64 hexadecimal digits"),
        (lambda tree: tree["index"].update(size=7), "the pieces take [0-9]+ bytes, the index 7"),
        (lambda tree: tree["samples"].pop(), "the columns of 'shards' must be lists of one length, at least 1"),
        (lambda tree: [tree[name].clear() for name in tree if name != "index"], "at least 1"),
        (lambda tree: tree["samples"].__setitem__(0, 0), "'samples' must hold whole numbers of 1 to"),
        (lambda tree: tree["samples"].__setitem__(0, 1.0), "'samples' must hold whole numbers of 1 to"),
        (lambda tree: tree["piece_bytes"].__setitem__(0, LARGEST_PIECE + 1), "'piece_bytes' must hold whole numbers"),
        (lambda tree: tree["name"].__setitem__(1, tree["name"][0]), "shard names must be unique"),
        (lambda tree: tree["name"].__setitem__(0, "x.tar"), "a shard's name must be like train-00000.tar"),
    ],
)
def test_a_table_that_breaks_a_rule_is_one_line(
    change: Callable[[Any], object], message: str, indexed_set: Path
) -> None:
    tree = json.loads((indexed_set / MANIFEST_NAME).read_bytes())["shards"]
    change(tree)
    with pytest.raises(BadShard, match=f"^here: .*{message}"):
        table_from_json(tree, "here")


def with_text(data: bytes, **changed: Any) -> bytes:
    """A piece with other fields of its text."""
    size = int.from_bytes(data[8:12], "little")
    text = json.dumps({**json.loads(data[-size:]), **changed}).encode()
    return data[:8] + len(text).to_bytes(4, "little") + data[12:-size] + text


def piece_of(found: Manifest, number: int = 0) -> tuple[ShardRecord, bytes]:
    shard = found.shards[number]
    return shard, encode_piece(shard)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data[:8], "8 bytes are no index of a shard"),
        (lambda data: data[:5] + bytes([17]) + data[6:], "[0-9]+ bytes cannot hold the sizes of [0-9]+ tables"),
        (lambda data: data[:-1], "the index must hold [0-9]+ samples, found"),
        (lambda data: b"\1" + data[1:], "the index must hold [0-9]+ samples, found"),
        (lambda data: data.replace(b'"stems"', b'"stars"'), "the index's text must have the fields"),
        (lambda data: data[:-1] + b"]", "the index's text cannot be read"),
        (lambda data: with_text(data, stems=[1]), "'stems' must be a list of text"),
        (lambda data: with_text(data, tails={}), "'tails' must be a list of text"),
        (
            lambda data: with_text(data, tails=["-d1"]),
            "'stems' and 'tails' must be as many as rows of the first tables",
        ),
    ],
)
def test_a_piece_that_breaks_a_rule_is_one_line(
    change: Callable[[bytes], bytes], message: str, indexed_set: Path
) -> None:
    shard, data = piece_of(read_manifest(indexed_set))
    with pytest.raises(BadShard, match=f"^here: {message}"):
        Piece(change(data), len(shard), "here")


def test_entries_that_break_a_rule_are_one_line(indexed_set: Path) -> None:
    shard, data = piece_of(read_manifest(indexed_set))
    count = len(shard)
    for altered, message in (
        (data[:24] + bytes(4 * (count + 1)) + data[28 + 4 * count :], "a sample takes at least a block"),
        (with_text(data, stems=[], tails=["-d.1"] * count), "a sample key must be 1 to 80"),
        (data[: 28 + 8 * count] + b"\xff" * count + data[28 + 9 * count :], "has a row that its tables have not"),
    ):
        with pytest.raises(BadShard, match=f"^here: .*{message}"):
            Piece(altered, count, "here").entry(0)


def test_altered_pieces_are_refused_or_read(indexed_set: Path) -> None:
    """Whatever bytes a piece has: no error but BadShard, and no entry that takes much memory."""
    shard, data = piece_of(read_manifest(indexed_set))
    head = {"name": shard.name, "split": shard.split, "size": shard.size, "sha256": shard.sha256}
    draws = random.Random(0)
    messages = set()
    for _ in range(400):
        altered = bytearray(data)
        for _ in range(draws.choice((1, 1, 4))):
            altered[draws.randrange(len(altered))] = draws.choice((0, 1, 255, 34, 44, draws.randrange(256)))
        try:
            piece = Piece(bytes(altered), len(shard), "here")
            for at in range(len(shard)):
                assert 0 < piece.entry(at).length <= 1 << 30
            record_from_json({**head, **piece.to_json()}, BODY_FIELDS, "here")
        except BadShard as error:
            messages.add(str(error)[:40])
    assert len(messages) > 5


def test_keys_of_any_form_are_kept(small_set: Path) -> None:
    """Usual keys are stored as one text a body and one a view, others whole."""
    shard = read_manifest(small_set).shards[0]
    for keys in (
        shard.keys,
        tuple(f"k{at}" for at in range(len(shard))),
        tuple(f"b{at}-d215-a000" for at in range(len(shard))),
        (*shard.keys[:-1], "last"),
    ):
        record = replace(shard, keys=keys)
        piece = Piece(encode_piece(record), len(record), "here")
        assert [piece.entry(at).key for at in range(len(record))] == list(keys)
        assert [piece.entry(at) for at in range(len(record))] == [record.entry(at) for at in range(len(record))]
        assert piece.to_json()["keys"] == list(keys)


def test_a_piece_is_read_again_after_it_was_let_go(indexed_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index, "HELD_PIECES", 1)
    shards = IndexedShards(table_of(indexed_set), BODY_FIELDS, LocalFolder(indexed_set))
    assert shards.piece(0) is shards.piece(0)
    first = shards.piece(0)
    shards.piece(1)
    assert shards.piece(0) is not first


def test_a_packing_with_an_index_goes_on_where_it_was_cut(
    pack_figures: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(manifest, "INDEXED_FROM", 2)
    folder = pack_figures(tmp_path / "out", views=ViewGrid(count=1), shard_samples=1)
    whole = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert INDEX_NAME in whole
    pack_figures(folder, views=ViewGrid(count=1), shard_samples=1)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == whole
    (folder / "train-00000.tar").unlink()
    pack_figures(folder, views=ViewGrid(count=1), shard_samples=1)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == whole
    (folder / INDEX_NAME).write_bytes(whole[INDEX_NAME][:-1])
    pack_figures(folder, views=ViewGrid(count=1), shard_samples=1)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == whole, "of the last shard, nothing is known"
