"""A small convolutional network that tells people from things by the shape of a surface alone.

It sees the surface at `CELL_M` a pixel, 48 x 48 of them, in three channels: range from the median, what is measured,
and range from the mean of the 3 x 3 cells around, which shows how a body is curved; and the measures of the shape. With
8 825 weights it takes 0.08 ms a surface, a hundredth of the network that labels bodies. Compiled loops compute it, or
NumPy, with sums in one order: a runtime's threads would take processors from that network.

`shape_network.json` holds the weights; `tools/bench shapes` fits them on made rooms (docs/reference/things.md).
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module, resources
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.kernels import use_compiled
from bodyseg_model.segmentation.people.surface_shape import MEASURES, SurfaceShape

FORMAT: Final = "bodyseg shape network 2"
FILE: Final = "shape_network.json"

SIDE: Final = 48
"""Cells of an image, a side: 2.4 m. Of larger surfaces the middle is seen."""

CHANNELS: Final = 3

SHAPES: Final = {
    "layer1.weight": (8, CHANNELS, 4, 4),
    "layer1.bias": (8,),
    "layer2.weight": (16, 8, 3, 3),
    "layer2.bias": (16,),
    "layer3.weight": (32, 16, 3, 3),
    "layer3.bias": (32,),
    "hidden.weight": (32, 2 * 32 + len(MEASURES)),
    "hidden.bias": (32,),
    "out.weight": (1, 32),
    "out.bias": (1,),
}
"""Names and shapes of the weights, as PyTorch's `Conv2d` [out, in, rows, columns] and `Linear` [out, in] have them."""

RANGE_M: Final = 0.4
"""Range from the median that is 1 in the first channel, metres."""

CURVED_M: Final = 0.03
"""Range from the mean around that is 1 in the third channel, metres."""

MOST: Final = 2.0
"""Most in the first and third channels, either side of 0."""

_LAYERS: Final = ("layer1", "layer2", "layer3", "hidden", "out")

_BYTES: Final = {name: 4 * math.prod(shape) for name, shape in SHAPES.items()}

Image = NDArray[np.float32]


@dataclass(frozen=True)
class ShapeNetwork:
    """Three convolutions of stride 2, the mean and maximum of each channel, and two linear layers.

    weights: float32 arrays of `SHAPES`. cutoff: least probability of a person, 0 to 1. Raises BadConfig for other
    weights.
    """

    weights: Mapping[str, Image] = field(repr=False)
    cutoff: float

    def __post_init__(self) -> None:
        if {name: weight.shape for name, weight in self.weights.items()} != SHAPES:
            raise BadConfig(f"a network of shapes needs the weights {', '.join(SHAPES)}, of the sizes of this version")

    def __call__(self, shape: SurfaceShape) -> float:
        """Logarithm of the odds that a surface is a person."""
        return self.logit(shape_image(shape.cells), shape.measures)

    def logit(self, image: Image, measures: NDArray[np.float64]) -> float:
        """The same of `shape_image`, float32 [2, 48, 48], and of the shape's measures, float64 [16]."""
        layers = [(self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]) for name in _LAYERS]
        numbers = measures.astype(np.float32)
        return float(_loops().logit(image, numbers, *layers) if use_compiled() else _logit(image, numbers, *layers))


def shape_image(cells: NDArray[np.float64]) -> Image:
    """Place a surface's cells in the middle of an image, float32 [2, 48, 48]: range from the median, in units of 0.4 m
    and at most 2 either side, and 1 where it is measured; 0 elsewhere.

    cells: `SurfaceShape.cells`.
    """
    image = np.zeros((2, SIDE, SIDE), np.float32)
    if use_compiled():
        _loops().place_cells(cells, image)
        return image
    known = np.isfinite(cells)
    if known.any():
        from_median = np.clip((cells - np.median(cells[known])) / RANGE_M, -MOST, MOST)
        (down, rows), (across, columns) = (_middle(size) for size in cells.shape)
        image[0, down, across] = np.where(known, from_median, 0)[rows, columns]
        image[1, down, across] = known[rows, columns]
    return image


