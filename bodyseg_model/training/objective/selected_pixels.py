"""The pixels of bodies that one step of a training looks at, and a network's scores at them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch

from bodyseg_data.core.parts import BACKGROUND


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
        above, below = (self.image * rows + top) * columns, (self.image * rows + bottom) * columns
        places = torch.stack([above + left, above + right, below + left, below + right])
        shares = torch.stack([(1 - down) * (1 - across), (1 - down) * across, down * (1 - across), down * across])
        # Rows of one table, not four selections: the gradient of each would fill a tensor of all scores.
        table = scores.permute(0, 2, 3, 1).flatten(0, 2)
        corners = table.index_select(0, places.flatten()).reshape(*places.shape, scores.shape[1])
        found: torch.Tensor = (corners * shares[..., None]).sum(0)
        return found


def _neighbours(pixel: torch.Tensor, step: int, size: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Scores before and after pixels along an axis, int64 [N], and the share of those after, float32 [N].

    Score i is at (i + 1/2) step from the edge, a pixel's centre 1/2 from its own; beyond the outermost of `size` scores
    that one's value holds.
    """
    place = ((pixel.float() + 0.5) / step - 0.5).clamp(0, size - 1)
    before = place.long()
    return before, (before + 1).clamp(max=size - 1), place - before
