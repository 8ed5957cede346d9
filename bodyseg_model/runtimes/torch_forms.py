"""Networks that are not trained any more, as torch computes them quickest: folded, and in bfloat16."""

from __future__ import annotations

import copy
import itertools

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from bodyseg_model.networks.network import Network
from bodyseg_model.networks.registry import device_of


def folded(network: Network) -> Network:
    """A copy of a network in evaluation mode that computes each convolution and the batch normalisation after it as one
    convolution; the network itself where none follow each other in an `nn.Sequential`, or while it is trained.

    Scores differ by the rounding of float32. The copy cannot be trained.
    """
    if network.training or not any(_normalised_convolutions(module) for module in network.modules()):
        return network
    found = copy.deepcopy(network)
    for module in list(found.modules()):
        for first, convolution, normalisation in _normalised_convolutions(module):
            with torch.no_grad():
                one = fuse_conv_bn_eval(convolution, normalisation)
            module.register_module(str(first), one)
            module.register_module(str(first + 1), nn.Identity())
    return found


def _normalised_convolutions(module: nn.Module) -> list[tuple[int, nn.Conv2d, nn.BatchNorm2d]]:
    """The convolutions of a Sequential that a batch normalisation follows: number, convolution, normalisation."""
    children = list(module) if isinstance(module, nn.Sequential) else []
    return [
        (number, child, following)
        for number, (child, following) in enumerate(itertools.pairwise(children))
        if isinstance(child, nn.Conv2d) and isinstance(following, nn.BatchNorm2d)
    ]


class Bfloat16(Network):
    """A copy of a network in evaluation mode, computed in bfloat16 on its device.

    Convolutions are in 16 bits, sums in 32, as torch's autocast divides them.
    """

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
