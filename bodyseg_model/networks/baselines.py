"""Two networks that people would pick today, to compare with: SegFormer and DeepLab, from the package transformers.

They see what `compact` sees, range less the body's mean beside validity, start from random weights, and answer on a
coarser grid, from which scores are interpolated as `compact`'s are. So what differs in a comparison is the network.
"""

from __future__ import annotations

import importlib
from typing import Any, Final

import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from torch import nn

from bodyseg_data.core.errors import BadConfig, MissingLibrary
from bodyseg_data.core.parts import PART_COUNT
from bodyseg_model.networks.compact import relief_of, shrunk
from bodyseg_model.networks.range_input import check_range_images

_INPUTS: Final = 2


class Baseline(nn.Module):
    """Range image -> scores of the 33 parts, at the image's own size, by a network of another package.

    apart: pixels of its input between two of the network's own answers. shrink: pixels of the image along one side of a
    square that is averaged to one of its input.
    """

    stride: Final = 4
    """Pixels of the image between two answers of `coarse`."""

    def __init__(self, network: nn.Module, apart: int, shrink: int, settings: dict[str, Any]) -> None:
        super().__init__()
        if shrink not in (1, 2, 4):
            raise BadConfig(f"shrink must be 1, 2 or 4, found {shrink!r}")
        self.network, self.settings = network, {**settings, "shrink": shrink}
        self._cell, self._shrink = apart * shrink, shrink

    def coarse(self, range_m: torch.Tensor) -> torch.Tensor:
        """Scores (logits) of every fourth pixel each way, float [B, 33, ceil(H / 4), ceil(W / 4)], interpolated.

        range_m: as in `forward`.
        """
        check_range_images(range_m)
        rows, columns = range_m.shape[2:]
        whole = 32 * self._shrink
        relief = F.pad(relief_of(range_m), (0, -columns % whole, 0, -rows % whole))
        scores: torch.Tensor = self.network(shrunk(relief, self._shrink) if self._shrink > 1 else relief).logits
        if self._cell != self.stride:
            factor = self._cell // self.stride
            scores = F.interpolate(scores, scale_factor=factor, mode="bilinear", align_corners=False)
        return scores[:, :, : -(-rows // self.stride), : -(-columns // self.stride)]

    def forward(self, range_m: torch.Tensor) -> torch.Tensor:
        """Scores (logits), float [B, 33, H, W], of range images in metres, float [B, 1, H, W], 0 = nothing measured.

        Raises BadConfig for any other shape.
        """
        rows, columns = range_m.shape[2:]
        full = F.interpolate(self.coarse(range_m), scale_factor=self.stride, mode="bilinear", align_corners=False)
        return full[:, :, :rows, :columns]


def segformer(size: int = 0, shrink: int = 1) -> Baseline:
    """SegFormer (Xie et al., 2021), B0 or B1 by `size`. Raises BadConfig for another, MissingLibrary."""
    if size not in (0, 1):
        raise BadConfig(f"size of segformer must be 0 or 1, found {size!r}")
    transformers = _transformers("segformer")
    widths = [(32 << size) * factor for factor in (1, 2, 5, 8)]
    config = transformers.SegformerConfig(num_channels=_INPUTS, hidden_sizes=widths, num_labels=PART_COUNT)
    return Baseline(transformers.SegformerForSemanticSegmentation(config), 4, shrink, {"size": size})


def deeplab(apart: int = 16, shrink: int = 1) -> Baseline:
    """DeepLabV3+ on MobileNetV2 (Sandler et al., 2018), with an answer every 8 or 16 pixels of its input.

    Raises BadConfig for another number, MissingLibrary.
    """
    if apart not in (8, 16):
        raise BadConfig(f"deeplab answers every 8 or 16 pixels, found {apart!r}")
    transformers = _transformers("deeplab")
    config = transformers.MobileNetV2Config(
        num_channels=_INPUTS, output_stride=apart, num_labels=PART_COUNT, tf_padding=False
    )
    return Baseline(transformers.MobileNetV2ForSemanticSegmentation(config), apart, shrink, {"apart": apart})


def _transformers(name: str) -> Any:
    try:
        return importlib.import_module("transformers")
    except ImportError as error:
        raise MissingLibrary(f"{name} needs the package 'transformers': pip install transformers ({error})") from error
