"""The optimisers that a recipe names, and their state as tensors with names."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import torch
from torch import nn

from bodyseg_model.training.recipes import Recipe

_MOMENTUM: Final = 0.95
_QUINTIC: Final = 3.4445, -4.7750, 2.0315
_ROUNDS: Final = 5

Optimisers = Sequence[torch.optim.Optimizer]


class Muon(torch.optim.Optimizer):
    """Momentum whose every update is an orthogonal matrix (Jordan et al., "Muon: an optimizer for hidden layers in
    neural networks", 2024): all directions of a layer's weights move alike, not just those of large gradients.

    Weights [O, I, h, w] are taken as a matrix of O rows. An update has a root mean square of 0.2 of the learning rate,
    as AdamW's has (Liu et al., "Muon is scalable for LLM training", 2025).

    bf16: whether matrices are multiplied in bfloat16. `torch.optim.Muon` takes matrices alone, and always multiplies in
    bfloat16, which takes a processor that must emulate it 12 times as long as float32.
    """

    def __init__(self, groups: Iterable[dict[str, Any]], learning_rate: float, bf16: bool) -> None:
        super().__init__(groups, {"lr": learning_rate, "weight_decay": 0.0})
        self._type = torch.bfloat16 if bf16 else torch.float32

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Update all weights that have gradients."""
        for group in self.param_groups:
            for weight in group["params"]:
                if weight.grad is None:
                    continue
                if not self.state[weight]:
                    self.state[weight]["mean"] = torch.zeros_like(weight)
                mean = self.state[weight]["mean"]
                mean.lerp_(weight.grad, 1 - _MOMENTUM)
                update = orthogonal(weight.grad.lerp(mean, _MOMENTUM).flatten(1).to(self._type))
                size = group["lr"] * 0.2 * math.sqrt(max(update.shape))
                weight.mul_(1 - group["lr"] * group["weight_decay"])
                weight.add_(update.reshape(weight.shape), alpha=-size)


def orthogonal(matrix: torch.Tensor) -> torch.Tensor:
    """The matrix [R, C] with singular values near 1 (0.7 to 1.2) in place of its own, by Newton and Schulz' iteration
    with the coefficients of Jordan et al.; those below a thousandth of its norm stay smaller.
    """
    x = matrix.T if len(matrix) > matrix.shape[1] else matrix
    x = x / x.norm().clamp(min=1e-7)
    first, third, fifth = _QUINTIC
    for _ in range(_ROUNDS):
        squares = x @ x.T
        x = torch.addmm(x, torch.addmm(squares, squares, squares, beta=third, alpha=fifth), x, beta=first)
    return x.T if len(matrix) > matrix.shape[1] else x


def make_optimisers(network: nn.Module, recipe: Recipe) -> Optimisers:
    """Make a recipe's optimisers, with one or two parameter groups a layer, deepest first, the last layer's last.

    A group's `share` is its learning rate as a share of the last layer's (`Recipe.layer_decay`). With sgd all weights
    decay, as in Caffe; else biases and the scales of normalisation do not, as is usual. Muon has all layers' matrices
    but the last layer's, AdamW the others.
    """
    # Trainable weights in the order of construction, which is that of the data flow.
    by_module = ([w for w in each.parameters(recurse=False) if w.requires_grad] for each in network.modules())
    layers = [weights for weights in by_module if weights]
    matrices: list[dict[str, Any]] = []
    others: list[dict[str, Any]] = []
    for at, weights in enumerate(layers):
        share = recipe.layer_decay ** (1 - at / max(1, len(layers) - 1))
        plain = [weight for weight in weights if weight.ndim > 1 or recipe.optimiser == "sgd"]
        kept = [weight for weight in weights if weight.ndim <= 1 and recipe.optimiser != "sgd"]
        by_muon = recipe.optimiser == "muon" and weights is not layers[-1]
        if plain:
            group = {"params": plain, "weight_decay": recipe.weight_decay, "share": share}
            (matrices if by_muon else others).append(group)
        if kept:
            others.append({"params": kept, "weight_decay": 0.0, "share": share})
    if recipe.optimiser == "sgd":
        return [torch.optim.SGD(others, recipe.learning_rate, recipe.momentum)]
    muon = [Muon(matrices, recipe.learning_rate, recipe.bf16)] if matrices else []
    return [*muon, torch.optim.AdamW(others, recipe.learning_rate)]


def set_learning_rate(optimisers: Optimisers, rate: float) -> None:
    """Set the last layer's learning rate, and the other layers' by their shares."""
    for optimiser in optimisers:
        for group in optimiser.param_groups:
            group["lr"] = rate * group["share"]


def optimiser_tensors(optimisers: Optimisers) -> dict[str, torch.Tensor]:
    """State tensors of optimisers, named "index of the optimiser.index of the weight.name"."""
    return {
        f"{at}.{number}.{name}": value
        for at, optimiser in enumerate(optimisers)
        for number, entries in optimiser.state_dict()["state"].items()
        for name, value in entries.items()
        if isinstance(value, torch.Tensor)
    }


def fill_optimisers(optimisers: Optimisers, tensors: Mapping[str, torch.Tensor]) -> None:
    """Restore the state that `optimiser_tensors` gave of optimisers of the same weights."""
    states: list[dict[int, dict[str, torch.Tensor]]] = [{} for _ in optimisers]
    for name, value in tensors.items():
        at, number, kind = name.split(".", 2)
        states[int(at)].setdefault(int(number), {})[kind] = value
    for optimiser, state in zip(optimisers, states, strict=True):
        optimiser.load_state_dict({**optimiser.state_dict(), "state": state})
