from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from bodyseg_data import RangeImages, loader
from bodyseg_data.core import BadConfig
from bodyseg_data.loading import find_rank
from bodyseg_data.loading.image_set import BatchOrder, Requests, batch_bounds
from bodyseg_data.loading.selection import permutation
from bodyseg_data.machine import torch_threads
from bodyseg_model.commands import main
from bodyseg_model.training import distributed, use_threads


class Numbers:
    """So many samples, and nothing to see in them."""

    split = "train"
    epoch = 0
    epochs_set = 1

    def __init__(self, count: int, seed: int = 0) -> None:
        self.count, self.seed = count, seed

    def __len__(self) -> int:
        return self.count

    def order(self, epoch: int, shuffle: bool) -> NDArray[np.int64]:
        return permutation(self.count, self.seed, epoch) if shuffle else np.arange(self.count)

    def requests(self, epoch: int, shuffle: bool) -> Requests:
        return Requests(self.order(epoch, shuffle), np.full(self.count, epoch))

    def identity(self) -> dict[str, Any]:
        return {"seed": self.seed}


def orders(images: Numbers, batch_size: int, world_size: int, **options: Any) -> list[BatchOrder]:
    return [BatchOrder(images, batch_size, rank=rank, world_size=world_size, **options) for rank in range(world_size)]


def one_pass(order: BatchOrder) -> list[list[int]]:
    return [[index for _, index in batch] for batch in order]


def put_together(batches: list[list[list[Any]]]) -> list[list[Any]]:
    """The global batches that the ranks' batches make up."""
    return [[index for batch in side_by_side for index in batch] for side_by_side in zip(*batches, strict=True)]


@given(st.integers(1, 300), st.integers(0, 2**63 - 1), st.integers(0, 2**40))
def test_an_order_is_a_permutation(count: int, seed: int, epoch: int) -> None:
    order = permutation(count, seed, epoch)
    assert np.array_equal(np.sort(order), np.arange(count))
    assert np.array_equal(order, permutation(count, seed, epoch))
    if count > 20:  # the chance that two are the same is 1 in 20!
        assert not np.array_equal(order, permutation(count, seed, epoch + 1))
        assert not np.array_equal(order, permutation(count, (seed + 1) % 2**63, epoch))


def test_every_sample_is_as_likely_in_every_place() -> None:
    count, epochs = 24, 4800
    seen = np.zeros((count, count))
    for epoch in range(epochs):
        seen[np.arange(count), permutation(count, 5, epoch)] += 1
    expected = epochs / count
    chi2 = ((seen - expected) ** 2 / expected).sum()
    # (count - 1)**2 degrees of freedom, near enough normal: five standard deviations either way.
    freedom = (count - 1) ** 2
    assert abs(chi2 - freedom) < 5 * np.sqrt(2 * freedom)


def test_samples_of_one_shard_are_spread_over_the_whole_pass() -> None:
    places = np.argsort(permutation(1000, 0, 3))
    for shard in places.reshape(10, 100):
        assert 400 < shard.mean() < 600
        assert shard.min() < 50 < 950 < shard.max()


@given(st.integers(1, 200), st.integers(1, 9), st.integers(1, 7), st.booleans(), st.integers(0, 3))
def test_ranks_share_an_epoch_out_without_loss(
    count: int, batch_size: int, world_size: int, drop_last: bool, epoch: int
) -> None:
    images = Numbers(count)
    try:
        shares = orders(images, batch_size, world_size, drop_last=drop_last)
    except BadConfig:
        short = batch_size == 1 and count % world_size and not drop_last
        assert count < world_size or short or (drop_last and count < batch_size * world_size)
        return
    for order in shares:
        order.set_epoch(epoch)
    batches = [one_pass(order) for order in shares]
    assert [len(rank) for rank in batches] == [len(shares[0])] * world_size
    assert all(1 <= len(batch) <= batch_size for rank in batches for batch in rank)
    together = put_together(batches)
    single = BatchOrder(images, batch_size * world_size, drop_last=drop_last, rank=0, world_size=1)
    single.set_epoch(epoch)
    alone = one_pass(single)
    flat = [index for batch in together for index in batch]
    kept = count // (batch_size * world_size) * batch_size * world_size if drop_last else count
    assert flat == images.order(epoch, True).tolist()[:kept]
    if drop_last or not 0 < count % (batch_size * world_size) < world_size:
        assert together == alone
    else:  # the last batch has borrowed from the one before
        assert together[:-2] == alone[:-2]
        assert len(together) == len(alone)


@given(st.data())
def test_a_pass_goes_on_with_other_ranks_and_batch_sizes(data: st.DataObject) -> None:
    images = Numbers(data.draw(st.integers(8, 150)), seed=data.draw(st.integers(0, 5)))
    first = orders(images, data.draw(st.integers(2, 7)), data.draw(st.integers(1, 4)))
    done = data.draw(st.integers(0, len(first[0])))
    part = put_together([one_pass(order)[:done] for order in first])
    states = [order.state_dict(batches=done) for order in first]
    assert all(state == states[0] for state in states), "a place is the same on every rank"
    state = json.loads(json.dumps(states[0]))
    left = len(images) - sum(map(len, part))
    others = orders(images, data.draw(st.integers(2, 7)), data.draw(st.integers(1, 4)))
    if 0 < left < len(others):
        with pytest.raises(BadConfig, match=f"{left} samples .* of {len(others)} ranks a batch"):
            others[0].load_state_dict(state)
        return
    for order in others:
        order.load_state_dict(state)
        assert order.epoch == (1 if left == 0 else 0)
    rest = put_together([one_pass(order) for order in others])
    flat = [index for batch in (rest if left == 0 else part + rest) for index in batch]
    assert flat == images.order(0 if left else 1, True).tolist()
    assert [order.epoch for order in others] == [1 if left else 2] * len(others)


