"""A score that tells people from things, by the shape of a surface and by how sure a network is of its labels.

The shape is what a camera sees of a surface: ranges over cells of 5 cm, and 16 measures of them. Furniture is flat
where bodies are curved: the second differences of neighbouring cells are near 0 on planes; noise, which is estimated
from pixels, is allowed for. A small convolutional network judges it, for any labelling network, whatever classes that
has. It sees the surface at `CELL_M` a pixel, 48 x 48 of them, in three channels: range from the median, what is
measured, and range from the mean of the 3 x 3 cells around, which shows how a body is curved; and the measures. NumPy
computes its 8 825 weights in a thirtieth of the time of the network that labels bodies: a runtime's threads would take
processors from that one. `weights/shape_network.json` holds the weights, and says how they were made.

Shapes of things that it was not fitted to often look like people to it, and the labelling network is less sure of them:
both together decide (docs/reference/things.md). `tools/bench limits` fits the limit, which a network's card holds.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import Camera
from bodyseg_model.networks import SHIPPED, read_card

MEASURES: Final = (
    "flat share", "flat share down", "flat share across", "curvature down", "curvature across", "median curvature",
    "upper quartile of curvature", "log curved share", "log hollow share", "filled cells", "width", "height", "depth",
    "log area", "area of bounding box", "log area of height squared",
)  # fmt: skip
"""What is measured of a shape, in its order."""

CELL_M: Final = 0.05  # side of the cells over which ranges are averaged, metres
_PIXELS_A_CELL: Final = 5  # a side: of larger cells, only every second, third ... pixel is read
_FEW: Final = 4096  # of the pixels for a median, evenly spaced, no fewer are read
_JUMP_M: Final = 0.15  # greatest difference of range between neighbouring cells of one surface, metres
_LEAST_FILLED: Final = 0.5
_FLAT_M: Final = 0.003
_SIGMAS: Final = 2.0
_MOST_CURVED_M: Final = (0.05, 0.05, 0.05, 0.08)
_LEAST_SHARE: Final = 0.02  # added before logarithms
_MAD: Final = 0.6745 * math.sqrt(6.0)  # median of the second differences of normal noise, in standard deviations

FORMAT: Final = "bodyseg shape network 2"
FILE: Final = "shape_network.json"

SIDE: Final = 48
"""Cells of an image, a side: 2.4 m. Of larger surfaces the middle is seen."""

SHAPES: Final = {
    "layer1.weight": (8, 3, 4, 4),
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

_RANGE_M: Final = 0.4  # from the median, that is 1 in the first channel
_CURVED_M: Final = 0.03  # from the mean around, that is 1 in the third channel
_MOST: Final = 2.0  # in both, either side of 0

Floats = NDArray[np.float64]
Image = NDArray[np.float32]


# The shape of a surface.


@dataclass(frozen=True)
class SurfaceShape:
    """Shape of a surface as the camera sees it. measures: `MEASURES`, float64 [16], all 0 where no pixel is read.

    cells: mean ranges of cells of about `CELL_M` in the surface's bounding box, float64 [h, w], metres, NaN where less
    than half of one is measured. noise_m: standard deviation of a pixel's range, metres, 0 where it cannot be told.
    """

    measures: Floats = field(repr=False)
    cells: Floats = field(repr=False)
    noise_m: float = 0.0


def surface_shape(pixels: NDArray[np.intp], range_m: NDArray[np.float32], camera: Camera) -> SurfaceShape:
    """Describe the shape of a surface.

    pixels: int [N], row * columns + column, ascending, at least one, all measured. range_m: float32 [H, W], metres.
    camera: the frame's.
    """
    pixel_m = _value_at(range_m.ravel()[pixels[:: max(1, len(pixels) // _FEW)]], 0.5) / camera.focal_px
    cell_px = max(2, round(CELL_M / pixel_m))
    step = max(1, cell_px // _PIXELS_A_CELL)
    side = -(-cell_px // step)
    rows, columns = _every(pixels, camera.columns, step)
    if not len(rows):  # a surface narrower than the step
        return SurfaceShape(np.zeros(len(MEASURES)), np.full((1, 1), np.nan))
    z = range_m.ravel().take(step * (rows * camera.columns + columns)).astype(np.float64)
    noise_m = _noise(rows, columns, z) / _MAD
    limit = _FLAT_M + _SIGMAS * math.sqrt(6.0) / side * noise_m
    cells, filled = _mean_cells(rows, columns, z, side)
    down, across = _second_differences(cells), _second_differences(cells.T)
    curvature = np.concatenate([down, across])
    bent = np.abs(curvature)
    curved = _value_at(down, 0.5), _value_at(across, 0.5), _value_at(bent, 0.5), _value_at(bent, 0.75)
    width, height = (
        max(float(np.ptp((places * step + 0.5 - centre) * z)) / camera.focal_px, CELL_M)
        for places, centre in zip((columns, rows), camera.centre_px, strict=True)
    )
    nearest, farthest = (_value_at(z, share) for share in (0.03, 0.97))
    area = float(np.square(z).sum()) * (step / camera.focal_px) ** 2
    measures = [
        *(_share_of(np.abs(each) < limit, 1.0) for each in (curvature, down, across)),
        *(100 * min(each, most) for each, most in zip(curved, _MOST_CURVED_M, strict=True)),
        *(math.log(_share_of(each > limit, 0.0) + _LEAST_SHARE) for each in (curvature, -curvature)),
        filled,
        width,
        height,
        farthest - nearest,
        math.log(area),
        area / (width * height),
        math.log(area / height**2),
    ]
    return SurfaceShape(np.array(measures), cells, noise_m)


def _every(pixels: NDArray[np.intp], width: int, step: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Row and column, divided by `step`, of the pixels of every `step`-th row and column of a frame of `width`."""
    rows = pixels // width
    columns = pixels - rows * width
    if step == 1:
        return rows, columns
    above, left = rows // step, columns // step
    read = (above * step == rows) & (left * step == columns)
    return above[read], left[read]


