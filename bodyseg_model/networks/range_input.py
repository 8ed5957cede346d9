"""What every network takes: range images in metres."""

from __future__ import annotations

import torch

from bodyseg_data.core.errors import BadConfig


def check_range_images(range_m: torch.Tensor) -> None:
    """Raise BadConfig unless `range_m` is [B, 1, H, W] and not empty."""
    if range_m.ndim != 4 or range_m.shape[1] != 1 or not range_m.numel():
        raise BadConfig(f"range images must be [B, 1, H, W], found {list(range_m.shape)}")
