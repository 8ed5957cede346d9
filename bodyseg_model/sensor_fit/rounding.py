"""Steps of range: whether stored values lie on a comb, evenly spaced in range or in inverse range."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.rig import RANGE_STEP_MM
from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, UNKNOWN, Estimate, Finding, rounded
from bodyseg_model.sensor_fit.recording import Recording

COHERENCE: Final = 0.6
"""Least share of the pixels' phases that must agree for a comb: 1 where all values lie on it, 0 by chance."""

LEAST_TEETH: Final = 12
"""Fewest steps that the values must span for a comb in inverse range to differ from one in range."""

LEAST_PIXELS: Final = 2000
SUBPIXEL_PX: Final = 0.125
"""Step of disparity that is written where no baseline is known: an eighth of a pixel, as a Kinect's (Khoshelham and
Elberink, 2012). Only the step over focal length and baseline shows in ranges."""

_FINEST: Final = 1.6  # units of the file; finer combs cannot be told from the unit
_COARSEST_M: Final = 0.06
_BEST: Final = 0.9  # of the highest coherence: a comb's whole fractions have it too, and the coarsest is the step

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Comb:
    """An even spacing of values. spacing: metres in range, or 1 / metre in inverse range. coherence: 0 to 1."""

    spacing: float
    coherence: float
    error: float


@dataclass(frozen=True)
class Steps:
    """Steps of a sensor's ranges: in range (metres), in inverse range (1 / metre), or neither, beside the file's unit.

    unit_m: of the file.
    """

    unit_m: float
    range_m: float = 0.0
    inverse: float = 0.0

    def at(self, range_m: Floats) -> Floats:
        """The step at each range, metres."""
        coarse = self.inverse * np.square(range_m) if self.inverse else np.full(range_m.shape, self.range_m)
        return np.maximum(coarse, self.unit_m)


def measure_steps(recording: Recording, baseline_m: float | None) -> tuple[Steps, list[Finding]]:
    """Look for both combs in the stored values of all frames.

    baseline_m: of the sensor, where it is known, so that the step of disparity is in pixels. Returns the steps and the
    findings of "range_rounding" and "disparity_rounding".
    """
    unit = recording.step_m
    values, counts = np.unique(
        np.concatenate([frame.stored[frame.range_m > 0] for frame in recording.frames]), return_counts=True
    )
    z = values.astype(np.float64) * unit
    if counts.sum() < LEAST_PIXELS or z[-1] - z[0] < 10 * unit:
        reason = f"{counts.sum()} pixels from {z[0]:.3g} to {z[-1]:.3g} m do not show a step"
        return Steps(unit), [Finding(name, UNKNOWN, reason) for name in ("range_rounding", "disparity_rounding")]
    in_range = _comb(z, counts, _FINEST * unit, _COARSEST_M, unit)
    nearest = float(np.quantile(np.repeat(z, np.minimum(counts, 100)), 0.02))
    farthest = float(z[-1])
    finest = _FINEST * unit / farthest**2
    in_disparity = _comb(1 / z, counts, finest, _COARSEST_M / nearest**2, finest / 4)
    files = _file_steps(unit)
    unseen = f"stored values have no step but the file's, {unit * 1000:g} mm"
    if max(in_range.coherence, in_disparity.coherence) < COHERENCE:
        reason = f"{unseen} (coherence {in_range.coherence:.2f} in range, {in_disparity.coherence:.2f} in disparity)"
        return Steps(unit), [files or Finding("range_rounding", NOT_SEEN, reason), _not_seen(reason)]
    if in_range.coherence >= in_disparity.coherence:
        return _range_steps(unit, in_range)
    steps, found = _disparity_steps(recording, in_disparity, baseline_m, z)
    return steps, [files or Finding("range_rounding", NOT_SEEN, "the steps are even in disparity"), found]


def _not_seen(reason: str) -> Finding:
    return Finding("disparity_rounding", NOT_SEEN, reason)


def _file_steps(unit_m: float) -> Finding | None:
    """The finding of "range_rounding" for the unit of the files, where that is coarser than shards store."""
    step = 1000 * unit_m
    if step <= RANGE_STEP_MM * 1.001:
        return None
    reason = f"the frames' files hold whole steps of {step:g} mm"
    return Finding("range_rounding", NEEDED, reason, {"step_mm": Estimate(step, 0.0)}, {"step_mm": rounded(step)})


