"""Recipes, and the optimisers made of them."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from typing import Any, Literal

import pytest
import torch
from benches.model.chosen import recipe_from_json

from bodyseg_data.core import BadConfig
from bodyseg_model.networks import build
from bodyseg_model.training import recipe_for
from bodyseg_model.training.optimisers import (
    Muon,
    fill_optimisers,
    make_optimisers,
    optimiser_tensors,
    orthogonal,
    set_learning_rate,
)
from bodyseg_model.training.recipes import PRESETS


def test_the_papers_recipe_is_its_networks_own() -> None:
    recipe = PRESETS["fcn_alexnet"]
    assert (recipe.steps, recipe.batch_size * recipe.accumulate, recipe.optimiser) == (70_000, 20, "sgd")
    assert (recipe.learning_rate, recipe.momentum, recipe.weight_decay, recipe.layer_decay) == (1e-2, 0.99, 5e-4, 0.01)
    assert recipe.learning_rate_at(0) == recipe.learning_rate_at(69_999) == 1e-2
    assert not recipe.mirror


def test_the_papers_rates_rise_from_layer_to_layer() -> None:
    network = build("fcn_alexnet", {"width": 1 / 16})
    (optimiser,) = make_optimisers(network, PRESETS["fcn_alexnet"])
    set_learning_rate([optimiser], 1e-2)
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


@pytest.mark.parametrize("name", ["adamw", "muon"])
def test_only_the_weights_of_convolutions_decay(name: Literal["adamw", "muon"]) -> None:
    network = build("compact", {"patch": 16, "widths": [4], "blocks": [1]})
    groups = [
        group for each in make_optimisers(network, recipe_for("compact", optimiser=name)) for group in each.param_groups
    ]
    for group in groups:
        for weight in group["params"]:
            assert (group["weight_decay"] > 0) == (weight.ndim > 1)
    assert sum(len(group["params"]) for group in groups) == len(list(network.parameters()))


def test_muon_has_all_convolutions_but_the_last_layers() -> None:
    network = build("compact", {"patch": 16, "widths": [4, 8], "blocks": [1, 1]})
    muon, adamw = make_optimisers(network, PRESETS["compact"])
    held = {id(weight) for group in muon.param_groups for weight in group["params"]}
    convolutions = {name for name, weight in network.named_parameters() if weight.ndim == 4}
    assert {name for name, weight in network.named_parameters() if id(weight) in held} == convolutions - {"head.weight"}
    assert adamw.param_groups[-1]["params"] == [network.get_parameter("head.bias")]


@pytest.mark.parametrize("shape", [(8, 40), (40, 8), (12, 12)])
def test_an_orthogonal_matrix_keeps_its_directions(shape: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(1)
    matrix = torch.randn(*shape, generator=generator) * torch.logspace(0, -1, shape[1])
    left, values, right = torch.linalg.svd(matrix, full_matrices=False)
    found = left.T @ orthogonal(matrix) @ right.T
    assert torch.allclose(found, found.diag().diag(), atol=1e-4)
    clear = values > values.norm() / 100
    assert clear.sum() >= len(values) // 2
    assert found.diag()[clear].min() > 0.6
    assert found.diag().max() < 1.3
    assert torch.equal(orthogonal(torch.zeros(3, 5)), torch.zeros(3, 5))


def test_muons_update_is_as_large_as_adamws_however_large_the_gradient() -> None:
    for scale in (1e-4, 1e4):
        weight = torch.nn.Parameter(torch.zeros(16, 8, 3, 3))
        muon = Muon([{"params": [weight]}], 0.01, bf16=False)
        weight.grad = scale * torch.randn(weight.shape, generator=torch.Generator().manual_seed(0))
        muon.step()
        assert weight.detach().square().mean().sqrt().item() == pytest.approx(0.2 * 0.01, rel=0.2)
        assert (weight * weight.grad).sum() < 0


@pytest.mark.parametrize("bf16", [False, True])
def test_muon_adds_up_momentum_and_looks_ahead_and_weights_decay(bf16: bool) -> None:
    draw = torch.Generator().manual_seed(3)
    weight = torch.nn.Parameter(torch.randn(6, 2, 3, 3, generator=draw))
    muon = Muon([{"params": [weight], "weight_decay": 0.5}], 0.01, bf16)
    expected, mean = weight.detach().flatten(1).clone(), torch.zeros(6, 18)
    for _ in range(3):
        weight.grad = torch.randn(weight.shape, generator=draw)
        muon.step()
        gradient = weight.grad.flatten(1)
        mean = 0.95 * mean + 0.05 * gradient
        ahead = 0.95 * mean + 0.05 * gradient
        update = orthogonal(ahead.to(torch.bfloat16 if bf16 else torch.float32)).float()
        expected = expected * (1 - 0.01 * 0.5) - 0.01 * 0.2 * math.sqrt(18) * update
        torch.testing.assert_close(weight.detach().flatten(1), expected, atol=2e-4 if bf16 else 1e-6, rtol=0)


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
    optimisers = [make_optimisers(network, PRESETS[name]) for network in networks]

    def step(which: int) -> None:
        torch.manual_seed(0)
        for weight in networks[which].parameters():
            weight.grad = torch.randn(weight.shape) if weight.requires_grad else None
        for optimiser in optimisers[which]:
            optimiser.step()

    step(0)
    networks[1].load_state_dict(networks[0].state_dict())
    memory = {name: value.clone() for name, value in optimiser_tensors(optimisers[0]).items()}
    fill_optimisers(optimisers[1], memory)
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
        ({"optimiser": "lion"}, "optimiser must be 'sgd' or 'adamw' or 'muon', found 'lion'"),
        ({"optimiser": ["sgd"]}, "optimiser must be 'sgd' or 'adamw' or 'muon', found ['sgd']"),
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
