"""A network as somebody might add it: means over squares of 8 x 8 pixels, then two layers."""

from __future__ import annotations

import torch
import torch.nn.functional as F  # noqa: N812
from torch import nn

from bodyseg_data.labels import PART_COUNT
from bodyseg_model.networks import Network, check_range_images
from bodyseg_model.networks.network import relief_of


class Toy(Network):
    output_stride: int = 8

    def __init__(self, width: int = 4, classes: int = PART_COUNT) -> None:
        super().__init__({"width": width}, classes)
        self.layers = nn.Sequential(nn.Conv2d(2, width, 3, padding=1), nn.ReLU(), nn.Conv2d(width, classes, 1))

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        check_range_images(range_m)
        scores: torch.Tensor = self.layers(F.avg_pool2d(relief_of(range_m), self.output_stride, ceil_mode=True))
        return scores