def test_cuts_cost_no_more_in_the_middle() -> None:
    assert batch_bounds(100, 0, 5, 4, False) == [0, 20, 40, 60, 80, 100]
    assert batch_bounds(100, 40, 5, 4, False) == [40, 60, 80, 100]
    assert batch_bounds(102, 0, 5, 4, False) == [0, 20, 40, 60, 80, 98, 102], "one a rank, from the batch before"
    assert batch_bounds(102, 0, 5, 4, True) == [0, 20, 40, 60, 80, 100]
    assert batch_bounds(3, 0, 5, 4, True) == [0]
    assert batch_bounds(7, 7, 5, 4, False) == [7]


def test_an_epoch_asked_for_again_keeps_the_place_of_a_loaded_state() -> None:
    images = Numbers(20)
    order = BatchOrder(images, 4, rank=0, world_size=1)
    whole = one_pass(order)
    state = order.state_dict(batches=3)
    for epoch, expected in ((0, whole[3:]), (1, None)):
        other = BatchOrder(images, 4, rank=0, world_size=1)
        other.load_state_dict(state)
        other.set_epoch(epoch)
        found = one_pass(other)
        assert found == expected if expected is not None else len(found) == 5


def test_states_of_something_else_are_refused() -> None:
    order = BatchOrder(Numbers(20), 4, rank=0, world_size=1)
    state = order.state_dict()
    cases: list[tuple[Any, str]] = [
        (None, "'format' must be 'bodyseg loader 1', found 'NoneType'"),
        ({}, "'format' must be 'bodyseg loader 1', found None"),
        ({**state, "format": "bodyseg loader 9"}, "found 'bodyseg loader 9'"),
        ({**state, "samples": 21}, "belongs to another run: samples 21, here 20"),
        ({**state, "seed": 1}, "belongs to another run: seed 1, here 0"),
        ({**state, "shuffle": False}, "belongs to another run: shuffle False, here True"),
        ({**state, "position": 21}, "must be whole numbers from 0 on, position at most 20, found 0 and 21"),
        ({**state, "position": True}, "at most 20, found 0 and True"),
        ({**state, "epoch": -1}, "at most 20, found -1 and 0"),
        ({**state, "epoch": "0"}, "at most 20, found '0' and 0"),
    ]
    for wrong, message in cases:
        with pytest.raises(BadConfig, match=message):
            order.load_state_dict(wrong)
    with pytest.raises(BadConfig, match="a number of batches of the current pass, found 2"):
        order.state_dict(batches=2)


def test_ranks_come_from_arguments_or_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RANK", raising=False)
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    assert find_rank() == (0, 1)
    monkeypatch.setenv("RANK", "1")
    assert find_rank() == (0, 1), "a rank of nothing is none"
    monkeypatch.setenv("WORLD_SIZE", "3")
    assert find_rank() == (1, 3)
    assert find_rank(0, 2) == (0, 2)
    monkeypatch.setenv("RANK", "one")
    with pytest.raises(BadConfig, match="WORLD_SIZE must be whole numbers, found 'one' and '3'"):
        find_rank()
    for rank, world_size, message in (
        (1, None, "given together or not at all"),
        (2, 2, "rank must be less than world_size, found 2 of 2"),
        (-1, 2, "rank must be a whole number"),
        (0, 0, "world_size must be a whole number of at least 1"),
    ):
        with pytest.raises(BadConfig, match=message):
            find_rank(rank, world_size)


def test_impossible_shares_are_refused() -> None:
    with pytest.raises(BadConfig, match="3 samples are fewer than 4 ranks"):
        BatchOrder(Numbers(3), 2, rank=0, world_size=4)
    with pytest.raises(BadConfig, match="7 samples .* to 3 ranks in equally many batches of 1"):
        BatchOrder(Numbers(7), 1, rank=0, world_size=3)
    assert len(BatchOrder(Numbers(7), 1, drop_last=True, rank=0, world_size=3)) == 2


def test_fewer_shards_than_ranks_and_workers(figures_set: Path) -> None:
    images = RangeImages(figures_set / "train-00000.tar", "all")
    alone = [batch["key"] for batch in loader(images, 5, shuffle=True)]
    shared = [[batch["key"] for batch in loader(images, 1, 0, True, rank=rank, world_size=5)] for rank in range(5)]
    assert put_together(shared) == alone


def test_torch_computes_in_no_more_threads_than_the_container_has_processors(monkeypatch: pytest.MonkeyPatch) -> None:
    with torch_threads(4):
        monkeypatch.setattr(distributed, "processors", lambda: 8)
        use_threads(None)
        assert torch.get_num_threads() == 4
        monkeypatch.setattr(distributed, "processors", lambda: 2)
        use_threads(3)
        assert torch.get_num_threads() == 3
        use_threads(None)
        assert torch.get_num_threads() == 2


def test_view_computes_in_no_more_threads_either(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(distributed, "processors", lambda: 2)
    with torch_threads(4):
        assert main(["view", str(tmp_path), "--run", str(tmp_path / "none")]) == 2
        assert torch.get_num_threads() == 2
