"""Patches of `relief.relief_of`, which the first layer of `compact` reads: compiled where that is possible.

In PyTorch's operations every step, from centring to laying out, passes over all pixels of all images. The compiled form
passes over them twice, image by image, to the same bits: 0.4 instead of 1.1 ms an image of 640 x 329 pixels, of some 7
that a network in bfloat16 takes.
"""

from __future__ import annotations

from importlib import import_module
from typing import NamedTuple

import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere

from bodyseg_model.networks.input.looped import in_loops
from bodyseg_model.networks.input.relief import body_mean, relief_of, shrunk


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
    loops = import_module("bodyseg_model.networks.input.patch_loops")
    images, _, rows, columns = range_m.shape
    cells = images, -(-rows // side), -(-columns // side)
    values = torch.empty((*cells, 2 * side**2), dtype=layers)
    measured = torch.empty(cells)
    bits = values.view(torch.int16 if layers == torch.bfloat16 else torch.int32).numpy()
    metres, count = range_m[:, 0].contiguous().numpy(), torch.empty(images, 1, 1, 1)
    loops.count_measured(metres, count.view(images).numpy())
    mean = body_mean(range_m, count).view(images)
    loops.cut_patches(metres, mean.numpy(), side, bits, measured.numpy())
    return Patches(values.permute(0, 3, 1, 2), measured[:, None])


def _unshuffled(x: torch.Tensor, side: int) -> torch.Tensor:
    """`F.pixel_unshuffle`, [B, C, H, W] -> [B, C side^2, H / side, W / side]: one copy, laid out as layers want it."""
    if torch.onnx.is_in_onnx_export():  # graphs have one operation for it
        return F.pixel_unshuffle(x, side)
    batch, channels, rows, columns = x.shape
    parts = x.reshape(batch, channels, rows // side, side, columns // side, side).permute(0, 2, 4, 1, 3, 5)
    return parts.reshape(batch, rows // side, columns // side, channels * side**2).permute(0, 3, 1, 2)
