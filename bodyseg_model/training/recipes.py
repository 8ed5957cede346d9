"""Recipes: all hyperparameters of a training in one frozen dataclass, with a preset for each kind of network; and the
exponential moving average (EMA) of a network's weights over the steps of a training.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Literal

import torch

from bodyseg_data.core import Checked, bounded, check_choice
from bodyseg_model.networks import Network
from bodyseg_model.training.augmentation import GeometricAugmentation

OptimiserName = Literal["sgd", "adamw", "muon"]


@dataclass(frozen=True, kw_only=True)
class Recipe(Checked):
    """All hyperparameters of a training, by default those of `compact` but for geometric augmentation (`recipe_for`).
    With data, network and seed they determine its result.

    steps: updates of the weights. batch_size: images in one pass through the network, over all processes.
    accumulate: batches whose gradients are added up for one step.
    optimiser: "sgd" (with `momentum`), "adamw", or "muon" (`optimisers.Muon`).
    learning_rate: of the last layer, at its largest.
    layer_decay: learning rate of the deepest layer, the first that the image passes, as a share of the last layer's;
    the layers between have shares in geometric progression, and 1 gives all layers the same.
    weight_decay: of the weights of convolutions; with sgd, of all weights.
    warmup: share of the steps over which the learning rate rises from 0. cosine: whether it then falls to 0 as a
    cosine; else it stays. clip: largest norm of a step's gradient, 0 for no limit.
    mirror: whether half of the images are mirrored, left and right parts exchanged. geometric_augmentation: rotation,
    zoom and cuts of images. bf16: whether layers compute in bfloat16.
    balance: a part's pixels are weighted by its share of all pixels to the power of -balance; 0 for equal weights.
    loss_stride: the loss selects one pixel of every square of so many pixels a side, or of the network's output stride
    where that is larger.
    ema: decay of the exponential moving average of the weights, which is then validated and saved in their place
    (`AveragedNetwork`); 0 for none.
    shuffle: order of the samples, "global" for a permutation of all or "blocks", which suits far stores (`loader`).
    only_places: whether only the head of places on the template is trained; all else of the network stays as it is, so
    that it labels with the same bits.

    Raises BadConfig for a value out of range or of another type.
    """

    steps: int = bounded(10_000, 1)
    batch_size: int = bounded(16, 1)
    accumulate: int = bounded(1, 1)
    optimiser: OptimiserName = "muon"
    learning_rate: float = bounded(2e-3, 1e-9, 10)
    layer_decay: float = bounded(1.0, 1e-6, 1)
    momentum: float = bounded(0.9, 0, 0.9999)
    weight_decay: float = bounded(0.02, 0, 1)
    warmup: float = bounded(0.05, 0, 1)
    cosine: bool = True
    clip: float = bounded(5.0, 0, 1e6)
    mirror: bool = True
    balance: float = bounded(0.5, 0, 1)
    bf16: bool = True
    loss_stride: int = bounded(4, 1)
    geometric_augmentation: GeometricAugmentation = field(default_factory=GeometricAugmentation)
    ema: float = bounded(0.0, 0, 0.999999)
    shuffle: Literal["global", "blocks"] = "global"
    only_places: bool = False

    def to_json(self) -> dict[str, Any]:
        """The recipe as a JSON object. `ema`, `shuffle`, `only_places` and `bust` are left out at their defaults."""
        plain = ("ema", 0), ("shuffle", "global"), ("only_places", False)
        tree = {name: value for name, value in dataclasses.asdict(self).items() if (name, value) not in plain}
        if not self.geometric_augmentation.bust:
            del tree["geometric_augmentation"]["bust"]
        return tree

    def learning_rate_at(self, step: int) -> float:
        """The last layer's learning rate in step `step`, counted from 0."""
        rising = math.ceil(self.warmup * self.steps)
        if step < rising:
            return self.learning_rate * (step + 1) / (rising + 1)
        if not self.cosine:
            return self.learning_rate
        return self.learning_rate * (1 + math.cos(math.pi * (step - rising) / max(1, self.steps - rising))) / 2


PRESETS: Final[dict[str, Recipe]] = {
    # Section 3.5 of the paper; one image a pass and twenty passes a step is how it accumulates gradients.
    "fcn_alexnet": Recipe(
        steps=70_000,
        batch_size=1,
        accumulate=20,
        optimiser="sgd",
        learning_rate=1e-2,
        layer_decay=0.01,
        momentum=0.99,
        weight_decay=5e-4,
        warmup=0.0,
        cosine=False,
        clip=0.0,
        mirror=False,
        balance=0.0,
        bf16=False,
        loss_stride=1,
    ),
    "compact": Recipe(geometric_augmentation=GeometricAugmentation(roll_deg=10, zoom=0.15, stretch=0.1, cut=0.3)),
    # Of `compact` that finds people in rooms, where a body's size tells: images are neither zoomed nor stretched.
    "finder": Recipe(steps=12_000, geometric_augmentation=GeometricAugmentation(roll_deg=10, cut=0.3), ema=0.999),
}
"""Name -> recipe. Each network names its own (`networks.network.Network.default_recipe`)."""

if TYPE_CHECKING:
    RecipeName = str
else:
    RecipeName = Literal[tuple(PRESETS)]


def recipe_for(name: str, **changes: Any) -> Recipe:
    """The preset of a name, some fields changed; None leaves a field as it is. Raises BadConfig for an unknown name."""
    given = {field: value for field, value in changes.items() if value is not None}
    return dataclasses.replace(PRESETS[check_choice("the recipe", name, PRESETS)], **given)


class AveragedNetwork:
    """A network whose weights are the exponential moving average of another's (Polyak and Juditsky, 1992).

    After step t, counted from 0, average = d average + (1 - d) weights with d = min(decay, (1 + t) / (10 + t)), so that
    the first weights, which are random, are soon forgotten. The statistics of batch normalisation are averaged like the
    weights (docs/how-to/training.md has the comparison); whole numbers are copied.

    network: the averaged network, in evaluation mode. decay: the largest share that the average keeps in a step.
    """

    def __init__(self, network: Network, decay: float) -> None:
        self.network = copy.deepcopy(network).eval().requires_grad_(False)
        self.decay = decay

    @torch.no_grad()
    def update(self, network: Network, step: int) -> None:
        """Take in the weights after step `step`, counted from 0. network: of the same shape as the averaged one."""
        decay = min(self.decay, (1 + step) / (10 + step))
        weights = network.state_dict()
        for name, average in self.network.state_dict().items():
            if average.is_floating_point():
                average.lerp_(weights[name], 1 - decay)
            else:
                average.copy_(weights[name])
