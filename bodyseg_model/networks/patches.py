"""Range images as networks see them: checked, centred, averaged, and cut into the patches that `compact` reads.

In PyTorch's operations, which GPUs need, every step of cutting, from centring to laying out, passes over all pixels of
all images. `patch_loops` pass over them twice, image by image, to the same bits: 0.4 instead of 1.1 ms an image of
640 x 329 pixels, of some 7 that a network in bfloat16 takes.
"""

from __future__ import annotations

from importlib import import_module
from typing import Final, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.kernels import use_compiled

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


def in_loops(tensor: torch.Tensor) -> bool:
    """True if compiled loops compute on a tensor instead of PyTorch's operations, with the same bits: on a processor,
    where numba is installed.
    """
    return tensor.device.type == "cpu" and use_compiled()


class Patches(NamedTuple):
    """Images in cells of `side` pixels, rows and columns rounded up to whole cells.

    values: [B, 2 side^2, h, w], channels last in memory: of each cell the centred ranges, row by row, and then 1 where
    something was measured, else 0. float32, or the type in which layers compute under autocast. measured: float
    [B, 1, h, w], share of each cell's pixels that were measured.
    """

    values: torch.Tensor
    measured: torch.Tensor


def patches_of(range_m: torch.Tensor, side: int, shrink: int = 1) -> Patches:
    """Cut range images [B, 1, H, W] into patches; shrink: pixels along one side of the squares averaged first."""
    kind = range_m.device.type
    layers = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else range_m.dtype
    if shrink == 1 and _fits_loops(range_m, layers):
        return _by_loops(range_m, side, layers)
    cell, (rows, columns) = side * shrink, range_m.shape[2:]
    relief = F.pad(relief_of(range_m), (0, -columns % cell, 0, -rows % cell))
    if shrink > 1:
        relief = shrunk(relief, shrink)
    # Layers would convert after copies of twice the size.
    return Patches(_unshuffled(relief.to(layers), side), F.avg_pool2d(relief[:, 1:], side))


def _fits_loops(range_m: torch.Tensor, layers: torch.dtype) -> bool:
    """True if numbers are asked for, not a graph or gradients, of types and on a device that the loops know."""
    if torch.compiler.is_compiling() or torch.onnx.is_in_onnx_export() or range_m.requires_grad:
        return False
    return range_m.dtype == torch.float32 and layers in (torch.float32, torch.bfloat16) and in_loops(range_m)


def _by_loops(range_m: torch.Tensor, side: int, layers: torch.dtype) -> Patches:
    loops = import_module("bodyseg_model.networks.patch_loops")
    images, _, rows, columns = range_m.shape
    cells = images, -(-rows // side), -(-columns // side)
    values = torch.empty((*cells, 2 * side**2), dtype=layers)
    measured = torch.empty(cells)
    bits = values.view(torch.int16 if layers == torch.bfloat16 else torch.int32).numpy()
    metres, count = range_m[:, 0].contiguous().numpy(), torch.empty(images, 1, 1, 1)
    loops.count_measured(metres, count.view(images).numpy())
    mean = body_mean(range_m, count).view(images)
    loops.cut_patches(metres, mean.numpy(), np.float32(RELIEF), side, bits, measured.numpy())
    return Patches(values.permute(0, 3, 1, 2), measured[:, None])


def _unshuffled(x: torch.Tensor, side: int) -> torch.Tensor:
    """`F.pixel_unshuffle`, [B, C, H, W] -> [B, C side^2, H / side, W / side]: one copy, laid out as layers want it."""
    if torch.onnx.is_in_onnx_export():  # graphs have one operation for it
        return F.pixel_unshuffle(x, side)
    batch, channels, rows, columns = x.shape
    parts = x.reshape(batch, channels, rows // side, side, columns // side, side).permute(0, 2, 4, 1, 3, 5)
    return parts.reshape(batch, rows // side, columns // side, channels * side**2).permute(0, 3, 1, 2)
