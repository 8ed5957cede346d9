"""Base class of every network, the mean over an image and its mirror image, and range images as networks see them.

A new network is one file in this folder with a subclass of `Network`, and one entry of `names.NETWORKS`. The
subclass defines `scores`, and overrides the attributes and methods in which it differs from the defaults here.

Networks see images checked, centred, averaged, and cut into the patches that `compact` reads. By PyTorch's operations,
which GPUs need, that takes 1.1 ms an image of 640 x 329 pixels; by `patch_loops`, 0.4 ms, to the same values.
"""

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar, Final, NamedTuple, Self

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from torch import nn

from bodyseg_data.core import BadConfig, check_class, check_int
from bodyseg_data.labels import BACKGROUND, PART_COUNT, PARTS33, LabelMap
from bodyseg_data.machine import if_ready, use_compiled

MEASURES: Final = 7
"""Channels of `metric_patches` beside those of a patch's pixels."""

RELIEF: Final = 2.0
"""Factor of centred ranges: they are a few decimetres, and layers learn best from numbers near one."""


class Network(nn.Module, ABC):
    """Base class of networks: range images -> scores of classes, by default the 33 parts. A new one defines `scores`.

    settings: arguments of the constructor as plain JSON, with which `registry.build` makes the same network again.
    classes: their number C; it is among the settings unless it is 33. Raises BadConfig unless it is 1 to 255.
    """

    output_stride: int = 1
    """Pixels of the image along each side between two neighbouring scores of `scores`."""

    on_template: bool = False
    """Whether `scores_and_places` tells where on the template of the body each point lies."""

    together: bool = True
    """Whether images of one size are quicker together than one by one: not where a new number of them costs time."""

    default_recipe: ClassVar[str] = "compact"
    """Key of `training.recipes.PRESETS`: the recipe of a training that names none."""

    def __init__(self, settings: Mapping[str, Any] | None = None, classes: int = PART_COUNT) -> None:
        super().__init__()
        _compute_alone_in_forks()
        self.classes = check_int("classes", classes, 1, BACKGROUND)  # labels are bytes
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
        shape (`check_range_images`).
        """

    def scores_at(self, range_m: torch.Tensor, rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
        """Compute scores at some pixels only, float [B, C, h, w]; for networks whose output stride is 1.

        rows: int64 [h]; columns: int64 [w]. To be overridden where that is cheaper than all of `scores`.
        """
        return self.scores(range_m)[:, :, rows][..., columns]

    def scores_and_places(self, range_m: torch.Tensor) -> torch.Tensor:
        """Compute `scores` and, behind them, places on the template, float [B, C + 3, h, w] (`body_map`).

        Raises BadConfig for a network that knows no places, as by default.
        """
        raise BadConfig(
            f"{type(self).__name__} must have a head of places on the template: `train --settings "
            "'{\"template\": true}'` trains one"
        )

    def forward(self, range_m: torch.Tensor) -> torch.Tensor:
        """Compute scores of every pixel, float [B, C, H, W], interpolated between those that `scores` computes."""
        scores = self.scores(range_m)
        if self.output_stride == 1:
            return scores
        rows, columns = range_m.shape[2:]
        full = F.interpolate(scores, scale_factor=self.output_stride, mode="bilinear", align_corners=False)
        return full[:, :, :rows, :columns]

    def load_pretrained(self, path: Path) -> None:
        """Fill layers from a file of published weights. Raises BadConfig by default: a network reads none."""
        raise BadConfig(f"{type(self).__name__} starts from a run's folder or a .safetensors file, found {path}")

    def extra_repr(self) -> str:
        """Settings, for `repr`."""
        return ", ".join(f"{name}={value!r}" for name, value in self.settings.items())


@cache
def _compute_alone_in_forks() -> None:
    """Have forks of this process compute in one thread: OpenMP would wait for ever for threads that a fork lacks."""
    os.register_at_fork(after_in_child=partial(torch.set_num_threads, 1))


def check_label_map(network: Network, label_map: LabelMap) -> None:
    """Raise BadConfig unless a network has as many classes as a label map."""
    check_class("label_map", label_map, LabelMap)
    if network.classes != len(label_map):
        raise BadConfig(
            f"the network must have the {len(label_map)} classes of labels {label_map.name!r}, found {network.classes}"
        )


class FlipAverage(Network):
    """A network whose scores are the mean of an image's and its mirror image's, mirrored back with left and right
    classes exchanged: so both get the same labels, but for the side, if the width is of whole strides.

    network: in evaluation mode. label_map: its classes, by default 33 parts. Raises BadConfig unless it has as many.
    """

    def __init__(self, network: Network, label_map: LabelMap = PARTS33) -> None:
        check_label_map(network, label_map)
        super().__init__(network.settings, network.classes)
        self.output_stride, self.together = network.output_stride, network.together
        self.on_template = network.on_template
        self.network, self.label_map = network, label_map
        opposite = torch.from_numpy(label_map.mirrored[: network.classes].astype(np.int64))
        self._opposite: torch.Tensor
        self.register_buffer("_opposite", opposite, persistent=False)
        self.train(network.training)

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        own, mirrored = self._both(range_m, self.network.scores)
        return (own + mirrored[:, self._opposite]) / 2

    def scores_and_places(self, range_m: torch.Tensor) -> torch.Tensor:
        own, mirrored = self._both(range_m, self.network.scores_and_places)
        scores, places = mirrored[:, self._opposite], mirrored[:, self.classes :]
        return (own + torch.cat([scores, -places[:, :1], places[:, 1:]], 1)) / 2

    def _both(
        self, range_m: torch.Tensor, compute: Callable[[torch.Tensor], torch.Tensor]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Answers to images, and to their mirror images, mirrored back."""
        check_range_images(range_m)
        # Whole strides, so that points of scores fall on one another when they are mirrored.
        seen = _padded(range_m, 1, self.output_stride)
        if self.together:
            own, mirrored = compute(torch.cat([seen, seen.flip(3)])).chunk(2)
        else:
            own, mirrored = (compute(image) for image in (seen, seen.flip(3)))
        return own, mirrored.flip(3)


