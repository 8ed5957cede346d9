"""A recipe's optimiser, and its state as tensors with names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import nn

from bodyseg_data.core.errors import BadConfig
from bodyseg_model.training.recipes import Recipe


def make_optimiser(network: nn.Module, recipe: Recipe) -> torch.optim.Optimizer:
    """Make a recipe's optimiser, with one or two parameter groups a layer, deepest first.

    A group's `share` is its learning rate as a share of the last layer's (`Recipe.layer_decay`). With adamw biases and
    the scales of normalisation have no weight decay, as is usual; with sgd all weights have it, as in Caffe.
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
    """Set the last layer's learning rate, and the other layers' by their shares."""
    for group in optimiser.param_groups:
        group["lr"] = rate * group["share"]


def _layers(network: nn.Module) -> Iterator[list[nn.Parameter]]:
    """Trainable weights of each layer, in the order of construction, which is that of the data flow."""
    for module in network.modules():
        weights = [weight for weight in module.parameters(recurse=False) if weight.requires_grad]
        if weights:
            yield weights


def optimiser_tensors(optimiser: torch.optim.Optimizer) -> dict[str, torch.Tensor]:
    """State tensors of an optimiser, named "index of the weight.name"."""
    return {
        f"{number}.{name}": value
        for number, entries in optimiser.state_dict()["state"].items()
        for name, value in entries.items()
        if isinstance(value, torch.Tensor)
    }


def fill_optimiser(optimiser: torch.optim.Optimizer, tensors: Mapping[str, torch.Tensor]) -> None:
    """Restore the state that `optimiser_tensors` gave. Raises BadConfig if it belongs to other weights."""
    weights = [weight for group in optimiser.param_groups for weight in group["params"]]
    states: dict[int, dict[str, torch.Tensor]] = {}
    for name, value in tensors.items():
        number, _, kind = name.partition(".")
        if not number.isdecimal() or int(number) >= len(weights):
            raise BadConfig(f"the state of an optimiser of {len(weights)} weights cannot have the entry {name!r}")
        if value.ndim and value.shape != weights[int(number)].shape:
            raise BadConfig(
                f"{name!r} must have the shape {list(weights[int(number)].shape)}, found {list(value.shape)}"
            )
        states.setdefault(int(number), {})[kind] = value
    optimiser.load_state_dict({**optimiser.state_dict(), "state": states})
