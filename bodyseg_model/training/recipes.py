"""Recipes: all hyperparameters of a training in one frozen dataclass, with a preset for each kind of network."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Literal

from bodyseg_data.core.errors import BadConfig, check_fields
from bodyseg_model.training.augmentation import GeometricAugmentation


@dataclass(frozen=True)
class Recipe:
    """All hyperparameters of a training; with data, network and seed they determine its result.

    steps: updates of the weights. batch_size: images in one pass through the network, over all processes. accumulate:
    batches whose gradients are added up for one step. optimiser: "sgd" (with `momentum`) or "adamw".

    learning_rate: of the last layer, at its largest. layer_decay: learning rate of the deepest layer, the first that
    the image passes, as a share of the last layer's; the layers between have shares in geometric progression, and 1
    gives all layers the same. weight_decay: of the weights of convolutions; with sgd, of all weights. warmup: share of
    the steps over which the learning rate rises from 0. cosine: whether it then falls to 0 as a cosine, else it stays.
    clip: largest norm of a step's gradient, 0 for no limit.

    mirror: whether half of the images are mirrored, left and right parts exchanged. geometric_augmentation: rotation,
    zoom and cuts of images.

    balance: a part's pixels are weighted by its share of all pixels to the power of -balance; 0 for equal weights.
    loss_stride: the loss selects one pixel of every square of so many pixels a side, or of the network's output stride
    where that is larger. bf16: whether layers compute in bfloat16.

    ema: decay of the exponential moving average of the weights, which is then validated and saved in their place
    (`ema.AveragedNetwork`); 0 for none.

    Raises BadConfig for a value out of range or of another type.
    """

    steps: int
    batch_size: int
    accumulate: int
    optimiser: Literal["sgd", "adamw"]
    learning_rate: float
    layer_decay: float
    momentum: float
    weight_decay: float
    warmup: float
    cosine: bool
    clip: float
    mirror: bool
    balance: float
    bf16: bool
    loss_stride: int
    geometric_augmentation: GeometricAugmentation = field(default_factory=GeometricAugmentation)
    ema: float = 0.0

    def __post_init__(self) -> None:
        if self.optimiser not in ("sgd", "adamw"):
            raise BadConfig(f"the optimiser must be sgd or adamw, found {self.optimiser!r}")
        check_fields(self)
        for name in ("steps", "batch_size", "accumulate", "loss_stride"):
            if not 1 <= getattr(self, name) <= 10**9:
                raise BadConfig(f"{name} must be at least 1, found {getattr(self, name)!r}")
        for name, least, most in _BOUNDS:
            if not least <= getattr(self, name) <= most:  # also refuses NaN
                raise BadConfig(f"{name} must be from {least} to {most}, found {getattr(self, name)!r}")

    def to_json(self) -> dict[str, Any]:
        """The recipe as a JSON object; `ema` only where there is one."""
        return {name: value for name, value in dataclasses.asdict(self).items() if name != "ema" or value}

    @staticmethod
    def from_json(content: Mapping[str, Any]) -> Recipe:
        """Rebuild a recipe from what `to_json` gave. Raises TypeError, KeyError or BadConfig for anything else."""
        return Recipe(
            **{**content, "geometric_augmentation": GeometricAugmentation(**content["geometric_augmentation"])}
        )

    def learning_rate_at(self, step: int) -> float:
        """The last layer's learning rate in step `step`, counted from 0."""
        rising = math.ceil(self.warmup * self.steps)
        if step < rising:
            return self.learning_rate * (step + 1) / (rising + 1)
        if not self.cosine:
            return self.learning_rate
        return self.learning_rate * (1 + math.cos(math.pi * (step - rising) / max(1, self.steps - rising))) / 2

    def layer_shares(self, layers: int) -> list[float]:
        """Learning rates of `layers` layers as shares of the last one's, deepest first (`layer_decay`)."""
        return [self.layer_decay ** (1 - at / max(1, layers - 1)) for at in range(layers)]


_BOUNDS: Final = (
    ("learning_rate", 1e-9, 10),
    ("layer_decay", 1e-6, 1),
    ("momentum", 0, 0.9999),
    ("weight_decay", 0, 1),
    ("warmup", 0, 1),
    ("clip", 0, 1e6),
    ("balance", 0, 1),
    ("ema", 0, 0.999999),
)

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
    "compact": Recipe(
        steps=10_000,
        batch_size=16,
        accumulate=1,
        optimiser="adamw",
        learning_rate=2e-3,
        layer_decay=1.0,
        momentum=0.9,
        weight_decay=0.02,
        warmup=0.05,
        cosine=True,
        clip=5.0,
        mirror=True,
        balance=0.5,
        bf16=True,
        loss_stride=4,
        geometric_augmentation=GeometricAugmentation(roll_deg=10, zoom=0.15, stretch=0.1, cut=0.3),
    ),
}
"""Name -> recipe. Each network names its own (`networks.network.Network.default_recipe`)."""

if TYPE_CHECKING:
    RecipeName = str
else:
    RecipeName = Literal[tuple(PRESETS)]


def recipe_for(name: str, **changes: Any) -> Recipe:
    """A preset with some fields changed; None leaves a field as it is. Raises BadConfig for an unknown name."""
    if name not in PRESETS:
        raise BadConfig(f"the recipe must be one of {', '.join(PRESETS)}, found {name!r}")
    return dataclasses.replace(PRESETS[name], **{field: value for field, value in changes.items() if value is not None})
