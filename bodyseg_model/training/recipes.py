"""Recipes: all hyperparameters of a training in one frozen dataclass, with a preset for each kind of network."""

import dataclasses
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Literal

from bodyseg_data.core import Checked, bounded, check_choice
from bodyseg_data.machine import computes_bfloat16
from bodyseg_model import networks

OptimiserName = Literal["sgd", "adamw", "muon"]


@dataclass(frozen=True)
class GeometricAugmentation(Checked):
    """Ranges of random rotation, zoom and cuts of the images of a training; 0 for none. For `Recipe`.

    roll_deg: largest rotation either way, degrees. zoom: the scale is drawn from 1 / (1 + zoom) to 1 + zoom.
    stretch: the scale of the width is further multiplied, or divided, by up to 1 + stretch.
    cut: share of the images of which one side, up to half of the height or width, is out of view.
    bust: share of the images that show only the upper 35 to 80 % of the body's height, as of people at a desk or near
    the camera. Raises BadConfig for a value out of range.
    """

    roll_deg: float = bounded(0.0, 0, 180)
    zoom: float = bounded(0.0, 0, 1)
    stretch: float = bounded(0.0, 0, 1)
    cut: float = bounded(0.0, 0, 1)
    bust: float = bounded(0.0, 0, 1)


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
    (`loop.AveragedNetwork`); 0 for none.
    start_share: share, in the weights that are validated and saved, of those that the training started from; the rest
    are trained ones (Wortsman et al., 2022). More of the start keeps more of what it could.
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
    start_share: float = bounded(0.0, 0, 0.99)
    shuffle: Literal["global", "blocks"] = "global"
    only_places: bool = False

    def to_json(self) -> dict[str, Any]:
        """The recipe as a JSON object. Fields from `ema` on, and `bust`, are left out at their defaults."""
        plain = ("ema", 0), ("start_share", 0), ("shuffle", "global"), ("only_places", False)
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


def recipe_for(name: str, device: str | None = None, **changes: Any) -> Recipe:
    """The preset of a name, some fields changed; None leaves a field as it is. Raises BadConfig for an unknown name.

    device: as of `train`. A processor that must emulate bfloat16, 8 times slower, gets float32 unless `bf16` is given.
    """
    given = {field: value for field, value in changes.items() if value is not None}
    if networks.find_device(device).type == "cpu" and not computes_bfloat16():
        given = {"bf16": False, **given}
    return dataclasses.replace(PRESETS[check_choice("the recipe", name, PRESETS)], **given)
