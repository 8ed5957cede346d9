"""Noise of range over bodies: one deviation for a recording, or a spread of them where its frames differ."""

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, UNKNOWN, Estimate, Finding, rounded
from bodyseg_model.sensor_fit.recording import (
    Floats,
    MarkedFrame,
    MarkedRecording,
    Mask,
    dilated,
    jumps,
    mean_of,
    smooth_surface,
    third_differences,
)

_LEAST_RESIDUALS: Final = 2000
_LEAST_MM: Final = 0.3  # least noise that can be told from the relief of a surface and from steps of 1 mm
_MARGIN_PX: Final = 3  # pixels this near to a silhouette are left out: they may show two surfaces
_JUMP_M: Final = 0.05  # difference of neighbours that are of two surfaces
_STEEPEST: Final = 1.0  # slope, as its tangent, up to which third differences cancel a surface's shape
_FEWEST: Final = 50  # fewest residuals of a frame
_VARYING: Final = 0.06  # relative spread of the frames' deviations from which on noise differs between frames
_COARSE: Final = 0.16  # variance, in squared steps, below which most values of two frames are equal
_HELD: Final = 0.1  # share of differences beyond noise from which on the driver holds values over several frames
_FILTERED: Final = 1.2  # ratio of the variance between every other frame to that between neighbours: the driver filters

Row = tuple[float, int, float, float]
"""Noise of one frame or pair: variance, metres squared, rounding included; number of residuals; step and range, m."""


def measure_noise(recording: MarkedRecording) -> Finding:
    """The finding of "noise".

    Bodies that stand still are measured through time, where a residual is the difference of two frames over sqrt(2);
    others, and those of frames that a driver repeats or filters over time, within each frame by third differences,
    which cancel smooth surfaces. Rounding of the stored values is part of the noise.
    """
    found = list(_temporal(recording)) if recording.still else []
    between, found = bool(found), found or list(_spatial(recording))
    variances, counts, steps, ranges = np.array(found, np.float64).reshape(-1, 4).T
    count = int(counts.sum())
    if count < _LEAST_RESIDUALS:
        return Finding("noise", UNKNOWN, f"{count} residuals are too few, {_LEAST_RESIDUALS} are needed")
    sigmas = 1000 * np.sqrt(variances)
    mean, spread = float(sigmas.mean()), float(sigmas.std(ddof=1)) if len(sigmas) > 1 else 0.0
    apart = spread * np.sqrt(2) if between else spread  # of frames: each difference mixes the variances of two
    estimates = {"sigma_mm": Estimate(mean, float(np.hypot(apart / np.sqrt(len(sigmas)), mean / np.sqrt(2 * count))))}
    at = f"at {ranges.min():.2f} m" if np.ptp(ranges) < 0.05 else f"from {ranges.min():.2f} to {ranges.max():.2f} m"
    where = f"{'between' if between else 'within'} frames, {at}"
    if mean < _LEAST_MM:
        return Finding("noise", NOT_SEEN, f"less than {_LEAST_MM:g} mm {where}", estimates)
    reason = f"{estimates['sigma_mm']} mm {where}"
    step = float(np.median(steps))
    if step**2 / 12 > np.median(variances) / 2:
        reason += f", most of it by steps of {1000 * step:.2g} mm"
    low = high = mean
    if len(sigmas) >= 4 and spread > _VARYING * mean:
        low, high = max(mean - np.sqrt(3) * apart, 0.0), mean + np.sqrt(3) * apart
        error = 2 * apart / np.sqrt(len(sigmas))
        estimates |= {"low_mm": Estimate(low, error), "high_mm": Estimate(high, error)}
        reason += f"; each frame has its own deviation, {apart:.2g} mm apart"
    return Finding("noise", NEEDED, reason, estimates, {"low_mm": rounded(low), "high_mm": rounded(high)})