def _middle(size: int) -> tuple[slice, slice]:
    """Slices of an image's side and of the `size` cells of a surface that are placed there."""
    shown = min(size, SIDE)
    return slice((SIDE - shown) // 2, (SIDE + shown) // 2), slice((size - shown) // 2, (size + shown) // 2)


def with_curvature(image: Image) -> Image:
    """Append a channel to images [..., 2, H, W]: range from the mean of the measured cells of 3 x 3, in units of 3 cm
    and at most 2 either side, 0 where nothing is measured.
    """
    ranges, known = image[..., 0, :, :], image[..., 1, :, :]
    height, width = known.shape[-2:]
    around = np.zeros((*image.shape[:-2], height + 2, width + 2), np.float32)  # both channels at once
    around[..., 1:-1, 1:-1] = image * known[..., None, :, :]
    rows = around[..., :-2, :] + around[..., 1:-1, :] + around[..., 2:, :]
    nine = rows[..., :-2] + rows[..., 1:-1] + rows[..., 2:]
    mean = nine[..., 0, :, :] / np.maximum(nine[..., 1, :, :], 1)
    bulge = np.clip((ranges - mean) * known * np.float32(RANGE_M / CURVED_M), -MOST, MOST)
    return np.concatenate([image, bulge[..., None, :, :]], axis=-3)


@cache
def _loops() -> Any:
    """The compiled loops, in a module that needs numba."""
    return import_module("bodyseg_model.segmentation.people.shape_network_loops")


def _logit(image: Image, measures: Image, *layers: tuple[Image, Image]) -> np.float32:
    """The NumPy form of `ShapeNetwork.logit`; layers: weight and bias of each. Sums are taken from first to last."""
    *halves, hidden, (weight, bias) = layers
    image = with_curvature(image)
    for half in halves:
        image = _half(image, *half)
    flat = image.reshape(len(image), -1)
    mean = np.cumsum(flat, axis=1)[:, -1] / np.float32(flat.shape[1])
    seen = np.concatenate([mean, flat.max(axis=1), measures])
    sums = np.cumsum(hidden[0] * seen, axis=1)[:, -1]
    answer: np.float32 = np.cumsum(weight[0] * np.maximum(sums + hidden[1], 0))[-1] + bias[0]
    return answer


def _half(image: Image, weight: Image, bias: Image) -> Image:
    """Convolve an image [in, H, W] with stride 2 and one cell of zeros around it; of the sums [out, H / 2, W / 2] those
    below 0 become 0.
    """
    count, height, width = image.shape
    side = weight.shape[2]
    around = np.zeros((count, height + 2, width + 2), np.float32)
    around[:, 1:-1, 1:-1] = image
    columns = np.empty((count, side, side, height // 2, width // 2), np.float32)
    for row in range(side):
        for column in range(side):
            columns[:, row, column] = around[:, row : row + height - 1 : 2, column : column + width - 1 : 2]
    terms = weight.reshape(len(weight), -1, 1) * columns.reshape(weight[0].size, -1)
    sums = terms.sum(axis=1)  # from first to last, as of any axis but the last
    halved: Image = np.maximum(sums + bias[:, None], 0).reshape(len(weight), height // 2, width // 2)
    return halved


def network_to_json(network: ShapeNetwork) -> dict[str, Any]:
    """A network as plain JSON, weights by name in base64 of float32, little-endian."""
    weights = {
        name: base64.b64encode(np.asarray(weight, "<f4").tobytes()).decode() for name, weight in network.weights.items()
    }
    return {"cutoff": round(network.cutoff, 4), "weights": weights}


def network_from_json(tree: Mapping[str, Any]) -> ShapeNetwork:
    """Rebuild a network from what `network_to_json` gave. Raises BadConfig for weights of other names or sizes."""
    raw = {name: base64.b64decode(text) for name, text in tree["weights"].items()}
    if {name: len(each) for name, each in raw.items()} != _BYTES:
        raise BadConfig(f"the weights in {FILE} are not those of this version's network")
    weights = {name: np.frombuffer(raw[name], "<f4").reshape(shape) for name, shape in SHAPES.items()}
    return ShapeNetwork(weights, float(tree["cutoff"]))


@cache
def shipped_shape_network() -> ShapeNetwork:
    """The network that ships with the package. Raises BadConfig for a file of another format."""
    tree = json.loads((resources.files(__package__) / FILE).read_text())
    if tree["format"] != FORMAT:
        raise BadConfig(f"{FILE}: 'format' must be {FORMAT!r}, found {tree['format']!r}")
    return network_from_json(tree)
