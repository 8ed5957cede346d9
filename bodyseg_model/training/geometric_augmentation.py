"""Geometric augmentation: images rotated, zoomed and cut, as by a tilted camera or people partly out of view."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere

from bodyseg_data.core.errors import BadConfig, check_fields
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.core.randomness import chance


@dataclass(frozen=True)
class GeometricAugmentation:
    """Ranges of random rotation, zoom and cuts of images; 0 for none.

    roll_deg: largest rotation either way, degrees. zoom: the scale is drawn from 1 / (1 + zoom) to 1 + zoom. stretch:
    the scale of the width is further multiplied by up to 1 + stretch, or divided by it. cut: share of the images of
    which one side, up to half of the height or width, is out of view. Raises BadConfig for a value out of range.
    """

    roll_deg: float = 0.0
    zoom: float = 0.0
    stretch: float = 0.0
    cut: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self)
        for name, most in (("roll_deg", 180), ("zoom", 1), ("stretch", 1), ("cut", 1)):
            if not 0 <= getattr(self, name) <= most:
                raise BadConfig(f"{name} must be from 0 to {most}, found {getattr(self, name)!r}")

    def __call__(
        self, range_m: torch.Tensor, labels: torch.Tensor, seed: int, epochs: list[int], keys: list[str]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Copies of range [B, 1, H, W] and labels uint8 [B, H, W], transformed as drawn for (seed, epoch, key) of each.

        Values are taken from the nearest pixel, so that none is interpolated between two surfaces.
        """
        if self == GeometricAugmentation():
            return range_m, labels
        rows, columns = range_m.shape[2:]
        maps, kept = [], torch.ones(len(keys), 1, rows, columns, dtype=torch.bool)
        for number, (epoch, key) in enumerate(zip(epochs, keys, strict=True)):
            roll, zoom, stretch, cut, side, share = (
                chance(seed, epoch, key, f"placement {what}")
                for what in ("roll", "zoom", "stretch", "cut", "side", "share")
            )
            angle = math.radians(self.roll_deg) * (2 * roll - 1)
            down = (1 + self.zoom) ** (2 * zoom - 1)
            across = down * (1 + self.stretch) ** (2 * stretch - 1)
            maps.append(_source_map(angle, down, across, rows, columns))
            if cut < self.cut:
                _cut_side(kept[number, 0], int(4 * side), share / 2)
        grid = F.affine_grid(torch.tensor(maps), [len(keys), 1, rows, columns], align_corners=False).to(range_m.device)
        stacked = torch.cat([range_m, labels[:, None].to(range_m.dtype) + 1], 1)  # + 1: outside becomes 0
        moved = F.grid_sample(stacked, grid, mode="nearest", padding_mode="zeros", align_corners=False)
        moved = torch.where(kept.to(range_m.device), moved, 0)
        named = (moved[:, 1] - 1).clamp(min=-1)
        return moved[:, :1].contiguous(), torch.where(named < 0, BACKGROUND, named).to(torch.uint8)


def _source_map(angle: float, down: float, across: float, rows: int, columns: int) -> list[list[float]]:
    """Affine map from the transformed image to the source, both from -1 to 1 each way: [2, 3], (x, y, 1) -> (x, y)."""
    cosine, sine = math.cos(angle), math.sin(angle)
    aspect = rows / columns
    return [[cosine / across, -sine * aspect / across, 0.0], [sine / aspect / down, cosine / down, 0.0]]


def _cut_side(kept: torch.Tensor, side: int, share: float) -> None:
    """Mark a share of bool [H, W] at its top, bottom, left or right as out of view."""
    rows, columns = kept.shape
    down, across = int(share * rows), int(share * columns)
    if side == 0:
        kept[:down] = False
    elif side == 1:
        kept[rows - down :] = False
    elif side == 2:
        kept[:, :across] = False
    else:
        kept[:, columns - across :] = False
