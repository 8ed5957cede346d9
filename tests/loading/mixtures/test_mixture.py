"""Mixtures: which samples an epoch has, and that loaders give the same bits whatever makes them."""

from __future__ import annotations

import hashlib
import json
import pickle
import shutil
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader
from torchdata.stateful_dataloader import StatefulDataLoader

from bodyseg_data import Mixture, RangeImages, loader
from bodyseg_data.core import BadConfig, BadShard

PINNED = ["56195eadde124a32", "d0dd9bb57b2520ec", "5026884420bef013"]
"""Digests of the requests of epochs 0, 1 and 1000 of the fixture `mixture`."""

Bits = list[tuple[list[str], bytes, bytes]]


def bits(batches: Iterable[Any]) -> Bits:
    return [(batch["key"], batch["range"].numpy().tobytes(), batch["labels"].numpy().tobytes()) for batch in batches]


def keys(batches: Iterable[Any]) -> list[str]:
    return [key for batch in batches for key in batch["key"]]


def samples_of(batches: Iterable[Any]) -> list[tuple[str, bytes]]:
    pairs = (pair for batch in batches for pair in zip(batch["key"], batch["range"].numpy(), strict=True))
    return [(key, image.tobytes()) for key, image in pairs]


@pytest.fixture(scope="module")
def known(small_set: Path) -> RangeImages:
    """The 8 samples of subject A for training."""
    return RangeImages(small_set, "all", "train", only=["open-A-*"])


@pytest.fixture(scope="module")
def people(small_set: Path) -> RangeImages:
    """The 8 samples of other people for training."""
    return RangeImages(small_set, "none", "train", seed=5, only=["open-people-*"])


@pytest.fixture
def mixture(known: RangeImages, people: RangeImages) -> Mixture:
    """A mixture of epochs of 18 samples, in which the second set has 13.5 on average."""
    return Mixture([(known, [(0, 1), (4, 1)], range(8)), (people, 3)], samples=18, seed=2)


def test_the_order_of_a_mixture_never_changes(mixture: Mixture) -> None:
    """Pinned: a state of an earlier version must go on with the samples that it has not had yet."""
    found = [mixture.requests(epoch).part(0, 18) for epoch in (0, 1, 1000)]
    assert [hashlib.blake2b(str(each).encode(), digest_size=8).hexdigest() for each in found] == PINNED


def test_a_mixture_of_one_set_has_its_samples_and_draws(known: RangeImages) -> None:
    batches, plain = loader(Mixture([(known, 0.5)]), 3), loader(known, 3)
    assert len(batches) == len(plain) == 3
    for _ in range(2):
        mixed, own = samples_of(batches), samples_of(plain)
        assert sorted(mixed) == sorted(own)
        assert mixed != own


def test_every_epoch_has_the_shares_of_the_weights(known: RangeImages, people: RangeImages) -> None:
    mixture = Mixture([(known, 1), (people, 3)], samples=16)
    assert (len(mixture), mixture.counts(0), mixture.counts(10**9)) == (16, [4, 12], [4, 12])
    batches = loader(mixture, 5)
    held = Counter()  # type: ignore[var-annotated]
    for epoch in range(4):
        seen = keys(batches)
        assert sum(key in known.keys for key in seen) == 4
        held.update(seen)
        if epoch == 1:
            assert {held[key] for key in known.keys} == {1}, "two epochs are one pass"
    assert {held[key] for key in known.keys} == {2}
    assert {held[key] for key in people.keys} == {6}


def test_a_set_passed_several_times_has_other_draws_each_time(known: RangeImages) -> None:
    seen = samples_of(loader(Mixture([(known, 1)], samples=24), 5))
    assert Counter(key for key, _ in seen) == dict.fromkeys(known.keys, 3)
    assert len(set(seen)) == 24
    own = [sample for epoch in range(3) for sample in samples_of(loader(_at(known, epoch), 5))]
    assert sorted(seen) == sorted(own)


def _at(images: RangeImages, epoch: int) -> RangeImages:
    again = RangeImages(images.path, images.variant, "train", images.seed, epoch=epoch, only=images.selection.only)
    assert again.keys == images.keys
    return again


def test_the_number_of_samples_is_by_default_that_of_the_sets(known: RangeImages, people: RangeImages) -> None:
    mixture = Mixture([(known, 1), (people, 1)])
    assert len(mixture) == 16
    assert sorted(keys(loader(mixture, 4))) == sorted(mixture.keys) == sorted(known.keys + people.keys)


