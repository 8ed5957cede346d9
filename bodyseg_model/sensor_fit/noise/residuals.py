"""Residuals of ranges with the range, slope and incidence at their pixels: what noise is measured from.

Through time, where a scene stands still, a residual is the difference of two frames over sqrt(2). In one frame it is a
third difference along rows and columns, which cancels any smooth surface.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_model.sensor_fit.masks import dilated, eroded
from bodyseg_model.sensor_fit.recording import Frame, Recording
from bodyseg_model.sensor_fit.surfaces import Surface, smooth_surface, third_differences

MARGIN_PX: Final = 3
"""Pixels this near to a silhouette are left out: they may show two surfaces."""

JUMP_M: Final = 0.05
"""Least difference of range between neighbours of two surfaces, metres."""

_RADII: Final = (3, 8)
_SLOPE_ERROR: Final = 0.04  # wanted of the fitted slope, as the tangent of the incidence
_MOST: Final = 150_000  # residuals of one frame and region
_FEWEST_ROOM: Final = 2000

Floats = NDArray[np.float64]
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


def residuals_of(recording: Recording) -> list[Residuals]:
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


def mean_frame(recording: Recording) -> tuple[Floats, Mask]:
    """Mean range of a still body over all frames, metres, and the pixels measured in at least a fifth of them."""
    counts = sum(frame.body.astype(np.int64) for frame in recording.frames)
    total = sum(np.where(frame.body, frame.range_m, 0).astype(np.float64) for frame in recording.frames)
    known = np.asarray(counts >= max(1, len(recording.frames) // 5))
    return np.where(known, total / np.maximum(counts, 1), 0), known


def body_surface(range_m: NDArray[np.floating], known: Mask, sigma_m: float, recording: Recording) -> Surface:
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


def _spatial(recording: Recording, frame: Frame) -> Residuals:
    sigma = frame.noise_m
    surface = body_surface(frame.range_m, frame.body, sigma, recording)
    usable = inner(frame.range_m, frame.body, sigma) & surface.at(frame.body)
    values, pixels = third_differences(frame.range_m, usable)
    return _sampled("spatial", True, values, pixels, surface)


def _temporal(recording: Recording, a: int, b: int, surface: Surface, body: bool) -> Residuals:
    first, second = recording.frames[a], recording.frames[b]
    both = first.body & second.body if body else first.room & second.room
    usable = surface.at(both)
    if body:  # a rim pixel may show the room in one of the frames
        usable &= inner(np.where(both, surface.range_m, 0), surface.at(both), 0.0)
    pixels = np.flatnonzero(usable)
    difference = second.range_m.ravel()[pixels].astype(np.float64) - first.range_m.ravel()[pixels]
    return _sampled("temporal", body, difference / np.sqrt(2), pixels, surface)


def _room(recording: Recording) -> Iterator[Residuals]:
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


def _sampled(kind: Kind, body: bool, values: Floats, pixels: NDArray[np.intp], surface: Surface) -> Residuals:
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
