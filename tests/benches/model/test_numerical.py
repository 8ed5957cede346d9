"""Networks that are known to notice one thing, and the ways of computing that must make them notice it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from benches.model.networks.numerical import BATCH_SIZES, bench_numerical, numerical, table
from torch import nn

from bodyseg_data.labels import BACKGROUND, PART_COUNT
from bodyseg_data.loading import RangeImages
from bodyseg_data.samples import ViewGrid
from bodyseg_model.networks import Network, build, save_network

NOTHING = {"changed": 0.0, "accuracy_change": 0.0}
FEWER_BITS = {"bf16, autocast", "bf16 throughout", "fp16, autocast", "fp16 throughout", "weights kept in fp16"}
AS_MANY = {"two threads", "channels last"}


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory, pack_figures: Callable[..., Path]) -> Path:
    views = ViewGrid((215, 295), span_deg=360, azimuths=3, count=3)
    return pack_figures(tmp_path_factory.mktemp("small") / "shards", meshes=2, views=views)


@pytest.fixture(scope="module")
def images(shards: Path) -> RangeImages:
    return RangeImages(shards, "all")


class Told(Network):
    """Gives every pixel of a batch the label that a function says."""

    def __init__(self, label: Callable[[torch.Tensor], int]) -> None:
        super().__init__()
        self.label = label
        self.eval()

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        scores = torch.zeros(len(range_m), PART_COUNT, *range_m.shape[2:])
        scores[:, self.label(range_m)] = 1
        return scores


class Close(Network):
    """Scores that differ by less than 16 bits can tell, the last one highest."""

    def __init__(self) -> None:
        super().__init__()
        self.head = nn.Conv2d(1, PART_COUNT, 1, bias=False)
        self.head.weight.data = 1 + 1e-6 * torch.arange(PART_COUNT)[:, None, None, None]
        self.eval()

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        scores: torch.Tensor = self.head(range_m)
        return scores


def test_whole_numbers_are_the_same_in_every_way(images: RangeImages) -> None:
    done: list[tuple[int, int]] = []
    found = numerical(Told(lambda range_m: 3), images, 3, lambda *numbers: done.append(numbers))
    assert found["images"] == 3
    assert set(found["computations"]) == FEWER_BITS | AS_MANY
    assert all(way == NOTHING for way in found["computations"].values())
    assert set(found["batches"]) == {str(size) for size in BATCH_SIZES}
    for batch in found["batches"].values():
        assert batch == NOTHING
    assert done == [(count, 10) for count in range(1, 11)]


def test_fewer_bits_change_what_hangs_on_the_last_ones(images: RangeImages) -> None:
    found = numerical(Close(), images, 2)
    for name in FEWER_BITS:
        assert found["computations"][name]["changed"] == 1, name
    for name in AS_MANY:
        assert found["computations"][name] == NOTHING, name


def test_a_change_of_accuracy_is_that_of_the_labels(images: RangeImages) -> None:
    labels = images[int(images.order(0)[0])]["labels"]
    shown = set(labels[labels != BACKGROUND].tolist())
    there, hidden = min(shown), min(set(range(PART_COUNT)) - shown)
    found = numerical(Told(lambda range_m: there if range_m.dtype == torch.float32 else hidden), images, 1)
    assert found["computations"]["bf16 throughout"] == {
        "changed": 1.0,
        "accuracy_change": pytest.approx(-1 / len(shown), abs=1e-6),
    }
    assert found["computations"]["bf16, autocast"] == NOTHING


def test_a_network_that_counts_the_batch_changes_by_arithmetic(images: RangeImages) -> None:
    found = numerical(Told(len), images, 3)
    assert all(way == NOTHING for way in found["computations"].values())
    # Of three images, two make a batch and the last is alone; or all make one.
    assert 0.5 < found["batches"]["2"]["changed"] < found["batches"]["7"]["changed"] == 1


def test_what_cannot_be_computed_is_null_with_a_reason(images: RangeImages) -> None:
    def refuse(range_m: torch.Tensor) -> int:
        if range_m.dtype != torch.float32:
            raise RuntimeError(f"no kernel for {range_m.dtype}\nand a long tail")
        return 3

    found = numerical(Told(refuse), images, 1)["computations"]
    for name, kind in (("bf16 throughout", "bfloat16"), ("fp16 throughout", "float16")):
        assert found[name] == {"changed": None, "accuracy_change": None, "reason": f"no kernel for torch.{kind}"}
    assert found["fp16, autocast"] == NOTHING


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("two_threads")
def test_threads_are_one_but_where_two_are_tried_and_then_as_before(images: RangeImages) -> None:
    seen: list[int] = []

    def count(range_m: torch.Tensor) -> int:
        seen.append(torch.get_num_threads())
        return seen[-1]

    found = numerical(Told(count), images, 2)["computations"]
    assert torch.get_num_threads() == 2
    assert sorted(seen) == [1] * (len(seen) - 2) + [2, 2]
    assert found["two threads"]["changed"] == 1 and found["bf16, autocast"]["changed"] == 0


def test_the_table_says_why_a_number_is_missing() -> None:
    found = {
        "computations": {
            "bf16": {"changed": 0.0123, "accuracy_change": -0.001},
            "fp16": {"changed": None, "accuracy_change": None, "reason": "not on this processor"},
        },
        "batches": {"7": {"changed": 0.5, "accuracy_change": 0.25}},
    }
    assert [[*row.values()] for row in table(found)] == [
        ["bf16", "1.230", "-0.10"],
        ["fp16", "–", "not on this processor"],
        ["7 images together", "50.000", "+25.00"],
    ]


def test_the_bench_asks_the_first_run_about_test_images_of_all(figures_set: Path, tmp_path: Path) -> None:
    network = build("compact", {"patch": 16, "widths": (8,), "blocks": (0,)}, 0)
    save_network(tmp_path / "network.safetensors", network, "compact", {"variant": "all", "seed": 0})
    found = bench_numerical(str(figures_set), 2, [tmp_path])
    assert (found["network"], found["images"]) == (tmp_path.name, 2)
    assert found["tables"]["arithmetic"] == table(found)
