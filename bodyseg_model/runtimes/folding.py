"""Batch normalisation folded into the convolutions before it, as a network that is not trained any more allows."""

from __future__ import annotations

import copy
import itertools

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from bodyseg_model.networks.network import Network


def folded(network: Network) -> Network:
    """A copy of a network in evaluation mode that computes each convolution and the batch normalisation after it as one
    convolution; the network itself where none follow each other in an `nn.Sequential`, or while it is trained.

    Scores differ by the rounding of float32. The copy cannot be trained.
    """
    if network.training or not any(_pairs(module) for module in network.modules()):
        return network
    found = copy.deepcopy(network)
    for module in list(found.modules()):
        for first, convolution, normalisation in _pairs(module):
            with torch.no_grad():
                one = fuse_conv_bn_eval(convolution, normalisation)
            module.register_module(str(first), one)
            module.register_module(str(first + 1), nn.Identity())
    return found


def _pairs(module: nn.Module) -> list[tuple[int, nn.Conv2d, nn.BatchNorm2d]]:
    """The convolutions of a Sequential that a batch normalisation follows: number, convolution, normalisation."""
    children = list(module) if isinstance(module, nn.Sequential) else []
    return [
        (number, child, following)
        for number, (child, following) in enumerate(itertools.pairwise(children))
        if isinstance(child, nn.Conv2d) and isinstance(following, nn.BatchNorm2d)
    ]
