from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bodyseg_data import RangeImages, loader
from bodyseg_data.core import BadShard
from bodyseg_data.loading.skipping import SkipLedger, Skipped, checked_budget
from bodyseg_data.shards import Unreachable


@pytest.fixture
def spoil(figures_set: Path, tmp_path: Path) -> Callable[..., RangeImages]:
    """A copy of the set with a bit flipped in each of these samples: (shard, place in it)."""

    def make(*places: tuple[str, int], **options: Any) -> RangeImages:
        copy = Path(shutil.copytree(figures_set, tmp_path / "copy"))
        images = RangeImages(copy, "all", **options)
        records = {record.name: record for record in images.manifest.shards}
        for shard, index in places:
            data = bytearray((copy / shard).read_bytes())
            data[records[shard].offsets[index] + 2000] ^= 1
            (copy / shard).write_bytes(data)
        return images

    return make


@pytest.mark.parametrize("workers", [0, 2])
def test_skipping_keeps_a_ledger(spoil: Callable[..., RangeImages], workers: int) -> None:
    images = spoil(("train-00000.tar", 1), ("train-00001.tar", 0), split="train")
    bad = [images.manifest.shards[0].keys[1], images.manifest.shards[1].keys[0]]
    batches = loader(images, 3, workers, on_error="skip", skip_budget=2)
    good = loader(images, 3).order
    for epoch in range(2):
        orders = [[images.location(index)[1] for _, index in batch] for batch in good]
        passed = list(batches)
        assert len(passed) == len(batches) == 6, "no batch is left out"
        for batch, wanted in zip(passed, orders, strict=True):
            assert batch["key"] == [key for key in wanted if key not in bad]
            assert len(batch["range"]) == len(batch["labels"]) == len(batch["key"]) == len(batch["index"])
            for place, (key, index) in enumerate(zip(batch["key"], batch["index"], strict=True)):
                images.set_epoch(epoch)
                assert images.describe(index)["key"] == key
                assert torch.equal(batch["range"][place], images[index]["range"])
        images.epochs_set = batches.order._epochs_set  # undo: indexing by epoch is not a wish for the next pass
    records = batches.skipped
    assert sorted((record.epoch, record.key) for record in records) == sorted(
        (epoch, key) for epoch in range(2) for key in bad
    )
    for record in records:
        shard, key, offset = images.location(images.keys.index(record.key))
        assert (record.shard, record.key, record.offset) == (shard, key, offset)
        assert record.why.startswith(f"{shard}: {key}: offset {offset}: altered: CRC-32 ")
    assert batches.state_dict()["skipped"] == [asdict(record) for record in records]
    again = loader(images, 3, on_error="skip", skip_budget=2)
    again.load_state_dict(json.loads(json.dumps(batches.state_dict())))
    assert again.skipped == records


def test_a_batch_of_bad_samples_is_empty_not_gone(spoil: Callable[..., RangeImages]) -> None:
    images = spoil(("test-00000.tar", 0), ("test-00000.tar", 1), split="test")
    batches = list(loader(images, 2, on_error="skip", skip_budget=0.25))
    assert [batch["key"] for batch in batches] == [[], images.keys[2:4], images.keys[4:6], images.keys[6:]]
    assert batches[0]["range"].shape == (0, 1, 160, 82)
    with pytest.raises(BadShard, match="has lost 1 samples before"):
        list(loader(images, 2, on_error="skip", skip_budget=0.24))


@pytest.mark.parametrize("budget", [3, 3.0, np.int64(3), np.float32(3)])
def test_a_whole_number_of_samples_may_be_of_any_type(budget: Any) -> None:
    """As `OnFaults` takes it: a share is below 1."""
    assert checked_budget("skip", budget, 10) == 3


def test_a_share_of_samples_is_cut_as_its_decimals_say() -> None:
    for samples in (100, 200, 1000, 7_000_000):
        for hundredths in range(1, 100):
            assert checked_budget("skip", hundredths / 100, samples) == hundredths * samples // 100
    assert [checked_budget("skip", budget, 8) for budget in (np.int64(3), np.float32(0.5))] == [3, 4]
    assert checked_budget("skip", 10**400, 8) == 10**400, "which no float holds"
    assert checked_budget("skip", 1 / 3, 3) == 1 and checked_budget("skip", 0.999, 1000) == 999


@pytest.mark.parametrize("workers", [0, 2])
def test_a_spent_budget_stops_the_run(spoil: Callable[..., RangeImages], workers: int) -> None:
    images = spoil(("train-00000.tar", 0), ("train-00000.tar", 2), ("train-00001.tar", 1), split="train")
    batches = loader(images, 3, workers, shuffle=False, on_error="skip", skip_budget=2)
    message = r"^train-00001.tar: \S+: offset \d+: altered: .* \(epoch 0 has lost 2 samples before, all that its"
    with pytest.raises(BadShard, match=message):
        list(batches)
    assert len(batches.skipped) == 2
    resumed = loader(images, 3, workers, shuffle=False, on_error="skip", skip_budget=2)
    resumed.load_state_dict(batches.state_dict())
    with pytest.raises(BadShard, match=message):  # what was lost before counts
        list(resumed)


def test_an_epoch_gone_through_again_may_lose_the_same_again(spoil: Callable[..., RangeImages]) -> None:
    images = spoil(("train-00000.tar", 0), ("train-00000.tar", 2), split="train")
    batches = loader(images, 3, shuffle=False, on_error="skip", skip_budget=2)
    for times in range(1, 4):
        images.set_epoch(0)
        assert sum(len(batch["key"]) for batch in batches) == 14
        assert len(batches.skipped) == 2 * times


def test_a_skip_takes_no_longer_for_those_before_it() -> None:
    looked: list[int] = []

    class Seen(Skipped):
        def __getattribute__(self, name: str) -> Any:
            if name == "epoch":
                looked.append(1)
            return super().__getattribute__(name)

    ledger, looks = SkipLedger(3), []
    for epoch in range(20):
        for number in range(3):
            looked.clear()
            ledger.add(Seen(epoch, f"k-{number}", "train-00000.tar", 512 * number, "altered"), BadShard("altered"))
            looks.append(len(looked))
    assert len(ledger.skipped) == 60 and set(looks) == {looks[0]}
    with pytest.raises(BadShard, match="epoch 19 has lost 3 samples before"):
        ledger.add(Skipped(19, "k-3", "train-00000.tar", 0, "altered"), BadShard("altered"))


def test_what_cannot_be_skipped_ends_the_run_at_once(figures_set: Path) -> None:
    asked = []

    class Cut(RangeImages):
        def write(self, index: int, *where: Any) -> None:
            asked.append(index)  # over a network, each may take minutes
            raise Unreachable("no answer")

    with pytest.raises(Unreachable, match="no answer"):
        list(loader(Cut(figures_set), 8, on_error="skip", skip_budget=20))
    assert len(asked) == 1
