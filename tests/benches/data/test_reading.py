from __future__ import annotations

import hashlib
import multiprocessing
from pathlib import Path
from types import SimpleNamespace

import pytest
from benches.data.reading import bench, cold_ranks, far, manifests
from benches.data.reading.manifests import SHARD_SAMPLES, fit, write_large_manifest

from bodyseg_data.core import BadConfig
from bodyseg_data.shards import read_manifest


def test_ranks_share_caches_and_manifests_are_opened(small_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "RANKS", 4)
    monkeypatch.setattr(bench, "RANKS_A_MACHINE", (2, 4))
    monkeypatch.setattr(bench, "BATCH", 2)
    monkeypatch.setattr(bench, "SIZES", (SHARD_SAMPLES,))
    monkeypatch.setattr(bench, "LARGEST", 3 * SHARD_SAMPLES)
    # In place of spawned processes, whose start takes seconds, those that have PyTorch imported.
    forks = SimpleNamespace(get_context=lambda method: multiprocessing.get_context("forkserver"))
    monkeypatch.setattr(manifests, "multiprocessing", forks)
    steps: list[tuple[int, int]] = []
    found = bench.bench_reading(str(small_set), lambda done, total: steps.append((done, total)))
    assert steps == [(done, 6) for done in range(1, 7)]
    alone, two, four = found["ranks"]
    train = [shard for shard in read_manifest(small_set).shards if shard.split == "train"]
    size = sum(shard.size for shard in train)
    assert (alone["requests"], alone["bytes"]) == (16, sum(sum(shard.lengths) for shard in train))
    assert (four["requests"], four["bytes"], four["times_the_set"]) == (2, size, 1.0)
    assert (two["requests"], two["times_the_set"]) == (4, 2.0)
    whole, indexed, largest = found["opening"]
    assert [(row["samples"], row["indexed"]) for row in (whole, indexed, largest)] == [
        (SHARD_SAMPLES, False),
        (SHARD_SAMPLES, True),
        (3 * SHARD_SAMPLES, True),
    ]
    assert min(row["cpu_s"] for row in (whole, indexed, largest)) > 0
    assert 50 < whole["bytes"] / SHARD_SAMPLES < 200
    assert largest["bytes"] - indexed["bytes"] < 2 * 500, "a short line a shard"
    assert set(found["fits"]) == {"bytes", "cpu_s", "memory_bytes"}


def test_ranks_begin_to_read_a_cold_store(small_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cold_ranks, "RANKS", 4)
    monkeypatch.setattr(cold_ranks, "RANKS_A_MACHINE", (2, 4))
    monkeypatch.setattr(cold_ranks, "BATCH", 2)
    monkeypatch.setattr(cold_ranks, "LARGEST", 5 * SHARD_SAMPLES)
    monkeypatch.setattr(cold_ranks, "LARGE_SAMPLES", 3)
    monkeypatch.setattr(cold_ranks, "RATE", 1e12)
    found = cold_ranks.bench_cold(str(small_set))
    train = [shard for shard in read_manifest(small_set).shards if shard.split == "train"]
    size, held = sum(shard.size for shard in train), sum(sum(shard.lengths) for shard in train)
    rows = {(row["order"], row["ranks_a_machine"]): row for row in found["rows"]}
    assert len(rows) == 9
    for order in ("blocks", "global", "stored"):
        assert (rows[order, 4]["requests"], rows[order, 4]["bytes"]) == (2, size), "each shard once a machine"
        assert rows[order, 4]["of_one_file"] == 1 and rows[order, 2]["of_one_file"] <= 2
        assert held <= rows[order, None]["bytes"] < 16 * held
    for row in rows.values():
        assert row["samples"] == 16 and far.LATENCY_S <= row["first_s"] <= row["all_s"]
    assert rows["global", None]["all_s"] == far.LATENCY_S, "eight connections a rank for four samples"
    assert found["large"]["samples"] == 12


def test_a_far_store_is_read_in_every_order(small_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("aiohttp")
    monkeypatch.setattr(far, "LATENCY_S", 0.0)
    monkeypatch.setattr(far, "RATE", 1e9)
    found = far.bench_far(data=str(small_set))
    assert [(row["cache"], row["order"], row["look_ahead"]) for row in found["rows"][:4]] == [
        ("whole", "blocks", True),
        ("whole", "global", True),
        ("whole", "stored", True),
        ("whole", "global", False),
    ]
    assert {row["times_the_set"] for row in found["rows"][:4]} == {1.0} and len(found["rows"]) == 12
    assert all(0 < row["first_s"] <= row["epoch_s"] and row["requests"] for row in found["rows"])
    assert found["rows"][11]["requests"] == found["samples"] == 24, "without a cache and look-ahead a request a sample"
    assert found["mixing"]["stored"]["subjects"] <= found["mixing"]["global"]["subjects"]
    assert found["warm_over_local"] > 0


def test_too_few_samples_for_the_ranks_are_one_line(small_set: Path) -> None:
    with pytest.raises(BadConfig, match="a set of at least 64 training samples, found 16"):
        bench.bench_reading(str(small_set))


def test_a_large_manifest_is_one_that_is_read(small_set: Path, tmp_path: Path) -> None:
    write_large_manifest(read_manifest(small_set), 2 * SHARD_SAMPLES, tmp_path)
    manifest = read_manifest(tmp_path)
    assert manifest.samples() == 2 * SHARD_SAMPLES
    assert manifest.rig == read_manifest(small_set).rig
    assert manifest.shards[1].sha256 == hashlib.sha256(b"1").hexdigest()


def test_a_line_goes_through_its_points() -> None:
    rows = [{"samples": number, "bytes": 100 + 7 * number} for number in (10, 20, 50)]
    assert fit(rows, "bytes", 1000)["value"] == pytest.approx(7100)
