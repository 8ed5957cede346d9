"""Samples through PyTorch's own DataLoader: the bits of the loader, in tensors like any."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch.utils.data import DataLoader

from bodyseg_data import RangeImages, loader


@pytest.mark.parametrize("workers", [0, 2])
def test_its_batches_have_the_bits_of_the_loaders(small_set: Path, workers: int) -> None:
    images = RangeImages(small_set, "all")
    (whole,) = loader(images, len(images), shuffle=False)
    for number, batch in enumerate(DataLoader(images, 8, num_workers=workers)):
        part = slice(8 * number, 8 * number + 8)
        assert torch.equal(batch["range"], whole["range"][part]) and torch.equal(batch["labels"], whole["labels"][part])
        assert batch["key"] == whole["key"][part]
        assert type(batch["range"]) is type(batch["labels"]) is torch.Tensor
        batch["range"].zero_()  # which may be written to
