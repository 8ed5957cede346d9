"""Torch in bfloat16: convolutions in 16 bits, sums in 32, as torch's autocast divides them."""

from __future__ import annotations

import copy

import torch
from torch import nn

from bodyseg_model.networks.network import Network
from bodyseg_model.networks.registry import device_of


class Bfloat16(Network):
    """A copy of a network in evaluation mode, computed in bfloat16 on its device."""

    def __init__(self, network: Network) -> None:
        super().__init__(network.settings, network.classes)
        self.output_stride = network.output_stride
        self.network = copy.deepcopy(network)
        for module in self.network.modules():
            if isinstance(module, (nn.Conv2d, nn.Linear)):
                module.to(torch.bfloat16)  # autocast would round their weights in every call, to the same bits
        self.train(network.training)

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        """Compute scores; see `Network.scores`."""
        with torch.autocast(device_of(self.network).type, torch.bfloat16):
            return self.network.scores(range_m)
