"""What training makes small: the network's mean surprise at the labels of the body's pixels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from torch import nn

from bodyseg_data.core.parts import BACKGROUND, PART_COUNT
from bodyseg_model.networks.fcn_alexnet import FcnAlexnet
from bodyseg_model.networks.registry import coarse


class Outcome(NamedTuple):
    """loss: scalar. counts: int64 [33, 33], pixels by true and predicted part, of those that were looked at."""

    loss: torch.Tensor
    counts: torch.Tensor


class NetworkWithLoss(nn.Module):
    """A network and its loss as one module, which is what gets shared out over processes.

    Softmax cross-entropy over 33 parts, background ignored (section 3.5). Where scores are coarser than the image, a
    step looks at one pixel in each cell of step x step, all at the same place within their cells, with scores
    interpolated as they will be in use. Over all places within a cell that is the loss of the whole image, at a
    sixteenth of the price.

    weights: float32 [33], what a pixel of each part counts. compiled: whether the network is compiled first, for every
    size of images anew.
    """

    weights: torch.Tensor

    def __init__(self, network: nn.Module, weights: torch.Tensor, loss_stride: int = 1, compiled: bool = False) -> None:
        super().__init__()
        self.network, self.loss_stride = network, loss_stride
        self._ask = torch.compile(_scores, dynamic=False) if compiled else _scores
        self.register_buffer("weights", weights)

    def forward(self, range_m: torch.Tensor, labels: torch.Tensor, place: torch.Tensor) -> Outcome:
        """range_m: float32 [B, 1, H, W]; labels: uint8 [B, H, W]; place: float [2], from 0 to below 1, down and across.

        The loss is the mean over images of each image's mean over its body, which is 0 for an image without one. So it
        is the same however a batch is cut up, between processes or into turns.
        """
        pixels = (  # as tensors, not slices: compiled code would be made anew for each place at which a slice begins
            torch.arange(side, device=range_m.device)[int(part * self.loss_stride) :: self.loss_stride]
            for part, side in zip(place.tolist(), labels.shape[1:], strict=True)
        )
        scores, step = self._ask(self.network, range_m, *pixels)
        scores, apart = scores.float(), max(step, self.loss_stride)
        row, column = (int(part * apart) for part in place.tolist())
        truth = labels[:, row::apart, column::apart].long()
        if step > 1:
            scores = shifted(shifted(scores, (row + 0.5) / step - 0.5, 2), (column + 0.5) / step - 0.5, 3)
        scores = scores[:, :, : truth.shape[1], : truth.shape[2]]
        body = truth != BACKGROUND
        each = F.cross_entropy(scores, truth, self.weights, ignore_index=BACKGROUND, reduction="none")
        weight = torch.where(body, self.weights[truth.clamp(max=PART_COUNT - 1)], 0.0)
        loss = (each.sum((1, 2)) / weight.sum((1, 2)).clamp(min=1e-6)).mean()
        with torch.no_grad():
            pairs = truth[body] * PART_COUNT + scores.argmax(1)[body]
            counts = torch.bincount(pairs, minlength=PART_COUNT**2).reshape(PART_COUNT, PART_COUNT)
        return Outcome(loss, counts)


def _scores(
    network: nn.Module, range_m: torch.Tensor, rows: torch.Tensor, columns: torch.Tensor
) -> tuple[torch.Tensor, int]:
    """As `coarse`; where there is a score for every pixel of the image, those at `rows` and `columns` only."""
    if isinstance(network, FcnAlexnet):
        return network(range_m, rows, columns), 1
    scores, step = coarse(network, range_m)
    return (scores if step > 1 else scores[:, :, rows][..., columns]), step


def shifted(scores: torch.Tensor, by: float, axis: int) -> torch.Tensor:
    """Scores interpolated `by` cells further along an axis, -1 < by < 1; the edge goes on for ever."""
    if by == 0:
        return scores
    size = scores.shape[axis]
    if by > 0:
        neighbour = torch.cat([scores.narrow(axis, 1, size - 1), scores.narrow(axis, size - 1, 1)], axis)
    else:
        neighbour = torch.cat([scores.narrow(axis, 0, 1), scores.narrow(axis, 0, size - 1)], axis)
    return scores.lerp(neighbour, abs(by))


def part_weights(counts: np.ndarray[tuple[int], np.dtype[np.int64]], balance: float) -> torch.Tensor:
    """float32 [33]: the share of all pixels that a part has, to the power of -balance, scaled to a mean pixel of 1.

    Parts that were not counted weigh as much as the rarest that was.
    """
    shares = np.maximum(counts, counts[counts > 0].min() if counts.any() else 1).astype(np.float64)
    shares /= shares.sum()
    weights = shares**-balance
    return torch.from_numpy((weights / (weights * shares).sum()).astype(np.float32))