def test_one_set_may_come_twice(figures_set: Path) -> None:
    clean, noisy = (RangeImages(figures_set, variant, "test") for variant in ("none", "noise"))
    mixture = Mixture([(clean, 1), (noisy, 1)])
    assert (mixture.variant, mixture.split, mixture.shape) == ("none, noise", "test", (160, 82))
    assert (mixture.step_m, mixture.label_map, len(mixture.sets)) == (clean.step_m, clean.label_map, 2)
    seen = samples_of(loader(mixture, 8))
    assert [key for key, _ in seen] == clean.keys * 2, "a test split is not shuffled"
    assert len(set(seen)) == 16
    assert mixture.keys == clean.keys * 2


@pytest.mark.parametrize(("workers", "method"), [(2, "thread"), (1, "thread"), (2, "process")])
def test_bits_do_not_depend_on_the_workers(mixture: Mixture, workers: int, method: Any) -> None:
    expected = [bits(loader(Mixture(_parts(mixture), 18, 2, epoch), 5)) for epoch in range(3)]
    batches = loader(mixture, 5, workers, worker_method=method)
    assert [bits(batches) for _ in range(3)] == expected
    assert expected[0] != expected[1]


def _parts(mixture: Mixture) -> list[Any]:
    known, people = mixture.sets
    return [(known, 1.0, range(8)), (people, 3)]


def test_workers_of_a_fork_server_give_the_same_bits(mixture: Mixture) -> None:
    expected = bits(loader(mixture, 9))
    mixture.set_epoch(0)
    assert bits(loader(mixture, 9, 1, worker_method="process", start_method="forkserver")) == expected


def test_sixteen_bits_are_the_same_ranges(mixture: Mixture) -> None:
    metres = next(iter(loader(mixture, 5)))
    steps = next(iter(loader(mixture, 5, metres=False)))
    assert steps["range"].dtype == torch.uint16
    assert np.array_equal(metres["range"].numpy(), steps["range"].numpy() * np.float32(mixture.step_m))


def test_ranks_together_give_the_batches_of_one_process(mixture: Mixture) -> None:
    whole = [batch["key"] for batch in loader(mixture, 6)]
    ranks = [[batch["key"] for batch in loader(mixture, 2, rank=rank, world_size=3)] for rank in range(3)]
    assert [[key for part in parts for key in part] for parts in zip(*ranks, strict=True)] == whole


@pytest.mark.parametrize("after", [1, 3, 4, 6])
def test_a_state_goes_on_with_other_workers_and_batches(mixture: Mixture, after: int) -> None:
    batches = loader(mixture, 5)
    whole = [key for _ in range(3) for key in keys(batches)]
    first = loader(mixture, 5)
    mixture.set_epoch(0)
    seen: list[str] = []
    done = 0
    while done < after:
        for batch in first:
            seen += batch["key"]
            done += 1
            if done == after:
                break
    state = json.loads(json.dumps(first.state_dict()))
    second = loader(Mixture(mixture_parts(mixture), 18, 2), 3, 2)
    second.load_state_dict(state)
    while len(seen) < len(whole):
        seen += keys(second)
    assert seen == whole


def mixture_parts(mixture: Mixture) -> list[Any]:
    """The same parts as the fixture's."""
    known, people = mixture.sets
    return [(known, [(0, 1), (4, 1)], range(8)), (people, 3)]


def test_a_late_epoch_reads_and_orders_no_other(
    known: RangeImages, people: RangeImages, monkeypatch: pytest.MonkeyPatch
) -> None:
    ordered: list[int] = []
    plain = RangeImages.requests

    def requests(self: RangeImages, epoch: int, shuffle: bool = True) -> Any:
        ordered.append(epoch)
        return plain(self, epoch, shuffle)

    monkeypatch.setattr(RangeImages, "requests", requests)
    mixture = Mixture([(known, [(0, 0), (1000, 1)]), (people, 1)], samples=16)
    late = mixture.requests(10**6)
    assert len(late.indices) == 16
    assert len(ordered) <= 4
    assert min(ordered) > 900_000


