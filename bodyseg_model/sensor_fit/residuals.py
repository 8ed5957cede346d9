"""Steps that stored ranges lie on, and residuals of range: what steps and noise are measured from.

Through time, where a scene stands still, a residual is the difference of two frames over sqrt(2). In one frame it is a
third difference along rows and columns, which cancels any smooth surface.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.rigs import RANGE_STEP_MM
from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, UNKNOWN, Estimate, Finding, rounded
from bodyseg_model.sensor_fit.recording import (
    MarkedFrame,
    MarkedRecording,
    SmoothSurface,
    dilated,
    eroded,
    smooth_surface,
    third_differences,
)

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


def measure_steps(recording: MarkedRecording, baseline_m: float | None) -> tuple[Steps, list[Finding]]:
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


def _disparity_steps(
    recording: MarkedRecording, comb: Comb, baseline_m: float | None, z: Floats
) -> tuple[Steps, Finding]:
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
    sharp = np.abs(np.exp(2j * np.pi * np.outer(fine, x)) @ weights)
    best = float(fine[int(np.argmax(sharp))])
    residual = float(np.sqrt(max(1 - sharp.max() ** 2, 1e-6)) / (2 * np.pi))
    error = residual / best / (extent * best * np.sqrt(len(x) / 12))
    return Comb(1 / best, float(corrected[at]), float(error))


MARGIN_PX: Final = 3
"""Pixels this near to a silhouette are left out: they may show two surfaces."""

JUMP_M: Final = 0.05
"""Least difference of range between neighbours of two surfaces, metres."""

_RADII: Final = (3, 8)
_SLOPE_ERROR: Final = 0.04  # wanted of the fitted slope, as the tangent of the incidence
_MOST: Final = 150_000  # residuals of one frame and region
_FEWEST_ROOM: Final = 2000

Mask = NDArray[np.bool_]
Kind = Literal["temporal", "spatial"]


@dataclass(frozen=True)
class Residuals:
    """Residuals of one frame or pair, arrays [N]: residual_m, range_m, slope_m (metres a pixel), incidence_rad.

    kind: "temporal" from two frames, "spatial" from one. body: False for the room behind. misfit_m: median deviation of
    pixels from the smooth surface around them, which noise shared by neighbours is in, too.
    """

    kind: Kind
    body: bool
    residual_m: Floats
    range_m: Floats
    slope_m: Floats
    incidence_rad: Floats
    misfit_m: float

    def deviation_m(self) -> float:
        """A robust standard deviation of all residuals, metres."""
        size = np.abs(self.residual_m)
        return float(1.4826 * np.median(size)) or float(np.sqrt(np.mean(size**2)))


def residuals_of(recording: MarkedRecording) -> list[Residuals]:
    """The residuals of all frames.

    Bodies that stand still are measured through time, others within each frame; the room behind only through time, as
    its shape is not known to be smooth.
    """
    found: list[Residuals] = []
    if recording.still:
        mean, known = mean_frame(recording)
        sigma = recording.frames[0].noise_m / np.sqrt(len(recording.frames))
        surface = body_surface(mean, known, sigma, recording)
        found += [_temporal(recording, a, b, surface, body=True) for a, b in recording.pairs]
    else:
        found += [_spatial(recording, frame) for frame in recording.frames if frame.body.any()]
    if recording.still_room:
        found += list(_room(recording))
    return [residuals for residuals in found if len(residuals.residual_m)]


def mean_frame(recording: MarkedRecording) -> tuple[Floats, Mask]:
    """Mean range of a still body over all frames, metres, and the pixels measured in at least a fifth of them."""
    counts = sum(frame.body.astype(np.int64) for frame in recording.frames)
    total = sum(np.where(frame.body, frame.range_m, 0).astype(np.float64) for frame in recording.frames)
    known = np.asarray(counts >= max(1, len(recording.frames) // 5))
    return np.where(known, total / np.maximum(counts, 1), 0), known


def body_surface(
    range_m: NDArray[np.floating], known: Mask, sigma_m: float, recording: MarkedRecording
) -> SmoothSurface:
    """The smooth surface of a body, with windows as large as its noise needs. sigma_m: of the noise in `range_m`."""
    pixel_m = float(np.median(range_m[known])) / recording.camera.focal_px
    radius = int(np.ceil((sigma_m * np.sqrt(12) / (pixel_m * _SLOPE_ERROR)) ** 0.5 / 2 - 0.5))
    return smooth_surface(range_m, known, recording.camera, int(np.clip(radius, *_RADII)))


def inner(range_m: NDArray[np.floating], known: Mask, sigma_m: float) -> Mask:
    """The known pixels away from every jump of range, bool [H, W]; pixels that are not known are no jump."""
    limit = max(JUMP_M, 8 * sigma_m)
    jumps = np.zeros(known.shape, np.bool_)
    for axis in (0, 1):
        difference = np.abs(np.diff(range_m, axis=axis)) > limit
        a, b = (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])
        both = known[a] & known[b] & difference
        jumps[a] |= both
        jumps[b] |= both
    return known & ~dilated(jumps, MARGIN_PX)


def _spatial(recording: MarkedRecording, frame: MarkedFrame) -> Residuals:
    sigma = frame.noise_m
    surface = body_surface(frame.range_m, frame.body, sigma, recording)
    usable = inner(frame.range_m, frame.body, sigma) & surface.at(frame.body)
    values, pixels = third_differences(frame.range_m, usable)
    return _sampled("spatial", True, values, pixels, surface)


def _temporal(recording: MarkedRecording, a: int, b: int, surface: SmoothSurface, body: bool) -> Residuals:
    first, second = recording.frames[a], recording.frames[b]
    both = first.body & second.body if body else first.room & second.room
    usable = surface.at(both)
    if body:  # a rim pixel may show the room in one of the frames
        usable &= inner(np.where(both, surface.range_m, 0), surface.at(both), 0.0)
    pixels = np.flatnonzero(usable)
    difference = second.range_m.ravel()[pixels].astype(np.float64) - first.range_m.ravel()[pixels]
    return _sampled("temporal", body, difference / np.sqrt(2), pixels, surface)


def _room(recording: MarkedRecording) -> Iterator[Residuals]:
    for a, b in recording.pairs:
        first, second = recording.frames[a], recording.frames[b]
        both = first.room & second.room & ~dilated(first.body | second.body, MARGIN_PX)
        usable = eroded(both, 1)
        if np.count_nonzero(usable) < _FEWEST_ROOM:
            continue
        mean = (first.range_m.astype(np.float64) + second.range_m) / 2
        surface = smooth_surface(mean, both, recording.camera, _RADII[1])
        flat = inner(mean, usable, 0.02) & surface.at(usable)
        flat &= np.nan_to_num(surface.misfit_m, nan=np.inf) < 3 * np.nanmedian(surface.misfit_m[usable])
        pixels = np.flatnonzero(flat)
        difference = second.range_m.ravel()[pixels].astype(np.float64) - first.range_m.ravel()[pixels]
        yield _sampled("temporal", False, difference / np.sqrt(2), pixels, surface)


def _sampled(kind: Kind, body: bool, values: Floats, pixels: NDArray[np.intp], surface: SmoothSurface) -> Residuals:
    """At most `_MOST` residuals, evenly spread, where the surface is known and fits as well as elsewhere."""
    misfit = surface.misfit_m.ravel()[pixels]
    known = np.isfinite(misfit)
    if known.any():
        known &= misfit <= max(0.008, 5 * float(np.median(misfit[known])))
    values, pixels = values[known], pixels[known]
    every = max(1, -(-len(values) // _MOST))
    values, pixels = values[::every], pixels[::every]
    return Residuals(
        kind,
        body,
        values,
        surface.range_m.ravel()[pixels],
        surface.slope_m.ravel()[pixels],
        surface.incidence_rad.ravel()[pixels],
        float(np.median(misfit[known])) if known.any() else 0.0,
    )
