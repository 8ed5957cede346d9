"""The paper's network (section 3.4, Fig. 4) in plain NumPy, layer by layer, slow and without PyTorch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Array = NDArray[np.float64]


def figure_4(weights: Mapping[str, Array], range_m: Array, normalise: bool) -> Array:
    """Scores of every pixel without dropout, float64 [classes, H, W].

    weights: by the names of `FcnAlexnet`'s state; upfeat's are not looked at. range_m: [H, W] metres. normalise:
    AlexNet's local response normalisation after conv1 and conv2.
    """

    def layer(name: str, x: Array, **how: int) -> Array:
        return np.maximum(convolved(x, weights[f"{name}.weight"], weights[f"{name}.bias"], **how), 0)

    def normalised(x: Array) -> Array:
        return response_normalised(x) if normalise else x

    x = layer("conv1", 50 * range_m[None], stride=4, padding=100)
    x = pooled(normalised(x))
    x = pooled(normalised(layer("conv2", x, padding=2, groups=2)))
    x = layer("conv3", x, padding=1)
    x = layer("conv4", x, padding=1, groups=2)
    x = pooled(layer("conv5", x, padding=1, groups=2))
    x = layer("conv7", layer("conv6", x))
    x = interpolated(layer("conv8", x), *range_m.shape)
    return convolved(x, weights["score.weight"], weights["score.bias"])


def convolved(x: Array, weight: Array, bias: Array, *, stride: int = 1, padding: int = 0, groups: int = 1) -> Array:
    """Cross-correlation of x [C, H, W] with weight [out, C / groups, k, k], plus bias [out]."""
    size = weight.shape[-1]
    x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
    windows = sliding_window_view(x, (size, size), axis=(1, 2))[:, ::stride, ::stride]
    parts: list[Any] = [
        np.einsum("chwij,ocij->ohw", inputs, filters, optimize=True)
        for inputs, filters in zip(np.split(windows, groups), np.split(weight, groups), strict=True)
    ]
    found: Array = np.concatenate(parts) + bias[:, None, None]
    return found


def pooled(x: Array) -> Array:
    """Largest of windows of 3 x 3, two apart; a last window that is not full counts, as in Caffe."""
    rows, columns = (-(-(side - 3) // 2) for side in x.shape[1:])
    x = np.pad(x, ((0, 0), (0, 2), (0, 2)), constant_values=-np.inf)
    found: Array = sliding_window_view(x, (3, 3), axis=(1, 2))[:, ::2, ::2].max(axis=(-1, -2))
    return found[:, : rows + 1, : columns + 1]


def response_normalised(x: Array) -> Array:
    """Krizhevsky's normalisation across five neighbouring channels, with the constants of Caffe's AlexNet."""
    squares = np.pad(x**2, ((2, 2), (0, 0), (0, 0)))
    around = sliding_window_view(squares, 5, axis=0).sum(axis=-1)
    found: Array = x / (1 + 1e-4 / 5 * around) ** 0.75
    return found


def interpolated(x: Array, height: int, width: int) -> Array:
    """Upfeat and Crop: a transposed convolution, bilinear of 63 x 63 with stride 32, without its first 18 pixels."""
    slope = 1 - np.abs(np.arange(63) - 31) / 32
    fine = np.zeros((len(x), 32 * x.shape[1] + 31, 32 * x.shape[2] + 31))
    for row in range(x.shape[1]):
        for column in range(x.shape[2]):
            place = fine[:, 32 * row : 32 * row + 63, 32 * column : 32 * column + 63]
            place += x[:, row, column, None, None] * np.outer(slope, slope)
    return fine[:, 18 : 18 + height, 18 : 18 + width]
