"""Whatever happens to the files of a set, nobody gets other pixels than were packed, and verify says so."""

from __future__ import annotations

import hashlib
import shutil
import tarfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from benches.fuzzing.damage import BLOCK, Damaged, Tally, cut_everywhere, flip_bits, mangle

from bodyseg_data.core import BadShard
from bodyseg_data.loading import RangeImages
from bodyseg_data.samples import ViewGrid
from bodyseg_data.shards import MANIFEST_NAME, LocalFolder, find_faults, write_manifest
from bodyseg_data.shards.tar import parse_members


@pytest.fixture(scope="module")
def damaged(tmp_path_factory: pytest.TempPathFactory, pack_figures: Callable[..., Path]) -> Damaged:
    folder = tmp_path_factory.mktemp("damage")
    whole = pack_figures(folder / "whole", meshes=2, views=ViewGrid(span_deg=360, count=2), shard_samples=2)
    return Damaged(whole, folder / "damaged")


def test_a_shard_cut_at_any_block_is_reported_by_all_readers(damaged: Damaged) -> None:
    tally = Tally()
    shard = damaged.manifest.shards[0]
    cut_everywhere(damaged, shard.name, BLOCK, tally)
    assert tally.faults == []
    assert tally.damages == tally.reported_by_verify == shard.size // BLOCK
    inside = (shard.offsets[-1] + shard.lengths[-1]) // BLOCK  # behind the last sample are empty blocks only
    assert tally.refused_by_access == tally.refused_by_pipeline == inside
    assert tally.samples_given > 0, "what comes before a cut can be read"


def test_a_manifest_cut_anywhere_is_reported(damaged: Damaged) -> None:
    tally = Tally()
    cut_everywhere(damaged, MANIFEST_NAME, 41, tally)
    assert tally.faults == []
    assert tally.damages == tally.reported_by_verify == tally.refused_by_access > 40


def test_any_flipped_bit_is_reported(damaged: Damaged) -> None:
    tally = Tally()
    flip_bits(damaged, 50, 3, tally)
    assert tally.faults == []
    assert tally.damages == tally.reported_by_verify == 50
    assert tally.refused_by_access > 35


def test_anything_else_that_happens_to_files_is_reported(damaged: Damaged) -> None:
    tally = Tally()
    mangle(damaged, 36, 5, tally)
    assert tally.faults == []
    assert tally.damages == tally.reported_by_verify > 30


def test_a_reader_that_lets_damage_through_would_be_seen(damaged: Damaged, monkeypatch: pytest.MonkeyPatch) -> None:
    tally = Tally()
    monkeypatch.setattr("bodyseg_data.shards.records.check_bytes", lambda data, record, index: None)
    monkeypatch.setattr("benches.fuzzing.damage.find_faults", lambda folder, manifest, shard: [])
    shard = damaged.manifest.shards[0]
    last = shard.lengths[0] - 1  # padding of the first sample's last member: no image changes
    damaged.try_out(shard.name, lambda data: data[:last] + b"x" + data[last + 1 :], "padding", tally)
    assert tally.faults == [
        "padding: verify found no fault",
        f"padding: {shard.keys[0]} was given though it was altered",
    ]
    monkeypatch.setattr("bodyseg_data.shards.tar.parse_members", lambda key, data: parse_members(shard.keys[1], other))
    other = (damaged.folder / shard.name).read_bytes()[shard.offsets[1] : shard.offsets[1] + shard.lengths[1]]
    damaged.try_out(shard.name, lambda data: data[:last] + b"x" + data[last + 1 :], "other", tally)
    assert f"other: the pipeline gave {shard.keys[0]} though it was altered" in tally.faults


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.GNUTYPE_SPARSE, b"x"])
def test_tricks_in_a_tar_are_refused_by_all_readers_though_all_checksums_are_right(
    kind: bytes, damaged: Damaged, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(damaged.folder, tmp_path / "set"))
    record = damaged.manifest.shards[0]
    path = folder / record.name
    data = bytearray(path.read_bytes())
    data[156:157] = kind  # of the first member, whose header's sum has to fit again
    data[148:156] = b" " * 8
    data[148:156] = b"%06o\0 " % sum(data[:512])
    path.write_bytes(data)
    forged = replace(
        record,
        sha256=hashlib.sha256(data).hexdigest(),
        crc32=(zlib.crc32(data[: record.lengths[0]]), *record.crc32[1:]),
    )
    manifest = replace(damaged.manifest, shards=(forged, *damaged.manifest.shards[1:]))
    write_manifest(manifest, folder)
    images = RangeImages(folder)
    where = f"{record.name}: {record.keys[0]}: offset 0: .*a sample holds plain files called"
    for read in (lambda: images[0], lambda: next(iter(images.webdataset()))):
        with pytest.raises(BadShard, match=where.replace("+", r"\+")):
            read()
    (fault,) = find_faults(LocalFolder(folder), manifest, forged)
    assert (fault.key, fault.offset) == (record.keys[0], 0)
