"""Noise of range against range and incidence: variances in bins, and the simplest formula that explains them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, UNKNOWN, Estimate, Finding, rounded
from bodyseg_model.sensor_fit.residuals import Residuals, Steps

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


FROM_M: Final = 0.4
"""Range at which the quadratic term begins."""

LEAST_RESIDUALS: Final = 2000
LEAST_MM: Final = 0.3
"""Least noise that is told from the relief of a surface, millimetres."""

LEAST_PX: Final = 0.3
"""Least jitter, pixels: offsets are of whole pixels, and hardly any is of less."""

NAMES: Final = ("noise", "axial_noise", "stereo_noise", "lateral_noise")

_RELIEF_PX: Final = 0.25  # less growth with slope within one frame, as if pixels had moved, may be the shape of limbs
_RELIEF_PART: Final = 0.1  # of the noise in pixels: edges that it hides are in the residuals, more by more
_WORTH: Final = 12.0  # of chi squared, that one more parameter must explain
_VARYING: Final = 0.06  # spread of the frames' deviations, as a share, from which noise differs between frames
_ANY_BASELINE_M: Final = 0.1
_SHARED: Final = 1.5  # of the deviation between neighbours: more around a surface is not of single pixels
_PART: Final = 0.2  # of all noise: less beside jitter may be the rounding of jitter to whole pixels
_STARTS: Final = (1.0, 0.1, 5.0)
_NOTHING: Final = 1e-6  # of any parameter, millimetres or pixels
_TOLD: Final = 0.5  # largest relative error of a strength that is written


@dataclass(frozen=True)
class NoiseFit:
    """Parameters by name with their standard errors, and chi squared."""

    parameters: Mapping[str, tuple[float, float]]
    chi2: float


def fit_positive(
    names: Sequence[str], model: Callable[[dict[str, float]], Floats], measured: Floats, errors: Floats
) -> NoiseFit:
    """Fit a model's parameters, none below 0, to measured values [N] with standard errors [N].

    model: parameters by name -> values [N]. The best of several starts; errors of the parameters are from the Jacobian,
    widened where the fit is worse than the errors say.
    """
    from scipy.optimize import least_squares

    def misfit(point: Floats) -> Floats:
        found: Floats = (measured - model(dict(zip(names, point.tolist(), strict=True)))) / errors
        return found

    found = min(
        (least_squares(misfit, np.full(len(names), start), bounds=(0, np.inf), x_scale="jac") for start in _STARTS),
        key=lambda each: float(each.cost),
    )
    # The method stays within the bounds: a parameter that makes no difference from 0 is 0.
    point = np.where(found.x < _NOTHING, 0.0, found.x)
    chi2 = 2 * float(found.cost)
    freedom = max(len(measured) - len(names), 1)
    covariance = np.linalg.pinv(found.jac.T @ found.jac) * max(1.0, chi2 / freedom)
    spread = np.sqrt(np.maximum(np.diag(covariance), 0))
    return NoiseFit({name: (float(v), float(e)) for name, v, e in zip(names, point, spread, strict=True)}, chi2)


def measure_noise(
    residuals: Sequence[Residuals], steps: Steps, focal_px: float, baseline_m: float | None, ragged: bool
) -> list[Finding]:
    """Findings of "noise", "axial_noise", "stereo_noise" and "lateral_noise".

    focal_px, baseline_m: of the sensor, for the subpixel of stereo noise; None where no baseline is known. ragged:
    whether outlines lose pixels, as they must where pixels jitter; otherwise noise on slopes is laid to incidence.
    """
    count = sum(len(each.residual_m) for each in residuals)
    if count < LEAST_RESIDUALS:
        reason = f"{count} residuals are too few, {LEAST_RESIDUALS} are needed"
        return [Finding(name, UNKNOWN, reason) for name in NAMES]
    bins = bin_noise(residuals, steps, ragged)
    if not len(bins.count):
        return [Finding(name, UNKNOWN, "no range has enough pixels of one incidence") for name in NAMES]
    weight = bins.count / bins.count.sum()
    typical = float(np.sqrt(max((weight * bins.variance_mm2).sum(), 0.0)))
    step = float((weight * steps.at(bins.range_m)).sum()) * 1000
    seen = (bins.variance_mm2 > 3 * bins.error_mm2) & (bins.variance_mm2 > LEAST_MM**2)
    if (bins.count * seen).sum() < LEAST_RESIDUALS // 2:
        return _none_seen(typical, step, bins)
    varying = _varying(residuals, steps)
    if varying is not None:
        return varying
    return _chosen(bins, residuals, focal_px, baseline_m, ragged)


def _none_seen(typical: float, step: float, bins: NoiseBins) -> list[Finding]:
    nearest, farthest = bins.range_m.min(), bins.range_m.max()
    most = max(float(np.sqrt(np.median(bins.error_mm2)) * 2), LEAST_MM)
    coarse = step / np.sqrt(12) > LEAST_MM
    if coarse:
        verdict, reason = UNKNOWN, f"noise of at most {max(most, typical):.2g} mm is hidden by steps of {step:.2g} mm"
    else:
        verdict = NOT_SEEN
        reason = f"less than {most:.2g} mm from {nearest:.2f} to {farthest:.2f} m"
    return [Finding(name, verdict, reason, {"sigma_mm": Estimate(typical)}) for name in NAMES]


def _varying(residuals: Sequence[Residuals], steps: Steps) -> list[Finding] | None:
    """Findings where each frame has a noise of its own, or None."""
    chosen = [each for each in residuals if each.body]
    if len(chosen) < 4:
        return None
    sigmas = []
    for each in chosen:
        step = float(np.mean(steps.at(each.range_m)))
        variance = clipped_variance(each.residual_m, step)
        sigmas.append(1000 * np.sqrt(unrounded(variance, step, each.kind == "temporal")))
    spread, mean = float(np.std(sigmas, ddof=1)), float(np.mean(sigmas))
    if mean < LEAST_MM or mean < 500 * max(float(np.max(steps.at(each.range_m))) for each in chosen):
        return None  # what the step leaves of so little noise differs with the surface
    # Ranges differ between the frames of a moving body, and noise with them.
    ranges = np.array([np.median(each.range_m) for each in chosen])
    if spread < _VARYING * mean + 2 * mean * float(np.ptp(ranges) / ranges.mean()):
        return None
    if chosen[0].kind == "temporal":  # each difference mixes the variances of two frames
        spread *= np.sqrt(2)
    low, high = max(mean - np.sqrt(3) * spread, 0.0), mean + np.sqrt(3) * spread
    error = spread / np.sqrt(len(sigmas))
    estimates = {"low_mm": Estimate(low, 2 * error), "high_mm": Estimate(high, 2 * error)}
    reason = f"each frame has its own deviation, {mean:.3g} mm in the mean and {spread:.2g} mm apart"
    strengths = {"low_mm": rounded(low), "high_mm": rounded(high)}
    rest = [Finding(name, UNKNOWN, "the frames' deviations differ by themselves") for name in NAMES[1:]]
    return [Finding("noise", NEEDED, reason, estimates, strengths), *rest]


_LATERAL: Final[tuple[tuple[str, ...], ...]] = ((), ("constant_px",), ("constant_px", "grazing_px"))
_BASES: Final[dict[str, tuple[str, ...]]] = {
    "noise": ("sigma_mm",),
    "stereo_noise": ("per_m2_mm",),
    "axial_noise": ("constant_mm", "quadratic_mm"),
}


def _chosen(
    bins: NoiseBins, residuals: Sequence[Residuals], focal_px: float, baseline_m: float | None, ragged: bool
) -> list[Finding]:
    """The formula with the least chi squared plus a price for each parameter."""
    fits: list[tuple[float, str, NoiseFit]] = []
    for base, names in _BASES.items():
        for grazing in ((), ("grazing_mm",)):
            for lateral in _LATERAL if ragged else _LATERAL[:1]:
                if base == "stereo_noise" and grazing:
                    continue  # that formula has no such term
                parameters = (*names, *grazing, *lateral)
                fit = fit_positive(parameters, _model(base, bins), bins.variance_mm2, bins.error_mm2)
                fits.append((fit.chi2 + _WORTH * len(parameters), base, fit))
    _, base, fit = min(fits, key=_score)
    if "grazing_mm" in fit.parameters and any(each.kind == "spatial" for each in residuals):
        _, formula, relieved, relief_px = min((_with_relief(each, bins) for each in _BASES), key=_score)
        noise_px = float(np.median(np.sqrt(np.maximum(bins.variance_mm2, 0)) / bins.range_m)) * focal_px / 1000
        if relief_px < max(_RELIEF_PX, _RELIEF_PART * noise_px) and relieved.chi2 < fit.chi2 + _WORTH:
            base, fit = formula, relieved
    findings = _findings(base, fit, bins, residuals, focal_px, baseline_m, ragged)
    if base == "stereo_noise" and findings[base].verdict == NEEDED:
        rivals = [each for _, name, each in fits if name == "axial_noise" and "grazing_mm" not in each.parameters]
        rival = min(rivals, key=lambda each: each.chi2)
        if rival.chi2 < fit.chi2 + _WORTH:
            findings |= _either(findings[base], rival)
    return list(findings.values())


def _score(fit: tuple[Any, ...]) -> float:
    """The score that a fit begins with; of formulas that explain as much, rounding aside, the first counts."""
    return round(float(fit[0]), 6)


def _either(stereo: Finding, rival: NoiseFit) -> dict[str, Finding]:
    """Findings where axial noise explains the residuals as well as stereo noise, which has fewer strengths."""
    axial = {name: Estimate(*rival.parameters[name]) for name in _BASES["axial_noise"]}
    quadratic = f"{axial['constant_mm'].value:.3g} + {axial['quadratic_mm'].value:.3g} (z - {FROM_M:g})² mm"
    first = f"{stereo.reason}; {quadratic} of axial_noise explains as much, so the simpler one is written"
    second = f"{quadratic} explains as much as stereo_noise, which is simpler and written"
    return {
        "stereo_noise": replace(stereo, verdict=UNKNOWN, reason=first),
        "axial_noise": Finding("axial_noise", UNKNOWN, second, axial),
    }


def _with_relief(base: str, bins: NoiseBins) -> tuple[float, str, NoiseFit, float]:
    """A formula beside the relief that limbs leave in third differences: score, formula, its fit and the relief."""
    axial = _model(base, bins)
    parameters = (*_BASES[base], "relief_px")
    fit = fit_positive(
        parameters,
        lambda values: axial(values) + values["relief_px"] ** 2 * bins.slope2_mm2,
        bins.variance_mm2,
        bins.error_mm2,
    )
    strengths = {name: value for name, value in fit.parameters.items() if name != "relief_px"}
    return fit.chi2 + _WORTH * len(parameters), base, replace(fit, parameters=strengths), fit.parameters["relief_px"][0]


def _model(base: str, bins: NoiseBins) -> Callable[[dict[str, float]], Floats]:
    z = bins.range_m

    def variance(strengths: dict[str, float]) -> Floats:
        if base == "noise":
            axial = np.full(z.shape, strengths["sigma_mm"])
        elif base == "stereo_noise":
            axial = strengths["per_m2_mm"] * z**2
        else:
            axial = strengths["constant_mm"] + strengths["quadratic_mm"] * (z - FROM_M) ** 2
        axial = axial + strengths.get("grazing_mm", 0.0) * bins.ratio2 / np.sqrt(z)
        total: Floats = axial**2
        if "constant_px" in strengths:
            lateral = strengths["constant_px"] + strengths.get("grazing_px", 0.0) * bins.ratio
            total += bins.slope2_mm2 * _whole_pixels(lateral)
        return total

    return variance


def _whole_pixels(sigma_px: Floats | float) -> Floats:
    """Variance of Gaussian offsets rounded to whole pixels, as `lateral_noise` has them, pixels squared."""
    from scipy.special import erfc

    sigma = np.maximum(np.asarray(sigma_px, np.float64), 1e-6)
    # For small deviations hardly any offset reaches the next pixel; from 0.5 on, rounding adds a twelfth.
    offsets = np.arange(1.0, 12.0).reshape(-1, *(1 for _ in sigma.shape))
    beyond = erfc((offsets - 0.5) / (np.sqrt(2) * sigma))  # probability of an offset of at least this size
    return np.asarray(((2 * offsets - 1) * beyond).sum(axis=0))


def _findings(
    base: str,
    fit: NoiseFit,
    bins: NoiseBins,
    residuals: Sequence[Residuals],
    focal_px: float,
    baseline_m: float | None,
    ragged: bool,
) -> dict[str, Finding]:
    found = {name: Estimate(value, error) for name, (value, error) in fit.parameters.items()}
    kinds = " and ".join(sorted({each.kind for each in residuals}))
    nearest, farthest = bins.range_m.min(), bins.range_m.max()
    where = f"{kinds} residuals from {nearest:.2f} to {farthest:.2f} m"
    spatial = [each for each in residuals if each.kind == "spatial"]
    if spatial:
        around = float(np.median([each.misfit_m for each in spatial]))
        single = float(np.median([each.deviation_m() for each in spatial]))
        if around > _SHARED * single:
            where += f"; smooth surfaces fit to {1000 * around:.2g} mm only: neighbours share noise, or cloth has folds"
    axial = {name: value for name, value in found.items() if not name.endswith("_px")}
    lateral = {name: value for name, value in found.items() if name.endswith("_px")}
    seen = "; ".join(f"{name} {value}" for name, value in axial.items())
    findings = {name: Finding(name, NOT_SEEN, f"{base} explains the {where}") for name in NAMES}
    if farthest < 1.15 * nearest and base != "axial_noise":
        narrow = "ranges differ too little to show how noise grows with range"
        findings |= {name: Finding(name, UNKNOWN, narrow) for name in ("axial_noise", "stereo_noise")}
    largest = float(np.sqrt(np.median(_model(base, bins)({name: value.value for name, value in axial.items()}))))
    if largest >= max(LEAST_MM, _PART * float(np.sqrt(np.median(bins.variance_mm2)))):
        name, strengths = _strengths(base, axial, focal_px, baseline_m)
        findings[name] = Finding(name, NEEDED, f"{seen} ({where})", axial, strengths)
    if lateral and lateral["constant_px"].value + 2 * lateral.get("grazing_px", Estimate(0.0)).value >= LEAST_PX:
        strengths = {name: rounded(value.value) for name, value in lateral.items()}
        reason = "; ".join(f"{name} {value}" for name, value in lateral.items())
        relative = lateral["constant_px"].error / max(lateral["constant_px"].value, 1e-9)
        told = relative < _TOLD or "grazing_px" in lateral
        strengths = {"constant_px": 0.0, "grazing_px": 0.0} | strengths
        reason += " of jitter: noise grows with the slope of the surface"
        findings["lateral_noise"] = Finding(
            "lateral_noise", NEEDED if told else UNKNOWN, reason, lateral, strengths if told else {}
        )
    else:
        reason = "noise does not grow with slope" if ragged else "outlines lose no pixels, as jitter would"
        findings["lateral_noise"] = Finding("lateral_noise", NOT_SEEN, reason)
    return findings


def _strengths(
    base: str, axial: dict[str, Estimate], focal_px: float, baseline_m: float | None
) -> tuple[str, dict[str, float]]:
    """The artifact that a formula is written as, and its strengths.

    Noise of one deviation that also grows with incidence is axial noise without growth. Stereo noise without a known
    baseline is written for one of 10 cm, as only subpixel over focal length and baseline shows.
    """
    values = {name: rounded(estimate.value, 4) for name, estimate in axial.items()}
    if base == "noise" and "grazing_mm" not in axial:
        return "noise", {"low_mm": values["sigma_mm"], "high_mm": values["sigma_mm"]}
    if base == "stereo_noise":
        baseline = baseline_m or _ANY_BASELINE_M
        subpixel = axial["per_m2_mm"].value / 1000 * focal_px * baseline
        return "stereo_noise", {
            "subpixel_px": rounded(subpixel, 4),
            "focal_px": focal_px,
            "baseline_m": rounded(baseline, 4),
        }
    constant = values.get("constant_mm", values.get("sigma_mm", 0.0))
    return "axial_noise", {
        "constant_mm": constant,
        "quadratic_mm": values.get("quadratic_mm", 0.0),
        "from_m": FROM_M,
        "grazing_mm": values.get("grazing_mm", 0.0),
    }
