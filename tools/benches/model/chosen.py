"""The network that a bench measures: which, its size, its recipe."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import nn

from bodyseg_model.networks import SHIPPED, FlipAverage, Trained, load_network
from bodyseg_model.training import GeometricAugmentation, Recipe


def chosen_network(runs: Sequence[Path] = (), flip_average: bool = False) -> tuple[str, Trained]:
    """Name and network: that of the first run, or the one that ships. flip_average: as `FlipAverage`. Raises as
    `load_network`.
    """
    name, trained = runs[0].name if runs else "shipped", load_network(runs[0] if runs else SHIPPED)
    if not flip_average:
        return name, trained
    return f"{name}, flip average", replace(trained, network=FlipAverage(trained.network, trained.label_map))


def parameters(network: nn.Module) -> int:
    """Number of a network's parameters, frozen ones counted."""
    return sum(weight.numel() for weight in network.parameters())


def recipe_from_json(content: Mapping[str, Any]) -> Recipe:
    """Rebuild a recipe from what `Recipe.to_json` gave. Raises TypeError, KeyError or BadConfig for anything else."""
    return Recipe(**{**content, "geometric_augmentation": GeometricAugmentation(**content["geometric_augmentation"])})
