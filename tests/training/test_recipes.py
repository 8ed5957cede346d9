"""Recipes, and the optimisers made of them."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from typing import Any

import pytest
import torch
from benches.model.chosen import recipe_from_json

from bodyseg_data.core import BadConfig
from bodyseg_model.networks import build
from bodyseg_model.training import recipe_for
from bodyseg_model.training.recipes import PRESETS, fill_optimiser, make_optimiser, optimiser_tensors, set_learning_rate


def test_the_papers_recipe_is_its_networks_own() -> None:
    recipe = PRESETS["fcn_alexnet"]
    assert (recipe.steps, recipe.batch_size * recipe.accumulate, recipe.optimiser) == (70_000, 20, "sgd")
    assert (recipe.learning_rate, recipe.momentum, recipe.weight_decay, recipe.layer_decay) == (1e-2, 0.99, 5e-4, 0.01)
    assert recipe.learning_rate_at(0) == recipe.learning_rate_at(69_999) == 1e-2
    assert not recipe.mirror


def test_the_papers_rates_rise_from_layer_to_layer() -> None:
    network = build("fcn_alexnet", {"width": 1 / 16})
    optimiser = make_optimiser(network, PRESETS["fcn_alexnet"])
    set_learning_rate(optimiser, 1e-2)
    rates = [group["lr"] for group in optimiser.param_groups]
    assert rates[0] == pytest.approx(1e-4)
    assert rates[-1] == pytest.approx(1e-2)
    assert rates == sorted(rates)
    assert len(rates) == 9  # conv1 to conv8 and score
    assert rates[4] == pytest.approx(1e-3)  # half way, geometrically
    trained = {id(weight) for group in optimiser.param_groups for weight in group["params"]}
    frozen = [name for name, weight in network.named_parameters() if id(weight) not in trained]
    assert frozen == ["upfeat.weight"]
    assert all(group["momentum"] == 0.99 and group["weight_decay"] == 5e-4 for group in optimiser.param_groups)


def test_with_adamw_only_the_weights_of_convolutions_decay() -> None:
    network = build("compact", {"patch": 16, "widths": [4], "blocks": [1]})
    optimiser = make_optimiser(network, PRESETS["compact"])
    for group in optimiser.param_groups:
        for weight in group["params"]:
            assert (group["weight_decay"] > 0) == (weight.ndim > 1)
    assert sum(len(group["params"]) for group in optimiser.param_groups) == len(list(network.parameters()))


def test_rates_rise_then_fall() -> None:
    recipe = recipe_for("compact", steps=100, learning_rate=1.0, warmup=0.1)
    rates = [recipe.learning_rate_at(step) for step in range(100)]
    assert rates[:10] == pytest.approx([(step + 1) / 11 for step in range(10)])
    assert rates[10] == 1.0
    assert rates[55] == pytest.approx((1 + math.cos(math.pi / 2)) / 2)
    assert all(after < before for before, after in itertools.pairwise(rates[10:]))
    assert 0 < rates[-1] < 1e-3


@pytest.mark.parametrize("name", ["fcn_alexnet", "compact"])
def test_an_optimisers_memory_goes_back_where_it_came_from(name: str) -> None:
    settings = {"width": 1 / 16} if name == "fcn_alexnet" else {"patch": 16, "widths": [4], "blocks": [1]}
    networks = [build(name, settings), build(name, settings)]
    networks[1].load_state_dict(networks[0].state_dict())
    optimisers = [make_optimiser(network, PRESETS[name]) for network in networks]

    def step(which: int) -> None:
        torch.manual_seed(0)
        for weight in networks[which].parameters():
            weight.grad = torch.randn(weight.shape) if weight.requires_grad else None
        optimisers[which].step()

    step(0)
    networks[1].load_state_dict(networks[0].state_dict())
    memory = {name: value.clone() for name, value in optimiser_tensors(optimisers[0]).items()}
    fill_optimiser(optimisers[1], memory)
    step(0)
    step(1)
    for one, two in zip(networks[0].parameters(), networks[1].parameters(), strict=True):
        assert torch.equal(one, two)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"batch_size": 0}, "batch_size must be at least 1, found 0"),
        ({"momentum": 1.0}, "momentum must be from 0 to 0.9999, found 1.0"),
        ({"learning_rate": float("inf")}, "learning_rate must be from 1e-09 to 10, found inf"),
        ({"balance": -1}, "balance must be from 0 to 1, found -1"),
        ({"optimiser": "lion"}, "optimiser must be 'sgd' or 'adamw', found 'lion'"),
        ({"optimiser": ["sgd"]}, "optimiser must be 'sgd' or 'adamw', found ['sgd']"),
        ({"steps": "many"}, "Recipe: steps must be a whole number, found 'many'"),
        ({"geometric_augmentation": {}}, "geometric_augmentation must be of class GeometricAugmentation, found {}"),
    ],
)
def test_bad_recipes_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(BadConfig) as caught:
        dataclasses.replace(PRESETS["compact"], **changes)
    assert message in str(caught.value)


def test_a_recipe_comes_back_from_json() -> None:
    for recipe in PRESETS.values():
        assert recipe_from_json(json.loads(json.dumps(dataclasses.asdict(recipe)))) == recipe


def test_an_unknown_recipe_is_refused() -> None:
    with pytest.raises(BadConfig, match="the recipe must be one of fcn_alexnet, compact, finder, found 'unet'"):
        recipe_for("unet")
