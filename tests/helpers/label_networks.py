"""Networks that need no training: their answers follow from where a pixel is."""

from __future__ import annotations

import math

import torch

from bodyseg_data.labels import PART_COUNT
from bodyseg_model.networks import Network


class Places(Network):
    """Label: the row (axis 0) in steps of `step` pixels from the top, or the column (axis 1) from the left. Confidence:
    nearly 1 where the range is at most `sure_m`, 0.52 beyond. `seen` keeps the images that it was shown.
    """

    def __init__(self, axis: int, step: int, sure_m: float = 100.0) -> None:
        super().__init__()
        self.axis, self.step, self.sure_m = axis, step, sure_m
        self.seen: list[torch.Tensor] = []
        self.eval()

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        self.seen.append(range_m)
        size = range_m.shape[2 + self.axis]
        label = (torch.arange(size) // self.step).clamp(max=PART_COUNT - 1)
        label = label[:, None] if self.axis == 0 else label[None]
        # Classes last in memory, as whoever reads scores has them: moving them there takes longer than all else.
        scores = torch.zeros(len(range_m), *range_m.shape[2:], PART_COUNT)
        # With 33 parts, a score of ln 32 + 0.1 makes 52 %.
        high = torch.where(range_m[:, 0] > self.sure_m, 3.5657, 20.0)
        return scores.scatter_(3, label.expand(high.shape)[..., None], high[..., None]).permute(0, 3, 1, 2)


class Nearer(Network):
    """A finder that takes what is nearer than `limit_m` metres for a person, as sure as `sure` (0.5 to 1)."""

    def __init__(self, limit_m: float = 3.5, focal_px: float = 100.0, sure: float = 0.999) -> None:
        super().__init__({"focal_px": focal_px}, 2)
        self.limit_m, self.odds = limit_m, math.log(sure / (1 - sure))
        self.seen: list[torch.Tensor] = []
        self.eval()

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        self.seen.append(range_m)
        person = torch.where(range_m < self.limit_m, self.odds, -self.odds)
        return torch.cat([person, torch.zeros_like(person)], 1)
