"""`bench mining`: which candidates are chosen, and what a set of them says of networks."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from benches.model.failures import mining
from benches.model.failures.mining import Candidate, accuracy, bench_mining, bin_name, bin_of, chosen, mean_of
from small_training import TINY

from bodyseg_data.bodies import BodyRef
from bodyseg_data.bodies.contact_poses import DrawnContact
from bodyseg_data.bodies.skeleton import Pose
from bodyseg_data.core import BadConfig
from bodyseg_data.loading import RangeImages
from bodyseg_model.evaluation import evaluate
from bodyseg_model.networks import SHIPPED, Trained, build, load_network


def candidates() -> list[Candidate]:
    """Sixty, the first of them best, of 20, 35 and 50 degrees in turn; every tenth has deep skin in skin."""
    return [
        Candidate(f"body-{index:02d}", 1 - index / 100, (20.0, 35.0, 50.0)[index % 3], 0.02 if index % 10 == 9 else 0.0)
        for index in range(60)
    ]


def test_the_worst_of_each_bin_are_mined() -> None:
    lists = chosen(candidates())
    fit = [each for each in candidates() if each.deepest_m < 0.02]
    assert len(lists["mined"]) == len(set(lists["mined"])) == len(set(lists["uniform"])) == len(fit) // 3 == 18
    for degrees in (20, 35, 50):
        within = [each.name for each in fit if each.degrees == degrees]
        assert sorted(set(within) & {*lists["mined"]}) == within[-6:]
    names = {each.name for each in fit}
    assert {*lists["uniform"]} <= names and {*lists["uniform"]} != {*lists["mined"]}
    assert lists == chosen(candidates()[::-1])


def test_a_small_bin_gives_few() -> None:
    few = [each._replace(degrees=20.0 if index > 2 else 50.0) for index, each in enumerate(candidates())]
    mined = {*chosen(few)["mined"]}
    assert len(mined) == 18 and {each.name for each in few[:3]} & mined == {few[2].name}
    with pytest.raises(BadConfig, match="a third of the bodies without deep skin in skin, found 2"):
        chosen(few[:2])


def test_bins_of_novelty() -> None:
    assert [bin_of(degrees) for degrees in (0, 29.9, 30, 39.9, 40, 170)] == [0, 0, 1, 1, 2, 2]
    assert [bin_name(number) for number in range(3)] == ["0 to 30", "30 to 40", "above 40"]


def test_the_mean_of_two_networks() -> None:
    one, other = (build("compact", TINY, seed) for seed in (0, 1))
    weights = {name: each for name, each in one.state_dict().items() if each.is_floating_point()}
    expected = {name: (each + other.state_dict()[name]) / 2 for name, each in weights.items()}
    found = mean_of(one, other).state_dict()
    torch.testing.assert_close({name: found[name] for name in expected}, expected)


def test_accuracy_of_some_parts() -> None:
    counts = np.zeros((33, 33), np.int64)
    counts[3, 3], counts[3, 4], counts[5, 5] = 1, 3, 2
    assert accuracy(counts) == pytest.approx(0.625)
    assert (accuracy(counts, [3]), accuracy(counts, [5])) == (0.25, 1.0)
    assert math.isnan(accuracy(counts, [7]))


class KnownBodies:
    """Stands for `Poses`, and for its candidates: the bodies of a set of plain figures, three degrees apart."""

    def __init__(self, names: list[str]) -> None:
        self.candidates, self.names = self, names

    def bodies(self) -> list[BodyRef]:
        return [BodyRef("candidates", name, name, "standing", "train") for name in self.names]

    def drawn(self, _: BodyRef) -> DrawnContact:
        return DrawnContact(Pose(), ("free", "free"), 1, 0.001)

    def degrees(self, mesh: str) -> float:
        return 28.0 + 3 * self.names.index(mesh)


def test_both_trainings_and_their_scores(figures_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = RangeImages(str(figures_set), "all", None)
    names = sorted({images.clean(index).info.mesh for index in range(len(images))})
    monkeypatch.setattr(mining, "Poses", lambda: KnownBodies(names))

    def loaded(path: Path) -> Trained:
        return Trained(build("compact", TINY, 0).eval(), {}) if path is SHIPPED else load_network(path)

    monkeypatch.setattr(mining, "load_network", loaded)
    found = bench_mining(str(figures_set), [tmp_path], str(figures_set), str(figures_set), steps=1, images=5)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mined-0", "uniform-0"]
    assert found["candidates"] == sum(each["bodies"]["all"] for each in found["bins"]) >= 3
    assert len(found["chosen"]["mined"]) == len(found["chosen"]["uniform"]) == found["candidates"] // 3
    assert [*found["networks"]] == [
        *("shipped", "mined-0", "mean of shipped and mined-0", "uniform-0", "mean of shipped and uniform-0")
    ]
    test_images = RangeImages(str(figures_set), "all", "test")
    total = evaluate(loaded(SHIPPED).network, test_images, 5, confidences=False).total().confusion
    for scores in found["networks"]["shipped"].values():
        assert scores["accuracy"] == pytest.approx(total.average_per_class_accuracy(), abs=1e-4)
    trained = load_network(tmp_path / "mined-0")
    assert trained.card["step"] == 1 and trained.card["data"]["mixture"][0]["only"]
    monkeypatch.setattr(mining, "Poses", lambda: KnownBodies(["another"]))
    with pytest.raises(BadConfig, match="chooses among bodies of the source 'candidates', found"):
        bench_mining(str(figures_set), [tmp_path], str(figures_set))