def _temporal(recording: MarkedRecording) -> Iterator[Row]:
    mean, known, noise_m = mean_of(recording.frames)
    usable = _inner(mean, known, noise_m)
    for a, b in () if _filtered(recording, usable) else recording.pairs:
        first, second = recording.frames[a], recording.frames[b]
        both = usable & first.body & second.body
        residuals = (second.range_m[both].astype(np.float64) - first.range_m[both]) / np.sqrt(2)
        if len(residuals) >= _FEWEST and residuals.any():  # else both are the same frame
            step = _step_of(first, recording.step_m)
            variance = clipped_variance(residuals, step)
            if np.mean(np.abs(residuals) > 4.5 * max(np.sqrt(variance), step / 3)) < _HELD:
                yield before_equal_rounding(variance, step), len(residuals), step, float(np.median(mean[both]))


def _filtered(recording: MarkedRecording, usable: Mask) -> bool:
    """True if a driver filters values over time, or holds them: frames farther apart then differ more than neighbours.

    For independent frames a, b, c, d, differences between a and b and between c and d together are as large as those
    between a and c and between b and d. Third differences cancel movement. Fours with few differences do not count.
    """
    near, far, count = 0.0, 0.0, 0
    for a, b, c, d in recording.fours:
        pairs = ((a, b), (c, d), (a, c), (b, d))
        away = [third_differences(y.range_m - x.range_m, usable & x.body & y.body) for x, y in pairs]
        fewest = min(map(len, away))
        if fewest >= _FEWEST:
            step = _step_of(a, recording.step_m)
            ab, cd, ac, bd = (clipped_variance(each, step) for each in away)
            near, far, count = near + ab + cd, far + ac + bd, count + fewest
    return count >= _LEAST_RESIDUALS and far > _FILTERED * near


def _spatial(recording: MarkedRecording) -> Iterator[Row]:
    for frame in recording.frames:
        _, slope = smooth_surface(frame.range_m, frame.body, frame.noise_m, recording.camera)
        gentle = frame.body & (np.nan_to_num(slope, nan=np.inf) < _STEEPEST)
        usable = gentle & _inner(frame.range_m, frame.body, frame.noise_m)
        residuals = third_differences(frame.range_m, usable)
        if len(residuals) >= _FEWEST:
            step = _step_of(frame, recording.step_m)
            variance = max(clipped_variance(residuals, step), step**2 / 12)
            yield variance, len(residuals), step, float(np.median(frame.range_m[usable]))


def _inner(range_m: NDArray[np.floating], known: Mask, sigma_m: float) -> Mask:
    """The known pixels away from every jump of range, bool [H, W]; a pixel that is not known makes no jump."""
    return known & ~dilated(jumps(range_m, known, max(_JUMP_M, 8 * sigma_m)), _MARGIN_PX)


def _step_of(frame: MarkedFrame, step_m: float) -> float:
    """The step of a body's stored values, metres: the median, over its pixels, of the gap to the next lower value."""
    values, counts = np.unique(frame.stored[frame.body], return_counts=True)
    if len(values) < 2:
        return step_m
    return step_m * float(np.median(np.repeat(np.diff(values), counts[1:])))


def before_equal_rounding(variance: float, step: float) -> float:
    """The variance about the truth, rounding included, of values whose differences have this half mean square.

    With noise well below the step, both values of a pair are often equal. The difference of two normal values of
    deviation sigma, rounded to steps at even phases, then has a half mean square of step * sigma / sqrt(pi); with more
    noise one of sigma**2 + step**2 / 12. Both meet near `_COARSE` steps squared.
    """
    if variance > _COARSE * step**2:
        return variance
    return np.pi * variance**2 / step**2 + step**2 / 12


def clipped_variance(values: Floats, step: float) -> float:
    """The mean square of residuals, those beyond 4.5 deviations left out; step: of their rounding, in their unit."""
    limit = 4.5 * max(1.4826 * float(np.median(np.abs(values))), step / 3)
    for _ in range(4):
        kept = values[np.abs(values) <= limit]
        sigma = float(np.sqrt(np.mean(kept**2))) if len(kept) else 0.0
        limit = 4.5 * max(sigma, step / 3)
    return sigma**2
