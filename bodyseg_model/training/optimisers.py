"""A recipe's optimiser, and its state as tensors with names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import nn

from bodyseg_data.core.errors import BadConfig
from bodyseg_model.training.recipes import Recipe


def make_optimiser(network: nn.Module, recipe: Recipe) -> torch.optim.Optimizer:
    """An optimiser with one group a layer, deepest first; a group's `share` is that of the last layer's rate.

    Biases and the scales of normalisation do not decay with adamw, as is usual; with sgd everything does, as in Caffe.
    """
    layers = list(_layers(network))
    groups: list[dict[str, Any]] = []
    for weights, share in zip(layers, recipe.layer_shares(len(layers)), strict=True):
        plain = [weight for weight in weights if weight.ndim > 1 or recipe.optimiser == "sgd"]
        kept = [weight for weight in weights if weight.ndim <= 1 and recipe.optimiser != "sgd"]
        for chosen, decay in ((plain, recipe.weight_decay), (kept, 0.0)):
            if chosen:
                groups.append({"params": chosen, "weight_decay": decay, "share": share})
    if recipe.optimiser == "sgd":
        return torch.optim.SGD(groups, recipe.learning_rate, recipe.momentum)
    return torch.optim.AdamW(groups, recipe.learning_rate)


def set_learning_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Set the last layer's rate, and the others' by their shares."""
    for group in optimiser.param_groups:
        group["lr"] = rate * group["share"]


def _layers(network: nn.Module) -> Iterator[list[nn.Parameter]]:
    """The trainable weights of each layer, in the order in which layers were made, which is that of the data."""
    for module in network.modules():
        weights = [weight for weight in module.parameters(recurse=False) if weight.requires_grad]
        if weights:
            yield weights


def optimiser_tensors(optimiser: torch.optim.Optimizer) -> dict[str, torch.Tensor]:
    """All that an optimiser remembers, by number of the weight and name."""
    return {
        f"{number}.{name}": value
        for number, memory in optimiser.state_dict()["state"].items()
        for name, value in memory.items()
        if isinstance(value, torch.Tensor)
    }


def fill_optimiser(optimiser: torch.optim.Optimizer, tensors: Mapping[str, torch.Tensor]) -> None:
    """Put back what `optimiser_tensors` gave. Raises BadConfig if it is of other weights."""
    weights = [weight for group in optimiser.param_groups for weight in group["params"]]
    memories: dict[int, dict[str, torch.Tensor]] = {}
    for name, value in tensors.items():
        number, _, kind = name.partition(".")
        if not number.isdecimal() or int(number) >= len(weights):
            raise BadConfig(f"an optimiser's memory of {len(weights)} weights has no place for {name!r}")
        if value.ndim and value.shape != weights[int(number)].shape:
            raise BadConfig(
                f"{name!r} must have the shape {list(weights[int(number)].shape)}, found {list(value.shape)}"
            )
        memories.setdefault(int(number), {})[kind] = value
    optimiser.load_state_dict({**optimiser.state_dict(), "state": memories})
