"""The pixels of bodies that one step of a training looks at, and a network's scores at them."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any, Final, Self

import torch

from bodyseg_data.core.parts import BACKGROUND
from bodyseg_model.networks.input.looped import in_loops

_BITS: Final = {torch.float32: torch.uint32, torch.bfloat16: torch.uint16}
"""Types of scores that the compiled loops know, and of their bits."""


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
        if scores.dtype in _BITS and in_loops(scores):
            interpolated: torch.Tensor = _Interpolated.apply(  # type: ignore[no-untyped-call]
                scores, self.image, places, shares
            )
            return interpolated
        # Rows of one table, not four selections: the gradient of each would fill a tensor of all scores.
        table = scores.permute(0, 2, 3, 1).flatten(0, 2)
        cells = torch.stack([(self.image * rows + row) * columns + column for row, column in places])
        corners = table.index_select(0, cells.flatten()).reshape(*cells.shape, scores.shape[1])
        found: torch.Tensor = (corners * shares[..., None]).sum(0)
        return found


class _Interpolated(torch.autograd.Function):
    """The same bits, and bits of gradients, by compiled loops: PyTorch passes over four points' scores a pixel."""

    @staticmethod
    def forward(
        context: Any, scores: torch.Tensor, image: torch.Tensor, places: list[tuple[Any, Any]], shares: torch.Tensor
    ) -> torch.Tensor:
        if scores.stride(1) != 1:
            scores = scores.contiguous(memory_format=torch.channels_last)
        by_image, _, by_row, by_column = scores.stride()
        starts = torch.stack([image * by_image + row * by_row + column * by_column for row, column in places])
        reach = 1 + sum((size - 1) * stride for size, stride in zip(scores.shape, scores.stride(), strict=True))
        table = scores.as_strided((reach,), (1,)).view(_BITS[scores.dtype])
        found = torch.empty(len(image), scores.shape[1])
        loops = import_module("bodyseg_model.training.objective.interpolation_loops")
        loops.interpolate(table.numpy(), starts.numpy(), shares.numpy(), found.numpy())
        context.save_for_backward(starts, shares, torch.bincount(image, minlength=len(scores)).cumsum(0))
        context.scores = reach, scores.shape, scores.stride(), scores.dtype
        return found

    @staticmethod
    def backward(context: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None, None, None]:
        starts, shares, ends = context.saved_tensors
        reach, shape, strides, dtype = context.scores
        found = torch.empty(shape[0] * strides[0] if shape[0] > 1 else reach, dtype=dtype)
        arrays = (each.numpy() for each in (gradients[0].contiguous(), starts, shares, ends))
        loops = import_module("bodyseg_model.training.objective.interpolation_loops")
        loops.add_gradient(*arrays, found.view(_BITS[dtype]).numpy())
        return found.as_strided(shape, strides), None, None, None


def _neighbours(pixel: torch.Tensor, step: int, size: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Scores before and after pixels along an axis, int64 [N], and the share of those after, float32 [N].

    Score i is at (i + 1/2) step from the edge, a pixel's centre 1/2 from its own; beyond the outermost of `size` scores
    that one's value holds.
    """
    place = ((pixel.float() + 0.5) / step - 0.5).clamp(0, size - 1)
    before = place.long()
    return before, (before + 1).clamp(max=size - 1), place - before
