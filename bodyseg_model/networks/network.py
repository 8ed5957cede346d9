"""Base class of every network: its scores, and the properties on which training, prediction and files depend.

A new network is one file in this folder with a subclass of `Network`, and one entry of `registry.NETWORKS`. The
subclass defines `scores`, and overrides the attributes and methods in which it differs from the defaults here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from torch import nn

from bodyseg_data.core.errors import BadConfig, check_int
from bodyseg_data.core.labels.label_map import LabelMap
from bodyseg_data.core.parts import BACKGROUND, PART_COUNT


class Network(nn.Module, ABC):
    """Range images -> scores of classes, by default the 33 parts.

    settings: arguments of the constructor as plain JSON, with which `registry.build` makes the same network again.
    classes: their number C; it is among the settings unless it is 33. Raises BadConfig unless it is 1 to 255.
    """

    output_stride: int = 1
    """Pixels of the image along each side between two neighbouring scores of `scores`."""

    together: bool = True
    """Whether images of one size are quicker together than one by one: not where a new number of them costs time."""

    default_recipe: ClassVar[str] = "compact"
    """Key of `training.recipes.PRESETS`: the recipe of a training that names none."""

    def __init__(self, settings: Mapping[str, Any] | None = None, classes: int = PART_COUNT) -> None:
        super().__init__()
        self.classes = check_classes(classes)
        self.settings = {**(settings or {}), **({} if classes == PART_COUNT else {"classes": classes})}

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any]) -> Self:
        """Make a network with new weights from `settings`, read from JSON. Raises TypeError for an unknown name."""
        return cls(**settings)

    @abstractmethod
    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        """Compute scores (logits), float [B, C, ceil(H / output_stride), ceil(W / output_stride)].

        range_m: float [B, 1, H, W], metres, 0 = nothing measured. Score (i, j) belongs to the point ((i + 1/2)
        output_stride, (j + 1/2) output_stride) of the image, in pixels from its corner. Raises BadConfig for any other
        shape (`patches.check_range_images`).
        """

    def scores_at(self, range_m: torch.Tensor, rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
        """Compute scores at some pixels only, float [B, C, h, w]; for networks whose output stride is 1.

        rows: int64 [h]; columns: int64 [w]. A network overrides this where that is cheaper than all of `scores`.
        """
        return self.scores(range_m)[:, :, rows][..., columns]

    def forward(self, range_m: torch.Tensor) -> torch.Tensor:
        """Compute scores of every pixel, float [B, C, H, W], interpolated between those of `scores`; see there."""
        scores = self.scores(range_m)
        if self.output_stride == 1:
            return scores
        rows, columns = range_m.shape[2:]
        full = F.interpolate(scores, scale_factor=self.output_stride, mode="bilinear", align_corners=False)
        return full[:, :, :rows, :columns]

    def load_pretrained(self, path: Path) -> None:
        """Fill layers from a file of published weights. By default a network reads none: raises BadConfig."""
        raise BadConfig(f"{type(self).__name__} starts from a run's folder or a .safetensors file, found {path}")

    def extra_repr(self) -> str:
        """Settings, for `repr`."""
        return ", ".join(f"{name}={value!r}" for name, value in self.settings.items())


def check_classes(classes: int) -> int:
    """Return the number of a network's classes. Raises BadConfig unless it is 1 to 255: labels are bytes."""
    count = check_int("classes", classes, 1)
    if count > BACKGROUND:
        raise BadConfig(f"classes must be at most {BACKGROUND}, found {count}")
    return count


def check_label_map(network: Network, label_map: LabelMap) -> None:
    """Raise BadConfig unless a network has as many classes as a label map."""
    if network.classes != len(label_map):
        raise BadConfig(
            f"the network must have the {len(label_map)} classes of labels {label_map.name!r}, found {network.classes}"
        )