def test_a_state_of_another_mixture_is_refused(known: RangeImages, people: RangeImages, small_set: Path) -> None:
    state = loader(Mixture([(known, 1), (people, 3)], samples=10), 5).state_dict()
    other = RangeImages(small_set, "occ", "train", seed=5, only=["open-people-*"])
    made = [
        (Mixture([(known, 1), (people, 2)], samples=10), r"mixture\[1\].weight 3.0, here 2.0"),
        (Mixture([(known, 1), (other, 3)], samples=10), r"mixture\[1\].variant 'none', here 'occ'"),
        (Mixture([(known, 1), (people, 3)], samples=11), "samples 10, here 11"),
        (Mixture([(known, 1), (people, 3)], samples=10, seed=1), "seed 0, here 1"),
        (Mixture([(known, [(0, 1), (2, 2)]), (people, 3)], samples=10), r"mixture\[0\].weight 1.0, here \[\["),
        (Mixture([(known, 1, range(8)), (people, 3)], samples=10), r"mixture\[0\].sample_weights None, here '"),
        (Mixture([(known, 1)], samples=10), r"mixture \[.*\], here \["),
        (known, "samples 10, here 8"),
    ]
    for images, message in made:
        with pytest.raises(BadConfig, match=f"^the state belongs to another run: {message}"):
            loader(images, 5).load_state_dict(state)


@pytest.mark.filterwarnings("ignore:'set_vital' is deprecated")  # torchdata calls it
def test_pytorchs_loaders_give_the_same_samples(mixture: Mixture) -> None:
    batches = loader(mixture, 5)
    expected = [samples_of(batches) for _ in range(2)]
    mixture.set_epoch(0)
    plain = DataLoader(mixture, batch_sampler=mixture.batches(5), num_workers=2, persistent_workers=True)
    assert [samples_of(plain) for _ in range(2)] == expected
    mixture.set_epoch(0)
    stateful = StatefulDataLoader(mixture, batch_sampler=mixture.batches(5), num_workers=1)
    first = samples_of([next(iter(stateful))])
    again = StatefulDataLoader(mixture, batch_sampler=mixture.batches(5), num_workers=1)
    again.load_state_dict(stateful.state_dict())
    assert first + samples_of(again) == expected[0]


def test_a_position_alone_is_that_of_the_epoch_set(mixture: Mixture) -> None:
    batches = loader(mixture, 18)
    for epoch in range(2):
        (batch,) = batches
        mixture.set_epoch(epoch)
        for position in (0, 7, -1):
            sample = mixture[position]
            assert sample["key"] == batch["key"][position]
            assert torch.equal(sample["range"], batch["range"][position])
            assert torch.equal(sample["labels"], batch["labels"][position])
        mixture.set_epoch(epoch + 1)


def test_samples_are_those_of_their_sets(mixture: Mixture, small_set: Path) -> None:
    known, people = mixture.sets
    assert np.array_equal(mixture.clean(9).range, people.clean(1).range)
    assert np.array_equal(mixture.image(3, 4).range, known.image(3, 4).range)
    assert mixture.image(15, 0).key == mixture.keys[15] == mixture.location(15)[1] == people.keys[7]
    shard, key, offset = people.location(0)
    assert mixture.location(8) == mixture.location(-8) == (f"{small_set}/{shard}", key, offset)


def test_samples_that_stand_for_a_mixture_have_its_shares(known: RangeImages, people: RangeImages) -> None:
    mixture = Mixture([(known, 1), (people, [(0, 0), (8, 6)])])
    given = mixture.evenly_sampled(40)
    assert 38 <= len(given) <= 42
    late = sum(mixture.counts(epoch)[1] for epoch in range(9)) / sum(map(sum, map(mixture.counts, range(9))))
    assert abs(np.mean(given >= 8) - late) < 0.05
    assert Mixture([(known, 1), (people, 0)]).evenly_sampled(10).max() < 8