def _value_at(values: Floats | Image, share: float) -> float:
    """The value below which a share of finite values [N] lies, one of them; 0 without any."""
    if not len(values):
        return 0.0
    place = min(int(share * len(values)), len(values) - 1)
    return float(np.partition(values, place)[place])


def _noise(rows: NDArray[np.intp], columns: NDArray[np.intp], z: Floats) -> float:
    """Median of the second differences, without their signs, of every three neighbours in a row."""
    beside = (columns[2:] - columns[:-2] == 2) & (rows[2:] == rows[:-2])
    return _value_at(np.abs(z[:-2] - 2 * z[1:-1] + z[2:])[beside], 0.5)


def _mean_cells(rows: NDArray[np.intp], columns: NDArray[np.intp], z: Floats, side: int) -> tuple[Floats, float]:
    """Mean ranges of cells of `side` x `side` pixels, NaN where less than half is measured, [h, w]; and of the cells in
    which any is, the share that has a mean.
    """
    rows, columns = (rows - rows[0]) // side, (columns - columns.min()) // side
    shape = int(rows[-1]) + 1, int(columns.max()) + 1
    index = rows * shape[1] + columns
    counts = np.bincount(index, minlength=shape[0] * shape[1]).reshape(shape)
    sums = np.bincount(index, z, minlength=counts.size).reshape(shape)
    filled = counts >= math.ceil(_LEAST_FILLED * side**2)
    means: Floats = np.where(filled, sums / np.maximum(counts, 1), np.nan)
    return means, float(filled.sum() / np.count_nonzero(counts))


