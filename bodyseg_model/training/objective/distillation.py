"""Distillation: a network that is trained learns from another one's scores beside the labels.

Hinton, Vinyals and Dean, "Distilling the knowledge in a neural network", 2015.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.labels.label_map import LabelMap
from bodyseg_model.networks.network import Network
from bodyseg_model.training.objective.loss import TEMPERATURE
from bodyseg_model.training.objective.selected_pixels import SelectedPixels


@dataclass(frozen=True)
class Teacher:
    """A trained network whose probabilities are part of the loss.

    network: set to evaluation mode; its weights do not change. label_map: its classes. share: of the loss, above 0 up
    to 1; the labels have the rest. origin: its file and the SHA-256 of its weights, as plain JSON. Raises BadConfig for
    a share out of range.
    """

    network: Network = field(repr=False)
    label_map: LabelMap = field(repr=False)
    origin: dict[str, Any]
    share: float = 0.5

    def __post_init__(self) -> None:
        if not 0 < self.share <= 1:  # also refuses NaN
            raise BadConfig(f"the teacher's share of the loss must be above 0 and at most 1, found {self.share:g}")
        self.network.eval().requires_grad_(False)

    def to_json(self) -> dict[str, Any]:
        """Origin and share, for a training's plan and the network's card."""
        return {**self.origin, "share": self.share}

    def for_training(self, label_map: LabelMap, device: torch.device) -> Teacher:
        """Move the network to a device. Raises BadConfig unless its classes are those of the training."""
        if self.label_map.classes != label_map.classes:
            raise BadConfig(
                f"the teacher must have the labels {label_map.name!r} of this training, found {self.label_map.name!r}"
            )
        self.network.to(device)
        return self

    @torch.no_grad()
    def __call__(self, range_m: torch.Tensor, pixels: SelectedPixels) -> torch.Tensor:
        """Compute log-probabilities at `TEMPERATURE` of selected pixels, float32 [N, C].

        range_m: float32 [B, 1, H, W], metres, 0 = nothing measured.
        """
        scores = pixels.interpolated(self.network.scores(range_m), self.network.output_stride)
        return (scores / TEMPERATURE).log_softmax(1)
