"""A small network for one task: range image -> parts.

Its first layer reads patches of 16 x 16 pixels, so nothing is computed at full resolution and no pixel is thrown away:
noise and missing pixels are averaged by learned filters. All other layers work on cells 16 to 64 pixels wide, since a
part is recognised by its position in the body. Every cell yields 4 x 4 scores; those in between are interpolated.
"""

import itertools
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, Self

import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from torch import nn

from bodyseg_data.core import BadConfig, check_fields
from bodyseg_data.labels import PART_COUNT
from bodyseg_model.networks.network import MEASURES, Network, check_range_images, metric_patches, patches_of


@dataclass(frozen=True)
class CompactSettings:
    """Shape of the network.

    patch: pixels along one side of a patch of the first layer, 2, 4, 8 or 16. widths: channels at 1 / patch,
    1 / (2 patch) ... of the resolution. blocks: residual blocks at each. context: whether every cell also gets the mean
    over the whole body. shrink: pixels along one side of the squares that are averaged first; 1 for none. focal_px: of
    the camera whose images the network sees with their true measures, for which a patch is a place in the room
    (`network.metric_patches`); 0 for images of one body, wherever it stands. template: whether a second head tells
    where on the template of the body each point lies (`Network.scores_and_places`). classes: see `Network`.
    """

    patch: Literal[2, 4, 8, 16] = 16
    widths: tuple[int, ...] = (96, 128, 144)
    blocks: tuple[int, ...] = (2, 2, 1)
    context: bool = True
    shrink: Literal[1, 2, 4] = 1
    focal_px: float = 0.0
    template: bool = False
    classes: int = PART_COUNT

    def __post_init__(self) -> None:
        check_fields(self)
        if self.focal_px and not (1 <= self.focal_px <= 1e6 and self.shrink == 1):
            raise BadConfig(
                f"focal_px must be 0, or 1 to 1e6 with a shrink of 1, found {self.focal_px!r} and {self.shrink!r}"
            )
        if not 1 <= len(self.widths) <= 6 or any(not 1 <= width <= 2048 for width in self.widths):
            raise BadConfig(f"widths must be 1 to 6 numbers from 1 to 2048, found {self.widths!r}")
        if len(self.blocks) != len(self.widths) or any(not 0 <= count <= 32 for count in self.blocks):
            raise BadConfig(
                f"blocks must be numbers from 0 to 32, one for each of {len(self.widths)} widths, found {self.blocks!r}"
            )


