"""Range images as networks see them: in metres, checked, centred and averaged."""

from __future__ import annotations

from typing import Final

import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere

from bodyseg_data.core.errors import BadConfig

RELIEF: Final = 2.0
"""Factor of centred ranges: they are a few decimetres, and layers learn best from numbers near one."""


def check_range_images(range_m: torch.Tensor) -> None:
    """Raise BadConfig unless `range_m` is [B, 1, H, W] and not empty."""
    if range_m.ndim != 4 or range_m.shape[1] != 1 or not range_m.numel():
        raise BadConfig(f"range images must be [B, 1, H, W], found {list(range_m.shape)}")


def relief_of(range_m: torch.Tensor) -> torch.Tensor:
    """Input of two channels, [B, 2, H, W]: range less its mean over what was measured, scaled; and 1 where measured.

    range_m: float [B, 1, H, W], metres, 0 = nothing measured. Sums are in float32 whatever the input's type: the ranges
    of a body are too many for float16.
    """
    metres, measured = range_m.float(), (range_m > 0).float()
    mean = body_mean(metres, measured.sum((1, 2, 3), keepdim=True))
    return torch.cat([(metres - mean) * measured * RELIEF, measured], 1).to(range_m.dtype)


def body_mean(metres: torch.Tensor, count: torch.Tensor) -> torch.Tensor:
    """Mean of what was measured in each image, float32 [B, 1, 1, 1], metres; 0 where nothing was.

    metres: float32 [B, 1, H, W], 0 = nothing measured. count: float32 [B, 1, 1, 1], measured pixels.
    """
    return metres.sum((1, 2, 3), keepdim=True) / count.clamp(min=1)


def shrunk(relief: torch.Tensor, side: int) -> torch.Tensor:
    """Average `relief_of` over squares of `side` pixels, [B, 2, h, w]: the ranges measured in each, and their share."""
    mean = F.avg_pool2d(relief, side)
    return torch.cat([mean[:, :1] / mean[:, 1:].clamp(min=1 / side**2), mean[:, 1:]], 1)
