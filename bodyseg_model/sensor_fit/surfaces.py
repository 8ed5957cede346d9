"""Local surfaces in range images: a quadratic through each pixel's neighbours, and differences that cancel it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.surface import box_of
from bodyseg_data.core.rig import Camera

Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]

_POWERS: Final = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
_FULL: Final = 0.5
"""Least share of a window's pixels that must be measured for a fit."""


@dataclass(frozen=True)
class Surface:
    """A smooth surface in a range image, all arrays [H, W].

    range_m: metres, NaN where there were too few pixels. slope_m: metres a pixel, the length of the gradient.
    incidence_rad: the angle between a pixel's ray and the surface's normal, by the smaller differences to its
    neighbours as artifacts take it (`bodyseg_data.artifacts.surface.slants`). misfit_m: standard deviation of the
    pixels around the surface within the window.
    """

    range_m: Floats
    slope_m: Floats
    incidence_rad: Floats
    misfit_m: Floats

    def at(self, known: Mask) -> Mask:
        """The pixels of `known` at which there is a surface."""
        return known & np.isfinite(self.range_m)


def smooth_surface(range_m: NDArray[np.floating], known: Mask, camera: Camera, radius: int) -> Surface:
    """Fit a quadratic in row and column to the known pixels of each window, 2 radius + 1 pixels a side.

    range_m: [H, W], metres. known: bool [H, W], the pixels to fit, of one continuous surface as far as can be told.
    """
    inside = box_of(known, radius)
    if inside is None:
        empty = np.full(range_m.shape, np.nan)
        return Surface(empty, empty.copy(), empty.copy(), empty.copy())
    weight = known[inside].astype(np.float64)
    # About their middle, so that squares lose no digits.
    middle = float(np.median(range_m[known]))
    image = np.where(known[inside], range_m[inside].astype(np.float64) - middle, 0)
    offsets = np.arange(-radius, radius + 1, dtype=np.float64)
    columns = [_along(weight, offsets**power, 1) for power in range(5)]
    moments = {(i, j): _along(columns[i], offsets**j, 0) for i in range(5) for j in range(5 - i)}
    sides = [_along(image, offsets**power, 1) for power in range(3)]
    right = np.stack([_along(sides[i], offsets**j, 0) for i, j in _POWERS], -1)
    square = _along(_along(image**2, offsets**0, 1), offsets**0, 0)
    enough = moments[0, 0] >= max(_FULL * len(offsets) ** 2, len(_POWERS) + 3)
    few = {power: moment[enough] for power, moment in moments.items()}
    matrix = np.stack([np.stack([few[a + c, b + d] for c, d in _POWERS], -1) for a, b in _POWERS], -2)
    fitted = np.full((*enough.shape, 6), np.nan)
    scale = np.array([float(radius) ** (i + j) for i, j in _POWERS])
    scaled = matrix / (scale[:, None] * scale)
    scaled += 1e-9 * few[0, 0][:, None, None] * np.eye(6)
    fitted[enough] = np.linalg.solve(scaled, (right[enough] / scale)[..., None])[..., 0] / scale
    rest = np.maximum(square - (fitted * right).sum(-1), 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        misfit = np.sqrt(rest / (moments[0, 0] - len(_POWERS)))
    value, across, down = fitted[..., 0] + middle, fitted[..., 1], fitted[..., 2]
    full = [np.full(range_m.shape, np.nan) for _ in range(4)]
    least = (_smaller(across, fitted[..., 3]), _smaller(down, fitted[..., 5]))
    parts = (value, np.hypot(across, down), _incidence(value, *least, camera, inside), misfit)
    for whole, part in zip(full, parts, strict=True):
        whole[inside] = part
    return Surface(*full)


def third_differences(range_m: NDArray[np.floating], known: Mask) -> tuple[Floats, NDArray[np.intp]]:
    """Third differences along rows and columns, scaled so that independent noise of the pixels keeps its deviation.

    Returns the differences [N], in the unit of range_m, and their pixels [N], flat indices. Quadratic surfaces cancel:
    (1, -3, 3, -1) / sqrt(20).
    """
    values, pixels = [], []
    index = np.arange(known.size).reshape(known.shape)
    image = range_m.astype(np.float64)
    for a, m, i in ((image, known, index), (image.T, known.T, index.T)):
        usable = m[:, :-3] & m[:, 1:-2] & m[:, 2:-1] & m[:, 3:]
        third = (a[:, :-3] - a[:, 3:] + 3 * (a[:, 2:-1] - a[:, 1:-2])) / np.sqrt(20)
        values.append(third[usable])
        pixels.append(i[:, 1:-2][usable])
    return np.concatenate(values), np.concatenate(pixels)


def _smaller(slope: Floats, bend: Floats) -> Floats:
    """The smaller one of the differences slope + bend and slope - bend to a pixel's two neighbours."""
    forward, backward = slope + bend, slope - bend
    smaller: Floats = np.where(np.abs(forward) <= np.abs(backward), forward, backward)
    return smaller


def _incidence(value: Floats, across: Floats, down: Floats, camera: Camera, box: tuple[slice, slice]) -> Floats:
    """Angle between ray and normal, radians: the normal of z(u, v) is (-f z_u, -f z_v, z + u z_u + v z_v)."""
    v = (np.arange(camera.rows)[box[0]] + 0.5 - camera.centre_px[1])[:, None]
    u = (np.arange(camera.columns)[box[1]] + 0.5 - camera.centre_px[0])[None]
    focal = camera.focal_px
    normal = np.sqrt((focal * across) ** 2 + (focal * down) ** 2 + (value + u * across + v * down) ** 2)
    ray = np.sqrt(1 + (u / focal) ** 2 + (v / focal) ** 2)
    angle: Floats = np.arccos(np.clip(value / (normal * ray), 0, 1))
    return angle


def _along(image: Floats, kernel: Floats, axis: int) -> Floats:
    """Correlate with a kernel of odd length along one axis; the world outside the image is 0."""
    from scipy.ndimage import correlate1d

    found: Floats = correlate1d(image, kernel, axis, mode="constant")
    return found
