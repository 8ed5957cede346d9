"""Exponential moving average (EMA) of a network's weights over the steps of a training."""

from __future__ import annotations

import copy

import torch

from bodyseg_model.networks.network import Network


class AveragedNetwork:
    """A network whose weights are the exponential moving average of another's (Polyak and Juditsky, 1992).

    After step t, counted from 0, average = d average + (1 - d) weights with d = min(decay, (1 + t) / (10 + t)), so that
    the first weights, which are random, are soon forgotten. The statistics of batch normalisation are averaged like the
    weights (docs/how-to/training.md has the comparison); whole numbers are copied.

    network: the averaged network, in evaluation mode. decay: the largest share that the average keeps in a step.
    """

    def __init__(self, network: Network, decay: float) -> None:
        self.network = copy.deepcopy(network).eval().requires_grad_(False)
        self.decay = decay

    def __repr__(self) -> str:
        return f"AveragedNetwork({type(self.network).__name__}, decay={self.decay})"

    @torch.no_grad()
    def update(self, network: Network, step: int) -> None:
        """Take in the weights after step `step`, counted from 0. network: of the same shape as the averaged one."""
        decay = min(self.decay, (1 + step) / (10 + step))
        weights = network.state_dict()
        for name, average in self.network.state_dict().items():
            if average.is_floating_point():
                average.lerp_(weights[name], 1 - decay)
            else:
                average.copy_(weights[name])
