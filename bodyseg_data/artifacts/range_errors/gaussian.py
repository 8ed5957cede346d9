"""Gaussian errors with a standard deviation for each pixel."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.artifact import RangeImage, Scene
from bodyseg_data.artifacts.noise import as_range, drawn_normals
from bodyseg_data.core.kernels import use_compiled
from bodyseg_data.core.randomness import Draws


def clean_metres(scene: Scene) -> NDArray[np.float32]:
    """The clean range of each of the scene's pixels, metres, [N]."""
    steps = scene.sample.range.reshape(-1)[scene.pixels]
    return steps.astype(np.float32) * np.float32(scene.step_m)


def add_gaussian(image: RangeImage, scene: Scene, draws: Draws, purpose: str, sigma_m: NDArray[np.float32]) -> None:
    """Add Gaussian noise to the image's range in place, but for lost pixels.

    sigma_m: of each of the scene's pixels, metres, [N]. Rounds to the nearest step and stays within 1 .. 65535, as
    `noise.add_noise`.
    """
    ranges, pixels = image.range.reshape(-1), scene.pixels
    normals = drawn_normals(draws, purpose, len(pixels))
    if use_compiled():
        loops().add_gaussian(ranges, pixels, normals, sigma_m, np.float32(scene.step_m))
        return
    before = ranges[pixels]
    steps = normals * (sigma_m / np.float32(scene.step_m))
    ranges[pixels] = np.where(before > 0, as_range(before.astype(np.float32) + steps), 0)


def loops() -> Any:
    """The compiled forms; they load numba, so not before they are used."""
    return import_module("bodyseg_data.artifacts.loops.range_errors")
