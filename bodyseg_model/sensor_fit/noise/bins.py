"""Variances of residuals in bins of range and incidence, less what rounding adds to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_model.sensor_fit.noise.residuals import Residuals
from bodyseg_model.sensor_fit.rounding import Steps

_INCIDENCES_DEG: Final = (0, 15, 25, 35, 45, 52, 58, 64, 69, 74, 78, 82)
_MOST_DEG: Final = 78.0  # windows see folds as steeper than neighbouring pixels, whose slopes make the noise
_RANGES: Final = 6
_FEWEST_IN_BIN: Final = 200
_RELIEF: Final = 0.1  # pixels: what a surface of some slope adds to third differences, as if pixels had moved
_OUTLIER: Final = 8.0  # deviations: pixels of one bin differ in theirs, and the noisiest count
_MODEL_ERROR: Final = 0.02  # of a variance: the surface's own errors
_ROUNDING_ERROR: Final = 0.3  # of the variance of rounding, whose phases need not be even

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class NoiseBins:
    """Squares of deviations, arrays [N]: variance_mm2 less rounding, with error_mm2; means of the pixels: range_m,
    slope2_mm2 (squared slope, millimetres a pixel), ratio = incidence / (pi / 2 - incidence), ratio2 its square; count:
    residuals.
    """

    variance_mm2: Floats
    error_mm2: Floats
    range_m: Floats
    slope2_mm2: Floats
    ratio: Floats
    ratio2: Floats
    count: NDArray[np.int64]


def bin_noise(residuals: Sequence[Residuals], steps: Steps, ragged: bool) -> NoiseBins:
    """Squares of deviations by range and incidence, outliers clipped, less the variance of rounding.

    A bin's deviation is by the mean size of its residuals, which for normal ones is the mean of the pixels' deviations,
    however these differ within the bin; axial noise is linear in it. By the mean square where ragged, since
    jitter is not normal, and where noise is below the step.
    """
    rows: list[tuple[float, ...]] = []
    last = len(_INCIDENCES_DEG) - 1 if ragged else _INCIDENCES_DEG.index(_MOST_DEG)
    for kind in ("temporal", "spatial"):
        chosen = [each for each in residuals if each.kind == kind]
        if not chosen:
            continue
        value, z, slope, angle = (
            np.concatenate([getattr(each, name) for each in chosen])
            for name in ("residual_m", "range_m", "slope_m", "incidence_rad")
        )
        edges = np.unique(np.quantile(z, np.linspace(0, 1, _RANGES + 1)))
        by_range = np.clip(np.searchsorted(edges, z, "right") - 1, 0, max(len(edges) - 2, 0))
        by_angle = np.digitize(np.degrees(angle), _INCIDENCES_DEG) - 1
        order = np.argsort(by_range * 100 + by_angle, kind="stable")
        groups = np.split(order, np.flatnonzero(np.diff((by_range * 100 + by_angle)[order])) + 1)
        for group in groups:
            if len(group) < _FEWEST_IN_BIN or by_angle[group[0]] >= last:
                continue
            step = float(np.mean(steps.at(z[group])))
            measured = clipped_variance(value[group], step)
            if not ragged and measured > step**2:
                measured = _by_size(value[group], measured)
            variance = unrounded(measured, step, kind == "temporal")
            ratio = angle[group] / (np.pi / 2 - angle[group])
            error = np.hypot(measured * np.sqrt(3 / len(group)), _MODEL_ERROR * measured)
            if kind == "spatial":  # third differences keep what is left of a steep surface's own shape
                error += _RELIEF**2 * float((slope[group] ** 2).mean())
            # Noise larger than the step spreads values evenly over it; then the variance of rounding is exact.
            error += _ROUNDING_ERROR * step**2 / 12 * np.exp(-10 * variance / step**2)
            rows.append(
                (
                    variance * 1e6,
                    error * 1e6,
                    float(z[group].mean()),
                    float((slope[group] ** 2).mean()) * 1e6,
                    float(ratio.mean()),
                    float((ratio**2).mean()),
                    len(group),
                )
            )
    table = np.array(rows).reshape(-1, 7).T
    variance_mm2, error_mm2, range_m, slope2_mm2, mean_ratio, ratio2, count = table
    return NoiseBins(variance_mm2, error_mm2, range_m, slope2_mm2, mean_ratio, ratio2, count.astype(np.int64))


def unrounded(variance: float, step: float, temporal: bool) -> float:
    """The variance of noise before values were rounded to a step, in the same unit; at least 0.

    variance: of one frame's residuals, or half the mean square of two frames' differences (temporal). Two roundings of
    one true value are often equal, so the latter falls below the noise where the step is coarse.
    """
    if not temporal or variance > step**2:
        return max(variance - step**2 / 12, 0.0) if not temporal else max(variance - step**2 / 6 / 2, 0.0)
    low, high = 0.0, 2 * step
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if _rounded_variance(middle / step) * step**2 < variance else (low, middle)
    return low**2


def _rounded_variance(sigma: float) -> float:
    """Half the mean square difference of two noisy values of one truth, rounded to whole numbers; even phases."""
    if sigma <= 0:
        return 0.0
    size = np.linspace(0, 8, 1601) * sigma * np.sqrt(2)
    density = np.exp(-0.5 * np.linspace(0, 8, 1601) ** 2)
    whole, part = np.floor(size), size % 1
    square = whole**2 * (1 - part) + (whole + 1) ** 2 * part
    return float((density * square).sum() / density.sum() / 2)


def _by_size(values: Floats, variance: float) -> float:
    """The squared deviation by the mean size of normal residuals; variance: of them, for what is an outlier."""
    size = np.abs(values)
    return float(np.pi / 2 * np.mean(size[size <= _OUTLIER * np.sqrt(variance)]) ** 2)


def clipped_variance(values: Floats, step: float) -> float:
    """The mean square of residuals, those beyond 4.5 deviations left out; step: of their rounding, in their unit."""
    limit = 4.5 * max(1.4826 * float(np.median(np.abs(values))), step / 3)
    for _ in range(4):
        kept = values[np.abs(values) <= limit]
        sigma = float(np.sqrt(np.mean(kept**2))) if len(kept) else 0.0
        limit = 4.5 * max(sigma, step / 3)
    return sigma**2