def _second_differences(means: Floats) -> Floats:
    """Second differences of cells down, metres, positive where the surface bulges towards the camera."""
    steps = np.diff(means, axis=0)
    smooth = np.abs(steps) < _JUMP_M  # False beside an empty cell
    found: Floats = np.diff(steps, axis=0)[smooth[:-1] & smooth[1:]]
    return found


def _share_of(of: NDArray[np.bool_], without: float) -> float:
    return float(np.count_nonzero(of) / len(of)) if len(of) else without


# The network of shapes.


@dataclass(frozen=True)
class ShapeNetwork:
    """Three convolutions of stride 2, the mean and maximum of each channel, and two linear layers.

    weights: float32 arrays of `SHAPES`. cutoff: least probability of a person, 0 to 1.
    """

    weights: Mapping[str, Image] = field(repr=False)
    cutoff: float

    def __call__(self, shape: SurfaceShape) -> float:
        """Logarithm of the odds that a surface is a person."""
        return self.logit(shape_image(shape.cells), shape.measures)

    def logit(self, image: Image, measures: Floats) -> float:
        """The same of `shape_image`, float32 [2, 48, 48], and of the shape's measures, float64 [16]."""
        image = with_curvature(image)
        for name in ("layer1", "layer2", "layer3"):
            image = np.maximum(_convolved(image, *self._layer(name)), 0)
        flat = image.reshape(len(image), -1)
        (hidden, hidden_bias), (out, out_bias) = self._layer("hidden"), self._layer("out")
        seen = np.concatenate([flat.mean(axis=1), flat.max(axis=1), measures.astype(np.float32)])
        return float((out @ np.maximum(hidden @ seen + hidden_bias, 0) + out_bias)[0])

    def _layer(self, name: str) -> tuple[Image, Image]:
        return self.weights[f"{name}.weight"], self.weights[f"{name}.bias"]


def shape_image(cells: Floats) -> Image:
    """Place a surface's cells in the middle of an image, float32 [2, 48, 48]: range from the median, in units of 0.4 m
    and at most 2 either side, and 1 where it is measured; 0 elsewhere.

    cells: `SurfaceShape.cells`; those that are not finite are not measured.
    """
    image = np.zeros((2, SIDE, SIDE), np.float32)
    known = np.isfinite(cells)
    if known.any():
        from_median = np.clip((cells - np.median(cells[known])) / _RANGE_M, -_MOST, _MOST)
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
    bulge = np.clip((ranges - mean) * known * np.float32(_RANGE_M / _CURVED_M), -_MOST, _MOST)
    return np.concatenate([image, bulge[..., None, :, :]], axis=-3)


