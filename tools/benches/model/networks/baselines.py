"""Baseline networks in common use: SegFormer and DeepLab, from the package transformers.

`python -m benches.model.networks.baselines train --network deeplab ...` runs `bodyseg` with them in its registry.

They get the input of `compact`, range less the body's mean beside validity, start from random weights, and compute
scores on a coarser grid, which are interpolated as `compact`'s are. So a comparison differs by the network alone.
"""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections.abc import Iterator, Mapping
from typing import Any, Final, Literal

import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from torch import nn

from bodyseg_data.core import BadConfig, MissingLibrary, check_int
from bodyseg_data.labels import BACKGROUND, PART_COUNT
from bodyseg_model import networks
from bodyseg_model.commands import main
from bodyseg_model.networks import Network, check_range_images
from bodyseg_model.networks.names import NETWORKS
from bodyseg_model.networks.network import relief_of, shrunk

BASELINES: Final = {
    "segformer": "benches.model.networks.baselines.Segformer",
    "deeplab": "benches.model.networks.baselines.Deeplab",
}
"""Name -> class, as in `NETWORKS`."""

_INPUTS: Final = 2


@contextlib.contextmanager
def with_baselines() -> Iterator[None]:
    """Add the baselines to `NETWORKS` while the block runs, and to the names that `bodyseg train --network` takes."""
    before = networks.NetworkName
    NETWORKS.update(BASELINES)
    vars(networks)["NetworkName"] = Literal[tuple(NETWORKS)]  # the command line reads it when it runs
    try:
        yield
    finally:
        vars(networks)["NetworkName"] = before
        for name in BASELINES:
            del NETWORKS[name]


class Baseline(Network):
    """Range images -> scores of the classes, by a network of the package transformers.

    network: of two input channels, with an output channel for each class as `.logits`. apart: pixels of its input
    between two of its own scores. shrink: pixels of the image along one side of a square that is averaged to one of its
    input. Raises BadConfig for a shrink that is not 1, 2 or 4.
    """

    output_stride: int = 4

    def __init__(
        self, network: nn.Module, apart: int, shrink: int, settings: Mapping[str, Any], classes: int = PART_COUNT
    ) -> None:
        super().__init__({**settings, "shrink": shrink}, classes)
        if shrink not in (1, 2, 4):
            raise BadConfig(f"shrink must be 1, 2 or 4, found {shrink!r}")
        self.network = network
        self._cell, self._shrink = apart * shrink, shrink

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        """Compute scores of every fourth pixel each way, interpolated if need be; see `Network.scores`."""
        check_range_images(range_m)
        rows, columns = range_m.shape[2:]
        whole, stride = 32 * self._shrink, self.output_stride
        relief = F.pad(relief_of(range_m), (0, -columns % whole, 0, -rows % whole))
        scores: torch.Tensor = self.network(shrunk(relief, self._shrink) if self._shrink > 1 else relief).logits
        if self._cell != stride:
            scores = F.interpolate(scores, scale_factor=self._cell // stride, mode="bilinear", align_corners=False)
        return scores[:, :, : (rows + stride - 1) // stride, : (columns + stride - 1) // stride]


class Segformer(Baseline):
    """SegFormer (Xie et al., 2021), B0 or B1 by `size`. Raises BadConfig for another, MissingLibrary."""

    def __init__(self, size: int = 0, shrink: int = 1, classes: int = PART_COUNT) -> None:
        if size not in (0, 1):
            raise BadConfig(f"size of segformer must be 0 or 1, found {size!r}")
        transformers = _transformers("segformer")
        widths = [(32 << size) * factor for factor in (1, 2, 5, 8)]
        config = transformers.SegformerConfig(
            num_channels=_INPUTS, hidden_sizes=widths, num_labels=check_int("classes", classes, 1, BACKGROUND)
        )
        super().__init__(transformers.SegformerForSemanticSegmentation(config), 4, shrink, {"size": size}, classes)


class Deeplab(Baseline):
    """DeepLabV3+ on MobileNetV2 (Sandler et al., 2018), with scores every 8 or 16 pixels of its input.

    Raises BadConfig for another number, MissingLibrary.
    """

    def __init__(self, apart: int = 16, shrink: int = 1, classes: int = PART_COUNT) -> None:
        if apart not in (8, 16):
            raise BadConfig(f"apart of deeplab must be 8 or 16, found {apart!r}")
        transformers = _transformers("deeplab")
        config = transformers.MobileNetV2Config(
            num_channels=_INPUTS,
            output_stride=apart,
            num_labels=check_int("classes", classes, 1, BACKGROUND),
            tf_padding=False,
        )
        network = transformers.MobileNetV2ForSemanticSegmentation(config)
        super().__init__(network, apart, shrink, {"apart": apart}, classes)


def _transformers(name: str) -> Any:
    try:
        return importlib.import_module("transformers")
    except ImportError as error:
        raise MissingLibrary(f"{name} needs the package 'transformers': pip install transformers ({error})") from error


if __name__ == "__main__":
    with with_baselines():
        sys.exit(main())
