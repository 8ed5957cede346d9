"""The network that a bench measures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bodyseg_model.networks import FlipAverage, Trained, load_network
from bodyseg_model.networks.checkpoints import SHIPPED


def chosen_network(runs: Sequence[Path] = (), flip_average: bool = False) -> tuple[str, Trained]:
    """Name and network: that of the first run, or the one that ships. flip_average: as `FlipAverage`. Raises as
    `load_network`.
    """
    name, trained = runs[0].name if runs else "shipped", load_network(runs[0] if runs else SHIPPED)
    if not flip_average:
        return name, trained
    return f"{name}, flip average", replace(trained, network=FlipAverage(trained.network, trained.label_map))
