"""Fold patterns of cloth: waves on the surface of a person at rest, one pattern for each direction of compression."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.randomness import generator

Floats = NDArray[np.float64]

DIRECTIONS: Final = (0.0, 0.25 * np.pi, 0.5 * np.pi, 0.75 * np.pi)
"""Angles from the garment's axis across which the patterns wave: rings, two diagonals, lengthwise folds."""

_ACROSS: Final = 0.55  # half-widths of a kernel, in wavelengths: across its waves, along them, through the body
_ALONG: Final = 2.8
_THROUGH: Final = 0.8
_REACH: Final = 5.0  # wavelengths, beyond which a kernel has faded
_OVERLAP: Final = 2.5  # kernels over each point
_WAVE_SPREAD: Final = 0.25  # standard deviation of a kernel's log wavelength, and of its angle in radians
_QUIET: Final = 0.3  # energy, compared with one kernel's, below which the surface is smooth


def fold_patterns(points: Floats, normals: Floats, axes: Floats, areas: Floats, wave_m: float, seed: int) -> Floats:
    """Make Gabor noise on a surface (Lagae et al. 2009), a pattern for each of DIRECTIONS: float64 [N, 4], -1 to 1.

    points, normals, axes: float64 [N, 3]; axes are tangent unit vectors. areas: [N], of surface around each point.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    patterns = np.zeros((len(points), len(DIRECTIONS)))
    count = max(1, round(_OVERLAP * areas.sum() / (np.pi * _ACROSS * _ALONG * wave_m**2)))
    for column, angle in enumerate(DIRECTIONS):
        draws = generator(seed, 0, "open/clothes", f"folds {column}")
        centres = np.searchsorted(np.cumsum(areas), draws.random(count) * areas.sum())
        waves = wave_m * np.exp(_WAVE_SPREAD * draws.standard_normal(count))
        turns = angle + _WAVE_SPREAD * draws.standard_normal(count)
        phases = 2 * np.pi * draws.random(count)
        value, energy = np.zeros(len(points)), np.full(len(points), _QUIET)
        for centre, wave, turn, phase in zip(centres, waves, turns, phases, strict=True):
            near = np.array(tree.query_ball_point(points[centre], _REACH * wave))
            axis, around = axes[centre], np.cross(normals[centre], axes[centre])
            ways = [np.cos(turn) * axis + np.sin(turn) * around, np.cos(turn) * around - np.sin(turn) * axis]
            across, along, through = np.stack([*ways, normals[centre]]) @ (points[near] - points[centre]).T / wave
            fade = np.exp(-0.5 * ((across / _ACROSS) ** 2 + (along / _ALONG) ** 2 + (through / _THROUGH) ** 2))
            fade *= np.maximum(normals[near] @ normals[centre], 0)  # the far side of a limb folds by itself
            value[near] += fade * np.cos(2 * np.pi * across + phase)
            energy[near] += fade**2
        patterns[:, column] = _ridged(value / np.sqrt(energy))
    return patterns


def _ridged(waves: Floats) -> Floats:
    """Turn waves into the narrow ridges and wide valleys of folded cloth, with a mean near 0."""
    return (np.exp(1.43 * waves) - 1.9) / 2.2