def _convolved(image: Image, weight: Image, bias: Image) -> Image:
    """Convolve an image [in, H, W] with stride 2 and one cell of zeros around it, to [out, H / 2, W / 2]."""
    count, height, width = image.shape
    around = np.zeros((count, height + 2, width + 2), np.float32)
    around[:, 1:-1, 1:-1] = image
    windows = sliding_window_view(around, weight.shape[2:], axis=(1, 2))[:, ::2, ::2]
    columns = windows.transpose(0, 3, 4, 1, 2).reshape(weight[0].size, -1)
    sums: Image = weight.reshape(len(weight), -1) @ columns + bias[:, None]
    return sums.reshape(len(weight), height // 2, width // 2)


def network_from_json(tree: Mapping[str, Any]) -> ShapeNetwork:
    """Rebuild a network from plain JSON: its cutoff, and its weights by name in base64 of float32, little-endian."""
    raw = {name: base64.b64decode(tree["weights"][name]) for name in SHAPES}
    weights = {name: np.frombuffer(raw[name], "<f4").reshape(shape) for name, shape in SHAPES.items()}
    return ShapeNetwork(weights, float(tree["cutoff"]))


@cache
def shipped_shape_network() -> ShapeNetwork:
    """The network that ships with the package. Raises BadConfig for a file of another format."""
    tree = json.loads((resources.files("bodyseg_model") / "weights" / FILE).read_text())
    if tree["format"] != FORMAT:
        raise BadConfig(f"{FILE}: 'format' must be {FORMAT!r}, found {tree['format']!r}")
    return network_from_json(tree)


# The score.


CARD_ENTRY: Final = "least_confidence_of_people"
"""Entry of a network's card: the cutoff of its `PersonScore`, which `tools/bench limits` fits."""

_DOUBT: Final = 0.2  # of the odds against a person by shape, as a logarithm
_MOST_DOUBT: Final = 6.0
_NOISE: Final = 0.3
_NOISE_M: Final = 0.02  # from here on, networks are less sure of people
_AREA: Final = 0.9
_AREA_M2: Final = 0.25  # below, too
_NO_DOUBT: Final = -5.0  # logarithm of odds below which a shape without much noise is a thing
_PROBABLE: Final = 1e-4  # a probability's least distance from 0 and 1


class SeenShape(NamedTuple):
    """The shape of a surface: logarithm of the odds that it is a person, noise of its ranges in metres, and area as if
    it faced the camera in square metres.
    """

    odds: float
    noise_m: float
    area_m2: float


@dataclass(frozen=True)
class PersonScore:
    """Score of a surface, 0 to 1, by its shape and by how sure of its labels a network is.

    by_shape: logarithm of the odds of a person by shape. cutoff: least score of a person, 0 to 1. by_confidence: False
    to judge by the shape alone. Raises BadConfig for a cutoff out of range.
    """

    by_shape: Callable[[SurfaceShape], float] = field(repr=False)
    cutoff: float
    by_confidence: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.cutoff, (int, float)) or not 0 <= self.cutoff <= 1:
            raise BadConfig(f"a score of people needs a cutoff from 0 to 1, found {self.cutoff!r}")

    def seen(self, pixels: NDArray[np.intp], range_m: NDArray[np.float32], camera: Camera) -> SeenShape:
        """Judge the shape of one surface. Arguments as of `surface_shape`."""
        shape = surface_shape(pixels, range_m, camera)
        return SeenShape(self.by_shape(shape), shape.noise_m, math.exp(shape.measures[MEASURES.index("log area")]))

    def rules_out(self, shape: SeenShape) -> bool:
        """True for a thing that no network need label."""
        if self.by_confidence:
            return shape.odds < _NO_DOUBT and shape.noise_m < _NOISE_M
        return self(shape) < self.cutoff

    def __call__(self, shape: SeenShape, mean_confidence: float | None = None) -> float:
        """Score one surface. mean_confidence: of the network's labels of it; None to score the shape.

        The score is the confidence of a large surface with little noise whose shape is a person's. A shape counts
        against a person alone: things that its network has not seen often look like people to it. Noise, and a
        small area, excuse low confidence.
        """
        odds = shape.odds
        if self.by_confidence and mean_confidence is not None:
            sure = min(max(mean_confidence, _PROBABLE), 1 - _PROBABLE)
            odds = math.log(sure / (1 - sure)) + _DOUBT * min(max(shape.odds, -_MOST_DOUBT), 0.0)
            odds += _NOISE * math.log(max(shape.noise_m / _NOISE_M, 1.0))
            odds -= _AREA * math.log(min(max(shape.area_m2 / _AREA_M2, _PROBABLE), 1.0))
        return 1 / (1 + math.exp(-min(max(odds, -700.0), 700.0)))


def shipped_score(card: Mapping[str, Any] | None = None) -> PersonScore:
    """The score that ships with the package, for the network of a card (`Trained.card`).

    card: by default that of the network that ships. Without an entry `CARD_ENTRY` the shape alone decides. Raises
    BadConfig as `shipped_shape_network` and `PersonScore`.
    """
    network, cutoff = shipped_shape_network(), (read_card(SHIPPED) if card is None else card).get(CARD_ENTRY)
    return PersonScore(network, network.cutoff) if cutoff is None else PersonScore(network, cutoff, True)
