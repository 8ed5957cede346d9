"""A small network for one job: range image -> 33 parts.

What it leaves out is what a person in a range image does not need. Its first layer looks at patches of 16 x 16 pixels
at once, so that nothing is computed at full resolution but nothing is thrown away either: noise and missing pixels are
averaged by filters that are learned. All other layers work where a cell is 16 to 64 pixels wide, since a part is told
by where it is in the body. Every cell answers for 4 x 4 places within it, and between those answers are interpolated.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Final

import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from torch import nn

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.parts import PART_COUNT
from bodyseg_model.networks.range_input import check_range_images

_RELIEF: Final = 2.0  # centred ranges are a few decimetres, and layers learn best from numbers near one


@dataclass(frozen=True)
class CompactSettings:
    """Shape of the network.

    patch: pixels along one side of what the first layer sees at once; even. widths: channels at 1 / patch,
    1 / (2 patch) ... of the resolution. blocks: residual blocks at each. context: whether every
    place also learns the mean over the whole body. shrink: pixels along one side of a square that is averaged to one
    before anything else, 1 for the image as it is.
    """

    patch: int = 16
    widths: tuple[int, ...] = (96, 128, 144)
    blocks: tuple[int, ...] = (2, 2, 1)
    context: bool = True
    shrink: int = 1

    def __post_init__(self) -> None:
        if self.patch not in (2, 4, 8, 16):
            raise BadConfig(f"patch must be 2, 4, 8 or 16, found {self.patch!r}")
        if self.shrink not in (1, 2, 4):
            raise BadConfig(f"shrink must be 1, 2 or 4, found {self.shrink!r}")
        if not 1 <= len(self.widths) <= 6 or any(not 1 <= width <= 2048 for width in self.widths):
            raise BadConfig(f"widths must be 1 to 6 numbers from 1 to 2048, found {self.widths!r}")
        if len(self.blocks) != len(self.widths) or any(not 0 <= count <= 32 for count in self.blocks):
            raise BadConfig(
                f"blocks must be numbers from 0 to 32, one for each of {len(self.widths)} widths, found {self.blocks!r}"
            )


class Compact(nn.Module):
    """Range image -> scores of the 33 parts, at the image's own size, whatever it is.

    The input is what was measured and where: each pixel's range less the mean over the body, and whether there is one.
    Distance itself does not enter, so a person may stand anywhere; his size in pixels does.
    """

    stride: Final = 4
    """Pixels of the image between two answers of `coarse`."""

    margin: Final = 64
    """Empty pixels around a body after which more of them hardly matter."""

    def __init__(self, settings: CompactSettings | None = None) -> None:
        super().__init__()
        self.settings = settings or CompactSettings()
        patch, widths, blocks = self.settings.patch, self.settings.widths, self.settings.blocks
        self.embed = _layer(2 * patch * patch, widths[0], 1)
        self.down = nn.ModuleList(
            nn.Sequential(
                *([_layer(widths[level - 1], width, 3, 2)] if level else []),
                *(_Block(width) for _ in range(blocks[level])),
            )
            for level, width in enumerate(widths)
        )
        self.context = nn.Conv2d(widths[-1], widths[-1], 1) if self.settings.context else None
        pairs = list(itertools.pairwise(widths))
        self.narrow = nn.ModuleList(_layer(deep, shallow, 1) for shallow, deep in pairs)
        self.fuse = nn.ModuleList(_layer(shallow, shallow, 3) for shallow, _ in pairs)
        self._cell = patch * self.settings.shrink
        self._fine = max(1, self._cell // self.stride)
        self.head = nn.Conv2d(widths[0], PART_COUNT * self._fine**2, 1)

    def coarse(self, range_m: torch.Tensor) -> torch.Tensor:
        """Scores (logits) of every fourth pixel each way, float [B, 33, ceil(H / 4), ceil(W / 4)].

        Answer (i, j) is that of the point (4 i + 2, 4 j + 2) of the image, in pixels from its corner.
        range_m: as in `forward`.
        """
        check_range_images(range_m)
        rows, columns = range_m.shape[2:]
        relief = F.pad(relief_of(range_m), (0, -columns % self._cell, 0, -rows % self._cell))
        if self.settings.shrink > 1:
            relief = shrunk(relief, self.settings.shrink)
        x = F.pixel_unshuffle(relief, self.settings.patch).contiguous(memory_format=torch.channels_last)
        x = self.embed(x)
        seen = []
        for stage in self.down:
            x = stage(x)
            seen.append(x)
        if self.context is not None:
            x = x + self.context(_mean_over_body(x, relief[:, 1:], self.settings.patch << (len(seen) - 1)))
        for narrow, fuse, level in reversed(list(zip(self.narrow, self.fuse, seen, strict=False))):
            x = fuse(level + F.interpolate(narrow(x), size=level.shape[-2:], mode="nearest"))
        x = F.pixel_shuffle(self.head(x), self._fine) if self._fine > 1 else self.head(x)
        if self._cell < self.stride:
            x = F.avg_pool2d(x, self.stride // self._cell, ceil_mode=True)
        return x[:, :, : -(-rows // self.stride), : -(-columns // self.stride)]

    def forward(self, range_m: torch.Tensor) -> torch.Tensor:
        """Scores (logits), float [B, 33, H, W], of range images in metres, float [B, 1, H, W], 0 = nothing measured.

        Raises BadConfig for any other shape.
        """
        coarse = self.coarse(range_m)
        rows, columns = range_m.shape[2:]
        full = F.interpolate(coarse, scale_factor=self.stride, mode="bilinear", align_corners=False)
        return full[:, :, :rows, :columns]


def relief_of(range_m: torch.Tensor) -> torch.Tensor:
    """[B, 2, H, W]: range less its mean over what was measured, scaled; and whether it was measured.

    Added up in float32 whatever comes in: the ranges of a body are too many for float16.
    """
    metres, measured = range_m.float(), (range_m > 0).float()
    count = measured.sum((1, 2, 3), keepdim=True).clamp(min=1)
    mean = metres.sum((1, 2, 3), keepdim=True) / count
    return torch.cat([(metres - mean) * measured * _RELIEF, measured], 1).to(range_m.dtype)


def shrunk(relief: torch.Tensor, side: int) -> torch.Tensor:
    """Means over squares: of what was measured in them, and of how much was."""
    mean = F.avg_pool2d(relief, side)
    return torch.cat([mean[:, :1] / mean[:, 1:].clamp(min=1 / side**2), mean[:, 1:]], 1)


def _mean_over_body(x: torch.Tensor, measured: torch.Tensor, cell: int) -> torch.Tensor:
    """Mean of [B, C, h, w] over its cells, [B, C, 1, 1], each weighing as much as was measured in it: how much empty
    space lies around a body must not matter. measured: [B, 1, H, W]; cell: pixels along one side of a cell.
    """
    weight = F.avg_pool2d(measured, cell, ceil_mode=True, count_include_pad=False)
    return (x * weight).sum((2, 3), keepdim=True) / weight.sum((2, 3), keepdim=True).clamp(min=1e-6)


def _layer(inputs: int, outputs: int, size: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(_convolution(inputs, outputs, size, stride), nn.ReLU(inplace=True))


def _convolution(inputs: int, outputs: int, size: int, stride: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, size, stride, size // 2, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs))


class _Block(nn.Module):
    """Two convolutions beside a shortcut (He et al., "Deep residual learning for image recognition", 2016)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = _layer(width, width, 3)
        self.second = _convolution(width, width, 3)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return F.relu(x + self.second(self.first(x)))