class WrappedModule(Network):
    """A torch module as a network; see `checkpoints.wrapped`."""

    def __init__(self, module: nn.Module, classes: int, prepare: Any, multiple: int) -> None:
        super().__init__({}, classes)
        self.module, self.prepare, self.multiple = module, prepare, check_int("multiple", multiple, 1)

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        """Compute scores; see `Network.scores`. Raises BadConfig where the module gives others."""
        check_range_images(range_m)
        if self.module.training and not self.training:  # set since, also within a `FlipAverage`
            raise BadConfig("a wrapped module must be in evaluation mode, as its network is: call network.eval() first")
        rows, columns = range_m.shape[2:]
        image = _padded(range_m, self.multiple, self.multiple)
        scores = self.module(image if self.prepare is None else self.prepare(image))
        whole = [len(image), self.classes, *image.shape[2:]]
        found = list(scores.shape) if isinstance(scores, torch.Tensor) else type(scores).__name__
        if found != whole:
            raise BadConfig(f"{type(self.module).__name__} must give scores [B, classes, H, W], {whole}, found {found}")
        seen: torch.Tensor = scores[:, :, :rows, :columns]
        return seen


# Range images as networks see them.


def check_range_images(range_m: torch.Tensor) -> None:
    """Raise BadConfig unless `range_m` is [B, 1, H, W], not empty, and of a floating point that networks compute in."""
    check_class("range images", range_m, torch.Tensor)
    if range_m.ndim != 4 or range_m.shape[1] != 1 or not range_m.numel():
        raise BadConfig(f"range images must be [B, 1, H, W], found {list(range_m.shape)}")
    if range_m.dtype not in (torch.float32, torch.bfloat16, torch.float16):
        raise BadConfig(f"range images must be float32, found {range_m.dtype}")


def relief_of(range_m: torch.Tensor) -> torch.Tensor:
    """Input of two channels, [B, 2, H, W]: range less its mean over what was measured, scaled; and 1 where measured.

    range_m: float [B, 1, H, W], metres, 0 = nothing measured. Sums are in float32 whatever the input's type: the ranges
    of a body are too many for float16.
    """
    metres, measured = range_m.float(), (range_m > 0).float()
    mean = body_mean(metres, measured.sum((1, 2, 3), keepdim=True))
    return torch.cat([(metres - mean) * measured * RELIEF, measured], 1).to(range_m.dtype)


def body_mean(metres: torch.Tensor, count: torch.Tensor) -> torch.Tensor:
    """Mean of what was measured in each image, float32 [B, 1, 1, 1], metres; 0 where nothing was.

    metres: float32 [B, 1, H, W], 0 = nothing measured. count: float32 [B, 1, 1, 1], measured pixels.
    """
    return metres.sum((1, 2, 3), keepdim=True) / count.clamp(min=1)


def shrunk(relief: torch.Tensor, side: int) -> torch.Tensor:
    """Average `relief_of` over squares of `side` pixels, [B, 2, h, w]: the ranges measured in each, and their share."""
    mean = F.avg_pool2d(relief, side)
    return torch.cat([mean[:, :1] / mean[:, 1:].clamp(min=1 / side**2), mean[:, 1:]], 1)


def in_loops(tensor: torch.Tensor) -> bool:
    """True if compiled loops give a tensor's results, with PyTorch's bits: on a processor, where numba is installed."""
    return tensor.device.type == "cpu" and use_compiled()


class Patches(NamedTuple):
    """Images in cells of `side` pixels, rows and columns rounded up to whole cells.

    values: [B, 2 side^2, h, w], channels last in memory: of each cell the centred ranges, row by row, and then 1 where
    something was measured, else 0. float32, or the type in which layers compute under autocast. measured: float
    [B, 1, h, w], share of each cell's pixels that were measured.
    """

    values: torch.Tensor
    measured: torch.Tensor


