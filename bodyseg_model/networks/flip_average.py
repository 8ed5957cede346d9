"""The mean of a network's answers to an image and to its mirror image: more accurate, in up to twice the time."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere

from bodyseg_data.core.labels.label_map import PARTS33, LabelMap
from bodyseg_model.networks.network import Network, check_label_map
from bodyseg_model.networks.patches import check_range_images


class FlipAverage(Network):
    """A network whose scores are the mean of those of an image and those of its mirror image, mirrored back with left
    and right classes exchanged: so an image and its mirror image get the same labels, but for the side.

    network: in evaluation mode. label_map: its classes, by default the 33 parts. Raises BadConfig unless the network
    has as many.
    """

    def __init__(self, network: Network, label_map: LabelMap = PARTS33) -> None:
        check_label_map(network, label_map)
        super().__init__(network.settings, network.classes)
        self.output_stride, self.together = network.output_stride, network.together
        self.network, self.label_map = network, label_map
        opposite = torch.from_numpy(label_map.mirrored[: network.classes].astype(np.int64))
        self._opposite: torch.Tensor
        self.register_buffer("_opposite", opposite, persistent=False)
        self.train(network.training)

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        """Compute scores; see `Network.scores`."""
        check_range_images(range_m)
        # Whole strides, so that points of scores fall on one another when they are mirrored.
        seen = F.pad(range_m, (0, -range_m.shape[3] % self.output_stride))
        if self.together:
            own, mirrored = self.network.scores(torch.cat([seen, seen.flip(3)])).chunk(2)
        else:
            own, mirrored = (self.network.scores(image) for image in (seen, seen.flip(3)))
        return (own + mirrored.flip(3)[:, self._opposite]) / 2