class Compact(Network):
    """Range images -> scores of the classes, for images of any size.

    The input has two channels (`network.relief_of`): each pixel's range less the mean over the body, and whether it was
    measured. The distance itself does not enter, so a person may stand anywhere; the size in pixels does. With
    `focal_px` the image is a whole room, and what a patch measures there enters instead.
    """

    output_stride: int = 4

    def __init__(self, settings: CompactSettings | None = None) -> None:
        shape = settings or CompactSettings()
        plain = {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(shape).items()}
        left_out = {"classes", *(name for name in ("focal_px", "template") if not plain[name])}
        super().__init__({name: value for name, value in plain.items() if name not in left_out}, shape.classes)
        patch, widths, blocks = shape.patch, shape.widths, shape.blocks
        self.embed = _layer(2 * patch * patch + (MEASURES if shape.focal_px else 0), widths[0], 1)
        self.down = nn.ModuleList(
            nn.Sequential(
                *([_layer(widths[level - 1], width, 3, 2)] if level else []),
                *(_Block(width) for _ in range(blocks[level])),
            )
            for level, width in enumerate(widths)
        )
        self.context = nn.Conv2d(widths[-1], widths[-1], 1) if shape.context else None
        pairs = list(itertools.pairwise(widths))
        self.narrow = nn.ModuleList(_layer(deep, shallow, 1) for shallow, deep in pairs)
        self.fuse = nn.ModuleList(_layer(shallow, shallow, 3) for shallow, _ in pairs)
        self._patch, self._shrink, self._cell = patch, shape.shrink, patch * shape.shrink
        self._focal_px = shape.focal_px
        self._fine = max(1, self._cell // self.output_stride)
        self.head = nn.Conv2d(widths[0], self.classes * self._fine**2, 1)
        self.on_template = shape.template
        if shape.template:
            # Three layers: features that tell parts apart tell places within parts only by a nonlinear function.
            channels = widths[0], 256, 128
            bends = [(nn.Conv2d(*pair, 1), nn.ReLU(inplace=True)) for pair in itertools.pairwise(channels)]
            self.template = nn.Sequential(*itertools.chain(*bends), nn.Conv2d(channels[-1], 3 * self._fine**2, 1))
        # The layout of values between layers: with another, each convolution would convert its weights.
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any]) -> Self:
        """Make a network from `CompactSettings` as JSON, tuples as lists. Raises TypeError for an unknown name."""
        names = [field.name for field in fields(CompactSettings)]
        if unknown := settings.keys() - {*names}:
            raise TypeError(f"unknown {min(unknown)!r}: they are {', '.join(names)}")
        return cls(CompactSettings(**settings))

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        """Compute scores of every fourth pixel each way; see `Network.scores`."""
        return self._at_points(self.head(self._features(range_m)), range_m)

    def scores_and_places(self, range_m: torch.Tensor) -> torch.Tensor:
        """Compute scores, the same bits as of `scores`, and places on the template; see `Network.scores_and_places`."""
        if not self.on_template:
            return super().scores_and_places(range_m)
        x = self._features(range_m)
        return torch.cat([self._at_points(head(x), range_m) for head in (self.head, self.template)], 1)

    def _features(self, range_m: torch.Tensor) -> torch.Tensor:
        """Compute the heads' input from range images, for every cell."""
        check_range_images(range_m)
        if self._focal_px:
            values, measured = metric_patches(range_m, self._patch, self._focal_px)
        else:
            values, measured = patches_of(range_m, self._patch, self._shrink)
        x: torch.Tensor = self.embed(values)
        seen = []
        for stage in self.down:
            x = stage(x)
            seen.append(x)
        if self.context is not None:
            x = x + self.context(_mean_over_body(x, measured, 1 << (len(seen) - 1)))
        for narrow, fuse, level in reversed(list(zip(self.narrow, self.fuse, seen, strict=False))):
            x = fuse(level + F.interpolate(narrow(x), size=level.shape[-2:], mode="nearest"))
        return x

    def _at_points(self, x: torch.Tensor, range_m: torch.Tensor) -> torch.Tensor:
        """A head's answer to the cells of range images, at each point of the scores."""
        (rows, columns), stride = range_m.shape[2:], self.output_stride
        x = _spread(x, self._fine)
        if self._cell < stride:
            x = F.avg_pool2d(x, stride // self._cell, ceil_mode=True)
        return x[:, :, : (rows + stride - 1) // stride, : (columns + stride - 1) // stride]


def _spread(x: torch.Tensor, side: int) -> torch.Tensor:
    """`F.pixel_shuffle`, [B, C side^2, h, w] -> [B, C, h side, w side]; gradients have the layers' memory format."""
    if torch.onnx.is_in_onnx_export() or not x.requires_grad:
        return F.pixel_shuffle(x, side)
    batch, channels, rows, columns = x.shape
    parts = x.permute(0, 2, 3, 1).reshape(batch, rows, columns, channels // side**2, side, side)
    whole = parts.permute(0, 1, 4, 2, 5, 3).reshape(batch, rows * side, columns * side, channels // side**2)
    return whole.permute(0, 3, 1, 2)


def _mean_over_body(x: torch.Tensor, measured: torch.Tensor, cell: int) -> torch.Tensor:
    """Mean of [B, C, h, w] over its cells, [B, C, 1, 1], weighted by the measured share of each cell, so that empty
    space around a body does not change it. measured: [B, 1, H, W], share of each patch; cell: patches along its side.
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