def test_bad_samples_of_one_set_are_skipped_within_the_budget(
    small_set: Path, tmp_path: Path, people: RangeImages
) -> None:
    folder = shutil.copytree(small_set, tmp_path / "damaged")
    damaged = RangeImages(folder, "none", "train", only=["open-A-*"])
    shard, key, offset = damaged.location(2)
    with (folder / shard).open("r+b") as file:
        file.seek(offset + 600)
        file.write(b"damage")
    mixture = Mixture([(damaged, 1), (people, 1)], samples=32)
    with pytest.raises(BadShard, match=rf"^{folder}/{shard}: {key}: "):
        list(loader(mixture, 8, 1))
    batches = loader(mixture, 8, 2, on_error="skip", skip_budget=1)
    left = list(batches)
    assert len(keys(left)) == 30, "the sample comes twice in an epoch, and counts once"
    assert [len(batch["epoch"]) for batch in left] == [len(batch["key"]) for batch in left]
    assert [(each.shard, each.key, each.offset) for each in batches.skipped] == [(f"{folder}/{shard}", key, offset)] * 2
    both = Mixture([(damaged, 1), (RangeImages(shutil.copytree(folder, tmp_path / "b"), "none", "train"), 1)])
    with pytest.raises(BadShard, match=r"has lost 1 samples before, all that its skip_budget allows"):
        list(loader(both, 8, on_error="skip", skip_budget=1))


def test_workers_get_no_orders(known: RangeImages) -> None:
    mixture = Mixture([(known, 1)], samples=10_000)
    size = len(pickle.dumps(mixture))
    before = mixture.requests(0)
    assert abs(len(pickle.dumps(mixture)) - size) < 1000
    again = pickle.loads(pickle.dumps(mixture)).requests(0)
    assert np.array_equal(before.indices, again.indices)
    assert np.array_equal(before.epochs, again.epochs)


def test_a_mixture_prints_in_one_line(mixture: Mixture) -> None:
    known, people = mixture.sets
    shown = (
        f"Mixture([({known!r}, [[0, 1.0], [4, 1.0]], sample weights), ({people!r}, 3.0)], samples=18, seed=2, epoch=0)"
    )
    assert repr(mixture) == shown
    assert repr(loader(mixture, 5)).startswith(f"Loader(BatchOrder({shown}, batch_size=5, shuffle=True")


def test_sets_that_differ_in_what_a_batch_needs_are_refused(
    known: RangeImages, small_set: Path, paper_set: Path
) -> None:
    large = RangeImages(paper_set, "all", "train")
    size = r"^a mixture needs images of one size: .* has \(160, 82\), .* has \(640, 329\)"
    with pytest.raises(BadConfig, match=size):
        Mixture([(known, 1), (large, 1)])
    limbs = RangeImages(small_set, "all", "train", labels="limbs14")
    with pytest.raises(
        BadConfig, match=r"^a mixture needs one label map: .* 'parts33' and 'limbs14': 0 is 'Sellion' and"
    ):
        Mixture([(known, 1), (limbs, 1)])


@pytest.mark.parametrize("sets", [None, [], "shards", 3])
def test_a_mixture_needs_a_list(sets: Any) -> None:
    with pytest.raises(BadConfig, match=r"^a mixture needs a list of \(images, weight\), found "):
        Mixture(sets)


def test_arguments_are_checked(known: RangeImages) -> None:
    wrong: list[Any] = [[known], [(known,)], [(known, 1, None, 2)], [[known, 1]]]
    for sets in wrong:
        with pytest.raises(BadConfig, match=r"^a set of a mixture must be \(images, weight\) or "):
            Mixture(sets)
    nested: Any = Mixture([(known, 1)])
    for images in (nested, "shards", None):
        with pytest.raises(BadConfig, match="^a set of a mixture must be RangeImages, found (Mixture|str|NoneType)$"):
            Mixture([(images, 1)])
    for samples in (0, -1, 1.5, True):
        with pytest.raises(BadConfig, match="^samples must be "):
            Mixture([(known, 1)], samples=samples)  # type: ignore[arg-type]  # that is the point
    with pytest.raises(BadConfig, match="^weights of a mixture must have a sum above 0"):
        Mixture([(known, 0)])
    with pytest.raises(BadConfig, match="^a seed must be "):
        Mixture([(known, 1)], seed=-1)


def test_an_index_is_a_whole_number_within_the_mixture(mixture: Mixture) -> None:
    for value in (18, -19):
        with pytest.raises(IndexError, match=f"^index {value} of 18 samples$"):
            mixture[value]
    for value in (16, -17):
        with pytest.raises(IndexError, match=f"^index {value} of 16 samples$"):
            mixture.clean(value)
    wrong: Any = "0"
    with pytest.raises(BadConfig, match="^a sample's index must be a whole number, found '0'$"):
        mixture.location(wrong)
    for epoch in (-1, 1.0):
        with pytest.raises(BadConfig, match="^an epoch must be "):
            mixture.requests(epoch)  # type: ignore[arg-type]