def patches_of(range_m: torch.Tensor, side: int, shrink: int = 1) -> Patches:
    """Cut range images [B, 1, H, W] into patches; shrink: pixels along one side of the squares averaged first."""
    kind = range_m.device.type
    layers = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else range_m.dtype
    if shrink == 1 and _fits_loops(range_m, layers):
        with if_ready:
            return _by_loops(range_m, side, layers)
    relief = _padded(relief_of(range_m), side * shrink, side * shrink)
    if shrink > 1:
        relief = shrunk(relief, shrink)
    # Converted here: the layers would convert later, from copies of twice the size.
    return Patches(_unshuffled(relief.to(layers), side), F.avg_pool2d(relief[:, 1:], side))


def metric_patches(range_m: torch.Tensor, side: int, focal_px: float) -> Patches:
    """Cut images of a room into patches that say what is where and how large it is, whatever stands around.

    range_m: float [B, 1, H, W], metres, of a camera of focal length `focal_px` whose principal point is the middle of
    the image. Values are, of each cell: its ranges less their mean, in units of 0.1 m and at most 3 either side; where
    something was measured; and of the mean range Z and the cell's middle (x, y, 1) on the ray of unit depth: Z, 1 / Z,
    x Z, y Z, whether anything was measured, x and y, scaled to about 1.
    """
    rows, columns = range_m.shape[2:]
    kind = range_m.device.type
    layers = torch.get_autocast_dtype(kind) if torch.is_autocast_enabled(kind) else range_m.dtype
    if _fits_loops(range_m, layers):
        with if_ready:
            return _by_loops(range_m, side, layers, focal_px)
    metres = _unshuffled(_padded(range_m.float(), side, side), side)
    known = (metres > 0).float()
    share = known.mean(1, keepdim=True)
    mean = metres.mean(1, keepdim=True) / share.clamp(min=1 / side**2)
    relief = ((metres - mean) * (10 * known)).clamp(-3, 3)
    down, across = (
        ((torch.arange(count, device=range_m.device) + 0.5) * side - size / 2) / focal_px
        for count, size in zip(mean.shape[2:], (rows, columns), strict=True)
    )
    y, x = (torch.zeros_like(mean) + each for each in (down[:, None], across))
    has = (share > 0).float()
    places = mean / 3 - has, has / mean.clamp(min=0.3), x * mean / 2, y * mean / 2, has, x, y
    values = torch.cat([relief, known, *places], 1).to(layers).contiguous(memory_format=torch.channels_last)
    return Patches(values, share)


def _padded(x: torch.Tensor, down: int, across: int) -> torch.Tensor:
    """Pad [B, C, H, W] by 0 below and at the right until its sides are multiples of `down` and `across`."""
    rows, columns = x.shape[2:]  # `-rows % down` is nothing that torch.compile computes of sizes that vary
    return F.pad(x, (0, (across - columns % across) % across, 0, (down - rows % down) % down))


def _fits_loops(range_m: torch.Tensor, layers: torch.dtype) -> bool:
    """True if the loops know types and device, and only numbers are asked for, no graph and no gradients."""
    if torch.compiler.is_compiling() or torch.jit.is_tracing() or range_m.requires_grad:  # type: ignore[no-untyped-call]
        return False
    return range_m.dtype == torch.float32 and layers in (torch.float32, torch.bfloat16) and in_loops(range_m)


def _by_loops(range_m: torch.Tensor, side: int, layers: torch.dtype, focal_px: float = 0.0) -> Patches:
    loops = import_module("bodyseg_model.networks.patch_loops")
    images, _, rows, columns = range_m.shape
    cells = images, -(-rows // side), -(-columns // side)
    values, share = range_m.new_empty((*cells, 2 * side**2 + (MEASURES if focal_px else 0))), range_m.new_empty(cells)
    metres = range_m[:, 0].contiguous().numpy()
    count = range_m.new_tensor([np.count_nonzero(image > 0) for image in metres])
    mean = body_mean(range_m, count.view(images, 1, 1, 1)).view(images)
    settings = np.float32(RELIEF), side, np.float32(focal_px)
    loops.cut_patches(metres, mean.numpy(), *settings, values.numpy(), share.numpy())
    return Patches(values.permute(0, 3, 1, 2).to(layers), share[:, None])


def _unshuffled(x: torch.Tensor, side: int) -> torch.Tensor:
    """`F.pixel_unshuffle`, [B, C, H, W] -> [B, C side^2, H / side, W / side], copied once, in the layers' format."""
    if torch.onnx.is_in_onnx_export():  # graphs have one operation for it
        return F.pixel_unshuffle(x, side)
    batch, channels, rows, columns = x.shape
    parts = x.reshape(batch, channels, rows // side, side, columns // side, side).permute(0, 2, 4, 1, 3, 5)
    return parts.reshape(batch, rows // side, columns // side, channels * side**2).permute(0, 3, 1, 2)
