"""Least squares with positive parameters, by damped Gauss-Newton steps (Levenberg, 1944; Marquardt, 1963)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Model = Callable[[dict[str, float]], Floats]

_STEPS: Final = 200
_STARTS: Final = (1.0, 0.1, 5.0)


@dataclass(frozen=True)
class Fit:
    """Parameters by name with their standard errors, and chi squared."""

    parameters: Mapping[str, tuple[float, float]]
    chi2: float


def fit_positive(names: Sequence[str], model: Model, measured: Floats, errors: Floats) -> Fit:
    """Fit a model's parameters, none below 0, to measured values [N] with standard errors [N].

    model: parameters by name -> values [N]. The best of several starts; errors of the parameters are from the Jacobian,
    widened where the fit is worse than the errors say.
    """
    best: tuple[Floats, float] | None = None
    for start in _STARTS:
        found = _descend(np.full(len(names), start), names, model, measured, errors)
        if best is None or found[1] < best[1]:
            best = found
    point, chi2 = best if best is not None else (np.zeros(len(names)), float("inf"))
    jacobian = _jacobian(point, names, model, errors)
    freedom = max(len(measured) - len(names), 1)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * max(1.0, chi2 / freedom)
    spread = np.sqrt(np.maximum(np.diag(covariance), 0))
    return Fit({name: (float(v), float(e)) for name, v, e in zip(names, point, spread, strict=True)}, chi2)


def _descend(
    point: Floats, names: Sequence[str], model: Model, measured: Floats, errors: Floats
) -> tuple[Floats, float]:
    damping, misfit = 1e-2, _misfit(point, names, model, measured, errors)
    chi2 = float(misfit @ misfit)
    for _ in range(_STEPS):
        jacobian = _jacobian(point, names, model, errors)
        normal = jacobian.T @ jacobian
        step = np.linalg.lstsq(normal + damping * (np.diag(np.diag(normal)) + 1e-12), jacobian.T @ misfit, rcond=None)
        trial = np.maximum(point + step[0], 0.0)
        tried = _misfit(trial, names, model, measured, errors)
        if (value := float(tried @ tried)) < chi2:
            done = chi2 - value < 1e-9 * chi2
            point, misfit, chi2, damping = trial, tried, value, damping / 3
            if done:
                break
        else:
            damping *= 4
            if damping > 1e12:
                break
    return point, chi2


def _misfit(point: Floats, names: Sequence[str], model: Model, measured: Floats, errors: Floats) -> Floats:
    return (measured - model(dict(zip(names, point.tolist(), strict=True)))) / errors


def _jacobian(point: Floats, names: Sequence[str], model: Model, errors: Floats) -> Floats:
    columns, before = [], model(dict(zip(names, point.tolist(), strict=True)))
    for index in range(len(names)):
        width = 1e-5 * max(float(point[index]), 1e-2)
        shifted = point.copy()
        shifted[index] += width
        columns.append((model(dict(zip(names, shifted.tolist(), strict=True))) - before) / width / errors)
    return np.stack(columns, 1)
