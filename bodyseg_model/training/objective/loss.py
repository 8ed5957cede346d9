"""Loss of a training step: cross-entropy over the pixels of the body, or over an even selection of them."""

from __future__ import annotations

from typing import Final, NamedTuple, Protocol

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from numpy.typing import NDArray
from torch import nn

from bodyseg_data.loading.image_set import ImageSet
from bodyseg_model.networks.network import Network
from bodyseg_model.training.objective.selected_pixels import SelectedPixels

TEMPERATURE: Final = 2.0
"""Of distillation: scores of both networks are divided by it before their softmax, so that classes other than the best
one count, too."""

_SAMPLES_FOR_WEIGHTS: Final = 128


class LossTeacher(Protocol):
    """A teacher as the loss calls it; see `distillation.Teacher`. share: its share of the loss."""

    @property
    def share(self) -> float: ...

    def __call__(self, range_m: torch.Tensor, pixels: SelectedPixels) -> torch.Tensor: ...


class LossAndCounts(NamedTuple):
    """Result of a step.

    loss: scalar. counts: int64 [C, C], confusion matrix of the selected pixels, rows truth, columns prediction.
    """

    loss: torch.Tensor
    counts: torch.Tensor


class NetworkWithLoss(nn.Module):
    """A network and its loss as one module, as distributed training wraps it.

    Softmax cross-entropy over the C classes, background ignored (section 3.5). A step selects one pixel of every cell
    of stride x stride pixels, where stride is the larger of `loss_stride` and the network's output stride: the pixels
    at the same offset in all cells, with scores interpolated there as in `predict`. Over all offsets every pixel is
    selected once; a stride of 4 makes a sixteenth of the cost.

    weights: float32 [C], weight of a pixel of each class. compiled: whether the network is compiled first, anew for
    every size of images. teacher: the divergence of the network's probabilities from its own is a share of the loss
    (`divergence`); None for the cross-entropy alone.
    """

    weights: torch.Tensor

    def __init__(
        self,
        network: Network,
        weights: torch.Tensor,
        loss_stride: int = 1,
        compiled: bool = False,
        teacher: LossTeacher | None = None,
    ) -> None:
        super().__init__()
        self.network, self.loss_stride = network, loss_stride
        self.teacher = teacher
        self._scores = torch.compile(_scores, dynamic=False) if compiled else _scores
        self.register_buffer("weights", weights)

    def extra_repr(self) -> str:
        """Stride of the selected pixels, for `repr`."""
        return f"loss_stride={self.loss_stride}"

    def forward(self, range_m: torch.Tensor, labels: torch.Tensor, offset: torch.Tensor) -> LossAndCounts:
        """Compute the loss, the mean over images of each image's weighted mean over its body; 0 without a body.

        It does not depend on how a batch is divided, between processes or for accumulation. range_m: float32
        [B, 1, H, W], metres; labels: uint8 [B, H, W]; offset: float [2], position of the selected pixels in their
        cells, down and across, as shares of a cell from 0 to below 1.
        """
        pixels = (  # as tensors, not slices: compiled code would be made anew for each pixel at which a slice begins
            torch.arange(side, device=range_m.device)[int(share * self.loss_stride) :: self.loss_stride]
            for share, side in zip(offset.tolist(), labels.shape[1:], strict=True)
        )
        scores, step = self._scores(self.network, range_m, *pixels), self.network.output_stride
        stride, images, classes = max(step, self.loss_stride), len(labels), len(self.weights)
        row, column = (int(share * stride) for share in offset.tolist())
        chosen = SelectedPixels.of(labels, row, column, stride)
        at_pixels = chosen.interpolated(scores, step) if step > 1 else chosen.of_cells(scores, stride)
        weight = self.weights[chosen.truth]
        each = weight * F.cross_entropy(at_pixels, chosen.truth, reduction="none")
        if self.teacher is not None:
            taught = divergence(at_pixels, self.teacher(range_m, chosen))
            each = (1 - self.teacher.share) * each + self.teacher.share * weight * taught
        sums, weights = (each.new_zeros(images).index_add(0, chosen.image, values) for values in (each, weight))
        with torch.no_grad():
            pairs = chosen.truth * classes + at_pixels.argmax(1)
            counts = torch.bincount(pairs, minlength=classes**2).reshape(classes, classes)
        return LossAndCounts((sums / weights.clamp(min=1e-6)).mean(), counts)


def _scores(network: Network, range_m: torch.Tensor, rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
    """All scores of a network that are coarser than the image; else those at `rows` and `columns` only."""
    return network.scores(range_m) if network.output_stride > 1 else network.scores_at(range_m, rows, columns)


def divergence(scores: torch.Tensor, taught: torch.Tensor) -> torch.Tensor:
    """Kullback-Leibler divergence of a network's probabilities from its teacher's at `TEMPERATURE`, [N].

    scores: float32 [N, C]; taught: log-probabilities of the same shape. Multiplied by the square of the
    temperature, so that gradients are as large as those of the cross-entropy (Hinton, Vinyals and Dean, "Distilling the
    knowledge in a neural network", 2015, section 2).
    """
    learnt = (scores / TEMPERATURE).log_softmax(1)
    return TEMPERATURE**2 * (taught.exp() * (taught - learnt)).sum(1)


def part_weights(counts: NDArray[np.int64], balance: float) -> torch.Tensor:
    """Weights of the classes, float32 [C]: each class's share of all pixels to the power of -balance, scaled so that
    the mean weight of a pixel is 1.

    counts: int64 [C], pixels of each class. Classes without a pixel weigh as much as the rarest with any.
    """
    shares = np.maximum(counts, counts[counts > 0].min() if counts.any() else 1).astype(np.float64)
    shares /= shares.sum()
    weights = shares**-balance
    return torch.from_numpy((weights / (weights * shares).sum()).astype(np.float32))


def class_pixels(images: ImageSet) -> NDArray[np.int64]:
    """Pixels of each class, int64 [C], in clean samples spread evenly over the set."""
    label_map = images.label_map
    counts = np.zeros(len(label_map), np.int64)
    for index in images.evenly_sampled(_SAMPLES_FOR_WEIGHTS).tolist():
        counts += np.bincount(label_map.table[images.clean(index).labels.ravel()], minlength=256)[: len(label_map)]
    return counts
