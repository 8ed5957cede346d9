"""Data sets of users around range images, in a module that spawned workers can import."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch.utils.data import Dataset

from bodyseg_data import RangeImages


class Pairs(Dataset[tuple[torch.Tensor, torch.Tensor]]):
    """A data set of a user's own around the images; alter: what it does to a range."""

    def __init__(self, images: RangeImages, alter: Callable[[torch.Tensor], torch.Tensor] | None = None) -> None:
        self.images, self.alter = images, alter

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        sample = self.images[index]
        return sample["range"] if self.alter is None else self.alter(sample["range"]), sample["labels"]
