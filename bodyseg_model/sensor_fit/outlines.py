"""The pixels that a body covers, the lost ones included, and their distance from its outline."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts import angles, box_of, silhouettes, slants, widened
from bodyseg_data.rigs import Camera
from bodyseg_model.sensor_fit.recording import (
    MarkedFrame,
    MarkedRecording,
    SmoothSurface,
    closing,
    connected,
    dilated,
    holes,
    opening,
)
from bodyseg_model.sensor_fit.residuals import body_surface, mean_frame

RINGS: Final = 6
"""Pixels from the outline inwards that are counted ring by ring; beyond is the inside."""

SEEN_SHARE: Final = 0.1
"""Least share of the frames of a still body that show it in a pixel of its own."""

_CLOSED_PX: Final = 2
_BAND: Final = 0.02  # of the pixels in a typical row, at most, in a row that is a stripe
_JUMP_M: Final = 0.03
_FINE_M: Final = 1e-4  # steps in which surfaces are handed to the functions of artifacts
_WIDER: Final = 1.3
_FEWEST_BANDS: Final = 2  # one alone may be a patch across a limb, as may several of different widths
_FEWEST_CUT: Final = 3  # where one alone is not cut off by an end of the body
_ALIKE: Final = 0.6
_RUN_PX: Final = 5  # lost in a row, that no chance makes
_EXACT: Final = 0.04  # of the size of a pixel: the noise with which differences of neighbours still give slopes
_TURNED_DEG: Final = 50.0
_RIM_PX: Final = 4

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class BodyOutline:
    """The body of one frame as it would be without loss, all arrays [H, W].

    full: bool, its pixels; lost: bool, those without a range, shadows aside; shadow: bool, lost behind an edge of the
    body. ring: int, 1 for the pixels at an edge of a surface, up to `RINGS` away, then 0; 0 outside. stripes: bool, in
    whole rows or columns that are lost. incidence_deg: between ray and normal, degrees, NaN where not known. exact:
    whether that is from neighbouring pixels, as artifacts have it, and not from a smooth surface. still: whether the
    outline is known from other frames of a body that stands still.
    """

    full: Mask
    lost: Mask
    shadow: Mask
    ring: NDArray[np.int64]
    stripes: dict[str, Mask]
    incidence_deg: NDArray[np.float64]
    exact: bool
    still: bool

    @property
    def inside(self) -> Mask:
        """The pixels of the body farther from its outline than `RINGS`, bool [H, W]."""
        found: Mask = self.full & (self.ring == 0)
        return found


def outlines_of(recording: MarkedRecording, baseline_m: float | None = None) -> list[BodyOutline]:
    """The outline of each frame's body; a still body's is that of all frames together.

    baseline_m: of the sensor, where it is known, which limits the width of shadows.
    """
    if recording.still:
        mean, known = mean_frame(recording)
        seen = sum(frame.body.astype(np.int64) for frame in recording.frames)
        rooms = sum(frame.room.astype(np.int64) for frame in recording.frames)
        shown = np.asarray(seen >= max(1.0, SEEN_SHARE * len(recording.frames)))
        room = np.asarray(rooms > len(recording.frames) // 2)
        sigma = recording.frames[0].noise_m / np.sqrt(len(recording.frames))
        surface = body_surface(mean, known, sigma, recording)
        incidence, exact = _incidence(mean, known, surface, sigma, recording.camera)
        full = _without_gaps(_full(shown & ~room, room), known, incidence)
        rings = _rings(full, mean if exact else None)
        ever = np.asarray(seen > 0)
        return [
            _outline(
                frame, full, _behind_edges(frame, recording.camera, baseline_m) & ~ever, rings, incidence, (exact, True)
            )
            for frame in recording.frames
        ]
    found = []
    for frame in recording.frames:
        if frame.body.any():
            sigma = frame.noise_m
            surface = body_surface(frame.range_m, frame.body, sigma, recording)
            incidence = np.degrees(surface.incidence_rad)
            bridged = _bridged(frame.body)  # bands are no holes, whatever the surface beside them
            full = _without_gaps(_full(bridged, frame.room), bridged, incidence)
            behind = _behind_edges(frame, recording.camera, baseline_m)
            found.append(_outline(frame, full, behind, _rings(full, None), incidence, (False, False)))
    return found


def _outline(
    frame: MarkedFrame,
    full: Mask,
    behind: Mask,
    rings: NDArray[np.int64],
    incidence: NDArray[np.float64],
    known: tuple[bool, bool],
) -> BodyOutline:
    missing = full & (frame.range_m == 0)
    shadow = missing & behind
    rows, columns = _bands(frame.body, full)
    lost = missing & ~shadow
    stripes = {"rows": missing & rows | _begun(rows, lost), "columns": missing & columns | _begun(columns.T, lost.T).T}
    return BodyOutline(full, lost, shadow, rings, stripes, incidence, *known)


def _incidence(
    mean: NDArray[np.float64], known: Mask, surface: SmoothSurface, sigma_m: float, camera: Camera
) -> tuple[NDArray[np.float64], bool]:
    """Angles of incidence, degrees [H, W], and whether noise is so little that neighbouring pixels give them."""
    steps = np.where(known, np.rint(mean / _FINE_M), 0).clip(0, 65535).astype(np.uint16)
    box = box_of(steps)
    if box is None or sigma_m > _EXACT * float(np.median(mean[known])) / camera.focal_px:
        return np.degrees(surface.incidence_rad), False
    found = np.full(known.shape, np.nan)
    found[box] = np.degrees(angles(slants(steps, camera, box)))
    found[~known] = np.nan
    return found, True


def _without_gaps(full: Mask, known: Mask, incidence: NDArray[np.float64]) -> Mask:
    """A body without the holes through which nothing was there to see, such as between arm and trunk.

    Round such a hole surfaces turn away from the camera; round a lost patch they lie as everywhere.
    """
    empty = full & ~closing(known, _CLOSED_PX)
    cores = opening(empty, 1)
    kept = full.copy()
    while cores.any():
        hole = connected(dilated(cores, 1) & empty, int(np.flatnonzero(cores)[0]))
        rim = incidence[dilated(hole, _RIM_PX) & known]
        rim = rim[np.isfinite(rim)]
        if len(rim) and np.median(rim) > _TURNED_DEG:
            kept &= ~dilated(hole, _CLOSED_PX) | known
        cores &= ~hole
    return kept


def _full(body: Mask, room: Mask) -> Mask:
    """A body with its holes: gaps of a few pixels, and whatever no path through empty pixels joins to the outside."""
    closed = closing(body, _CLOSED_PX) & ~room
    return closed | (holes(closed, room) & ~room)


def _bridged(body: Mask) -> Mask:
    """A body with bands of lost rows or columns filled from the nearer end of each, so that their area is right."""
    filled = body.copy()
    for axis in (0, 1):
        image, out = (body, filled) if axis == 0 else (body.T, filled.T)
        for start, end in _empty_bands(image):
            middle = (start + end) // 2
            out[start:middle] |= image[start - 1]
            out[middle:end] |= image[end]
    return filled


def _begun(bands: Mask, lost: Mask) -> Mask:
    """Lost runs in the rows beside bands of whole rows, bool [H, W]: a stripe may end within a row."""
    beside = np.zeros_like(bands)
    beside[1:] |= bands[:-1]
    beside[:-1] |= bands[1:]
    left = lost & beside & ~bands
    starts = left.copy()
    for shift in range(1, _RUN_PX):
        starts[:, :-shift] &= left[:, shift:]
        starts[:, -shift:] = False
    runs = starts.copy()
    for shift in range(1, _RUN_PX):
        runs[:, shift:] |= starts[:, :-shift]
    return runs


def _bands(body: Mask, full: Mask) -> tuple[Mask, Mask]:
    """The rows and the columns that are lost as a whole between others that are not, bool [H, W] each."""
    rows, columns = np.zeros(body.shape, np.bool_), np.zeros(body.shape, np.bool_)
    for start, end in _empty_bands(body, full):
        rows[start:end] = True
    for start, end in _empty_bands(body.T, full.T):
        columns[:, start:end] = True
    return rows, columns


def _empty_bands(body: Mask, full: Mask | None = None) -> list[tuple[int, int]]:
    """First and last + 1 of runs of rows with next to no body between rows with one.

    With `full`, rows beyond the measured body count as well where the full body reaches.
    """
    counts = np.count_nonzero(body, axis=1)
    reach = counts if full is None else np.count_nonzero(full, axis=1)
    present = np.flatnonzero(reach)
    if not len(present):
        return []
    empty = counts <= _BAND * np.median(counts[counts > 0]) if counts.any() else np.ones(len(counts), np.bool_)
    empty[: present[0]] = empty[present[-1] + 1 :] = False
    edges = np.flatnonzero(np.diff(np.concatenate([[0], empty.astype(np.int8), [0]])))
    bands = [(int(start), int(end)) for start, end in zip(edges[::2], edges[1::2], strict=True)]
    bands = [(start, end) for start, end in bands if start > 0 and end < len(counts)]
    return bands if _alike(bands, int(present[0]), int(present[-1]) + 1) else []


def _alike(bands: list[tuple[int, int]], top: int, bottom: int) -> bool:
    """True if bands are of one width, as stripes are; one at an end of the body, from `top` to `bottom`, may be cut."""
    widths = np.array([end - start for start, end in bands])
    cut = np.array([start == top or end == bottom for start, end in bands], np.bool_)
    inner = np.count_nonzero(~cut)
    if not inner or (inner == 1 and len(bands) < _FEWEST_CUT):
        return False
    beyond = widths - np.median(widths[~cut])
    alike = (np.abs(beyond) <= _CLOSED_PX) | (cut & (beyond <= _CLOSED_PX))
    return bool(np.count_nonzero(alike) >= max(_FEWEST_BANDS, _ALIKE * len(bands)))


def _rings(full: Mask, range_m: NDArray[np.float64] | None) -> NDArray[np.int64]:
    """Distance from the nearest edge of a surface; range_m: to find edges inside the body by, None for outlines."""
    padded = np.pad(full, 1)
    beside = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    # The image's own border is no outline of the body.
    beside[0] |= True
    beside[-1] |= True
    beside[:, 0] |= True
    beside[:, -1] |= True
    outermost = full & ~beside
    if range_m is not None:
        steps = np.where(full, np.rint(range_m / _FINE_M), 0).clip(0, 65535).astype(np.uint16)
        steps[full & (steps == 0)] = np.median(steps[steps > 0])
        outermost |= silhouettes(steps, _JUMP_M / _FINE_M)
    ring = np.zeros(full.shape, np.int64)
    for number in range(RINGS, 0, -1):
        ring[widened(outermost, number - 1) & full] = number
    return ring


def _behind_edges(frame: MarkedFrame, camera: Camera, baseline_m: float | None) -> Mask:
    """Lost pixels of rows between ranges that differ by an edge, no wider than a projector's shadow can be."""
    image = frame.range_m.astype(np.float64)
    count = image.shape[1]
    index = np.where(image > 0, np.arange(count), -1)
    left = np.maximum.accumulate(index, 1)
    backward = np.where(image > 0, np.arange(count), count)[:, ::-1]
    right = np.minimum.accumulate(backward, 1)[:, ::-1]
    both = (left >= 0) & (right < count)
    before = np.take_along_axis(image, np.clip(left, 0, count - 1), 1)
    behind = np.take_along_axis(image, np.clip(right, 0, count - 1), 1)
    width = right - left - 1
    found: Mask = (image == 0) & both & (width > 1) & (np.abs(before - behind) > _JUMP_M + 8 * frame.noise_m)
    if baseline_m is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            widest = camera.focal_px * baseline_m * np.abs(1 / before - 1 / behind)
        found &= width <= _WIDER * widest + _CLOSED_PX
    return found