def _range_steps(unit: float, comb: Comb) -> tuple[Steps, list[Finding]]:
    step = Estimate(1000 * comb.spacing, 1000 * comb.error)
    reason = f"stored values lie {step} mm apart (coherence {comb.coherence:.2f})"
    found = Finding("range_rounding", NEEDED, reason, {"step_mm": step}, {"step_mm": rounded(step.value, 4)})
    return Steps(unit, range_m=comb.spacing), [found, _not_seen("the steps are even in range, not in disparity")]


def _disparity_steps(recording: Recording, comb: Comb, baseline_m: float | None, z: Floats) -> tuple[Steps, Finding]:
    focal = recording.camera.focal_px
    per_m = Estimate(comb.spacing, comb.error)
    middle = float(np.median(z))
    reason = f"stored values are even in 1 / range, {per_m} a metre: {1000 * comb.spacing * middle**2:.2g} mm at "
    reason += f"{middle:.2g} m (coherence {comb.coherence:.2f})"
    estimates = {"step_per_m": per_m}
    if baseline_m is not None:
        pixels = Estimate(comb.spacing * focal * baseline_m, comb.error * focal * baseline_m)
        estimates["step_px"] = pixels
        strengths = {"step_px": rounded(pixels.value, 4), "focal_px": focal, "baseline_m": rounded(baseline_m, 4)}
        reason += f"; {pixels} px with a baseline of {baseline_m:.3g} m"
    else:
        baseline = SUBPIXEL_PX / comb.spacing / focal
        strengths = {"step_px": SUBPIXEL_PX, "focal_px": focal, "baseline_m": rounded(baseline, 4)}
        reason += f"; written as {SUBPIXEL_PX} px, which a baseline of {baseline:.3g} m would give"
    found = Finding("disparity_rounding", NEEDED, reason, estimates, strengths)
    return Steps(recording.step_m, inverse=comb.spacing), found


def _comb(x: Floats, counts: NDArray[np.int64], finest: float, coarsest: float, blur: float) -> Comb:
    """The coarsest spacing of a comb that the values lie on, by the length of their mean phase.

    x: [N], distinct values; counts: their pixels. finest, coarsest: the spacings to try. blur: values are exact to
    about half of it. A comb with a free offset: x = offset + spacing times a whole number.
    """
    weights = np.sqrt(counts.astype(np.float64))  # no single value outweighs the rest
    weights /= weights.sum()
    extent = float(x.max() - x.min())
    coarsest = min(coarsest, extent / LEAST_TEETH)
    if coarsest <= finest:
        return Comb(finest, 0.0, 0.0)
    # On a grid so fine that half its cell does not matter, all frequencies follow from one transform.
    cell = finest / 4
    grid = np.bincount(np.rint((x - x.min()) / cell).astype(np.int64), weights)
    size = 1 << int(np.ceil(np.log2(4 * len(grid))))
    coherence = np.abs(np.fft.rfft(grid, size))
    frequencies = np.arange(len(coherence)) / (size * cell)
    tried = (frequencies >= 1 / coarsest) & (frequencies <= 1 / finest)
    coherence, frequencies = coherence[tried], frequencies[tried]
    corrected = np.minimum(coherence / np.maximum(np.abs(np.sinc(frequencies * blur)), 0.3), 1.0)
    at = int(np.flatnonzero(corrected >= _BEST * corrected.max())[0])
    # The first that is high lies on the flank of its peak.
    at += int(np.argmax(corrected[at : at + 12]))
    fine = frequencies[at] + np.linspace(-0.5, 0.5, 201) / extent
    sharp = _coherence(x, weights, fine)
    best = float(fine[int(np.argmax(sharp))])
    residual = float(np.sqrt(max(1 - sharp.max() ** 2, 1e-6)) / (2 * np.pi))
    error = residual / best / (extent * best * np.sqrt(len(x) / 12))
    return Comb(1 / best, float(corrected[at]), float(error))


def _coherence(x: Floats, weights: Floats, frequencies: Floats) -> Floats:
    """Length of the mean phase of the values at each frequency, [F], 0 to 1."""
    lengths: Floats = np.abs(np.exp(2j * np.pi * np.outer(frequencies, x)) @ weights)
    return lengths
