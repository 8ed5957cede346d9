"""Averaged weights."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from benches.model.chosen import recipe_from_json
from small_training import TINY, train

from bodyseg_data.core import BadConfig
from bodyseg_model.networks import build, load_network
from bodyseg_model.training import recipe_for
from bodyseg_model.training.loop import AveragedNetwork


def test_averages_follow_their_formula() -> None:
    network = build("compact", {"patch": 16, "widths": [4], "blocks": [1]}, seed=0)
    averaged = AveragedNetwork(network, 0.5)
    expected = {name: value.clone().double() for name, value in network.state_dict().items()}
    for step, decay in enumerate((1 / 10, 2 / 11, 3 / 12, 4 / 13, 5 / 14, 6 / 15, 7 / 16, 8 / 17, 0.5, 0.5)):
        with torch.no_grad():
            for tensor in network.state_dict().values():
                tensor += torch.randn(tensor.shape).to(tensor.dtype) if tensor.is_floating_point() else 3
        for name, value in network.state_dict().items():
            expected[name] = decay * expected[name] + (1 - decay) * value.double()
        averaged.update(network, step)
    counted = 0
    for name, value in averaged.network.state_dict().items():
        if value.is_floating_point():
            torch.testing.assert_close(value.double(), expected[name], atol=1e-5, rtol=1e-5)
        else:
            assert int(value) == 30, "batches counted are copied"
            counted += 1
    assert counted
    assert not averaged.network.training


def test_an_averaged_training_saves_the_averages_and_trains_as_without(small_set: Path, tmp_path: Path) -> None:
    train(small_set, tmp_path / "plain", steps=3)
    losses = [metrics.loss for metrics in train(small_set, tmp_path / "averaged", steps=3, ema=0.9)]
    assert losses == [metrics.loss for metrics in train(small_set, tmp_path / "again", steps=3)]
    (checkpoint,) = (tmp_path / "averaged").glob("checkpoint-*.safetensors")
    plain, averaged = (load_network(tmp_path / name).network.state_dict() for name in ("plain", "averaged"))
    assert any(not torch.equal(plain[name], averaged[name]) for name in plain)
    assert load_network(tmp_path / "averaged").card["recipe"]["ema"] == 0.9
    assert "ema" not in load_network(tmp_path / "plain").card["recipe"]
    (tmp_path / "averaged" / "network.json").unlink()  # then the last checkpoint is loaded
    last = load_network(tmp_path / "averaged").network.state_dict()
    assert all(torch.equal(last[name], averaged[name]) for name in last)
    assert checkpoint.stat().st_size > (tmp_path / "plain" / checkpoint.name).stat().st_size


def test_a_training_averages_the_weights_of_its_steps(small_set: Path, tmp_path: Path) -> None:
    for name, ema in (("plain", 0.0), ("averaged", 0.9)):
        train(small_set, tmp_path / name, steps=1, ema=ema)
    drawn = build("compact", TINY, seed=0).state_dict()
    plain, averaged = (load_network(tmp_path / name).network.state_dict() for name in ("plain", "averaged"))
    for name, value in averaged.items():
        if value.is_floating_point():
            torch.testing.assert_close(value, 0.1 * drawn[name] + 0.9 * plain[name], atol=1e-6, rtol=1e-5)
    assert not torch.equal(plain["head.weight"], drawn["head.weight"])


def test_the_decay_belongs_to_the_recipe() -> None:
    recipe = recipe_for("compact", ema=0.999)
    assert recipe_from_json(recipe.to_json()) == recipe
    with pytest.raises(BadConfig, match="ema must be from 0 to 0.999999, found 1.0"):
        recipe_for("compact", ema=1.0)
