"""Loss of a training step: cross-entropy over the pixels of the body, or over an even selection of them."""

from dataclasses import dataclass
from typing import Any, Final, NamedTuple, Self

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from numpy.typing import NDArray
from torch import nn

from bodyseg_data.labels import BACKGROUND
from bodyseg_data.loading import ImageSet
from bodyseg_model.networks import UNIT_M, Network, place_table

_SAMPLES_FOR_WEIGHTS: Final = 128
PLACE_WEIGHT: Final = 1.0
"""Weight of a pixel's error of place, the sum of its three coordinates', against its cross-entropy."""


@dataclass(frozen=True)
class SelectedPixels:
    """N pixels of the bodies in B images: of every cell of stride x stride pixels the one at the same offset.

    image, row, column: int64 [N], place of each pixel, row and column in pixels of the image. truth: int64 [N], its
    class.

    Scores are computed at these alone, since most pixels of an image show no body.
    """

    image: torch.Tensor
    row: torch.Tensor
    column: torch.Tensor
    truth: torch.Tensor

    @classmethod
    def of(cls, labels: torch.Tensor, row: int, column: int, stride: int) -> Self:
        """Select in labels, uint8 [B, H, W]: `row` and `column` are the offset in the cells, pixels."""
        cells = labels[:, row::stride, column::stride]
        image, down, across = (cells != BACKGROUND).nonzero(as_tuple=True)
        return cls(image, down * stride + row, across * stride + column, cells[image, down, across].long())

    def of_cells(self, scores: torch.Tensor, stride: int) -> torch.Tensor:
        """Scores of these pixels, float32 [N, C], from the scores of the selected pixel of each cell [B, C, h, w]."""
        return scores.permute(0, 2, 3, 1)[self.image, self.row // stride, self.column // stride].float()

    def interpolated(self, scores: torch.Tensor, step: int) -> torch.Tensor:
        """Scores at these pixels, float32 [N, C], interpolated bilinearly as `Network.forward` interpolates.

        scores: float [B, C, h, w], `step` pixels apart each way, as `Network.scores` gives them.
        """
        rows, columns = scores.shape[2:]
        top, bottom, down = _neighbours(self.row, step, rows)
        left, right, across = _neighbours(self.column, step, columns)
        shares = torch.stack([(1 - down) * (1 - across), (1 - down) * across, down * (1 - across), down * across])
        places = [(row, column) for row in (top, bottom) for column in (left, right)]
        # Rows of one table, not four selections: the gradient of each would fill a tensor of all scores.
        table = scores.permute(0, 2, 3, 1).flatten(0, 2)
        cells = torch.stack([(self.image * rows + row) * columns + column for row, column in places])
        corners = table.index_select(0, cells.flatten()).reshape(*cells.shape, scores.shape[1])
        return (corners * shares[..., None]).sum(0)


def _neighbours(pixel: torch.Tensor, step: int, size: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Scores before and after pixels along an axis, int64 [N], and the share of those after, float32 [N].

    Score i is at (i + 1/2) step from the edge, a pixel's centre 1/2 from its own; beyond the outermost of `size` scores
    that one's value holds.
    """
    place = ((pixel.float() + 0.5) / step - 0.5).clamp(0, size - 1)
    before = place.long()
    return before, (before + 1).clamp(max=size - 1), place - before


class LossAndCounts(NamedTuple):
    """Result of a step.

    loss: scalar. counts: int64 [C, C], confusion matrix of the selected pixels, rows truth, columns prediction.
    off_mm: scalar, mean distance between predicted and true places, mm; None of a network without places.
    """

    loss: torch.Tensor
    counts: torch.Tensor
    off_mm: torch.Tensor | None = None


class NetworkWithLoss(nn.Module):
    """A network and its loss as one module, as distributed training wraps it.

    Softmax cross-entropy over the C classes, background ignored (section 3.5). A step selects one pixel of every cell
    of stride x stride pixels, where stride is the larger of `loss_stride` and the network's output stride: the pixels
    at the same offset in all cells, with scores interpolated there as in `predict`. Over all offsets every pixel is
    selected once; a stride of 4 makes a sixteenth of the cost.

    A network with places on the template adds the robust error of these, the sum of the absolute ones of three
    coordinates, where the place of a pixel is known.

    weights: float32 [C], weight of a pixel of each class.
    """

    weights: torch.Tensor
    places: torch.Tensor

    def __init__(self, network: Network, weights: torch.Tensor, loss_stride: int = 1) -> None:
        super().__init__()
        self.network, self.loss_stride = network, loss_stride
        self.register_buffer("weights", weights)
        if network.on_template:
            self.register_buffer("places", F.pad(torch.from_numpy(place_table()), (0, 0, 1, 0)), persistent=False)

    def forward(
        self, range_m: torch.Tensor, labels: torch.Tensor, offset: torch.Tensor, numbers: torch.Tensor | None = None
    ) -> LossAndCounts:
        """Compute the loss, the mean over images of each image's weighted mean over its body; 0 without a body.

        It does not depend on how a batch is divided, between processes or for accumulation. range_m: float32
        [B, 1, H, W], metres; labels: uint8 [B, H, W]; offset: float [2], position of the selected pixels in their
        cells, down and across, as shares of a cell from 0 to below 1. numbers: of a network with places,
        `augmentation.signed_numbers`, float32 [B, 1, H, W].
        """
        rows, columns = (
            torch.arange(side, device=range_m.device)[int(share * self.loss_stride) :: self.loss_stride]
            for share, side in zip(offset.tolist(), labels.shape[1:], strict=True)
        )
        step = self.network.output_stride  # above 1: all scores are taken, else those of the selected pixels
        if numbers is not None:
            scores = self.network.scores_and_places(range_m)
            scores = scores if step > 1 else scores[:, :, rows][..., columns]
        else:
            scores = self.network.scores(range_m) if step > 1 else self.network.scores_at(range_m, rows, columns)
        stride, images, classes = max(step, self.loss_stride), len(labels), len(self.weights)
        row, column = (int(share * stride) for share in offset.tolist())
        chosen = SelectedPixels.of(labels, row, column, stride)
        at_pixels = chosen.interpolated(scores, step) if step > 1 else chosen.of_cells(scores, stride)
        at_pixels, found = at_pixels[:, :classes], at_pixels[:, classes:]
        each, off_mm = F.cross_entropy(at_pixels, chosen.truth, reduction="none"), None
        if numbers is not None:
            off, known = self._off(found, numbers[chosen.image, 0, chosen.row, chosen.column])
            each = each + PLACE_WEIGHT * off.abs().sum(1)
            off_mm = off.detach().norm(dim=1).sum() * (1000 * UNIT_M) / known.sum().clamp(min=1)
        weight = self.weights[chosen.truth]
        each = weight * each
        sums, weights = (each.new_zeros(images).index_add(0, chosen.image, values) for values in (each, weight))
        with torch.no_grad():
            pairs = chosen.truth * classes + at_pixels.argmax(1)
            counts = torch.bincount(pairs, minlength=classes**2).reshape(classes, classes)
        return LossAndCounts((sums / weights.clamp(min=1e-6)).mean(), counts, off_mm)

    def _off(self, found: torch.Tensor, number: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Errors of places [N, 3], 0 where the true one is unknown, and where it is known, bool [N].

        number: `augmentation.signed_numbers` of N pixels.
        """
        known, true = number != 0, self.places[number.abs().long()]
        true[:, 0] *= number.sign()
        return (found - true) * known[:, None], known


def part_weights(counts: NDArray[Any], balance: float) -> torch.Tensor:
    """Weights of the classes, float32 [C]: each class's share of all pixels to the power of -balance, scaled so that
    the mean weight of a pixel is 1.

    counts: int64 or float64 [C], pixels of each class, not all 0. Classes without one weigh as the rarest with one.
    """
    shares = np.maximum(counts, counts[counts > 0].min()).astype(np.float64)
    shares /= shares.sum()
    weights = shares**-balance
    return torch.from_numpy((weights / (weights * shares).sum()).astype(np.float32))


def class_pixels(images: ImageSet) -> NDArray[np.float64]:
    """Mean number of pixels of each class, [C], in clean samples spread evenly over the set."""
    counts = np.zeros(256, np.int64)
    ends = np.cumsum([len(each) for each in images.sets])  # sets of a mixture may come to its classes by other maps
    for index in (chosen := images.evenly_sampled(_SAMPLES_FOR_WEIGHTS).tolist()):
        table = images.sets[int(np.searchsorted(ends, index, "right"))].label_map.table
        counts += np.bincount(table[images.clean(index).labels.ravel()], minlength=256)
    return counts[: len(images.label_map)] / len(chosen)
