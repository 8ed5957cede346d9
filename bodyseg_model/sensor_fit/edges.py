"""Edges before a farther surface: mixed (flying) pixels, and the projector's shadow, by its side and width."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_model.recordings import FrameCamera, evenly_apart
from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, UNKNOWN, Estimate, Finding, rounded
from bodyseg_model.sensor_fit.recording import MarkedFrame, MarkedRecording

LEAST_EDGES: Final = 200
"""Fewest edges at which one surface ends beside a farther one, both measured, for a verdict."""

END: Final = 0.2
"""Share of a gap at either end that counts as the end itself: limbs turn away steeply before their edge."""

LEAST_MIXED_SHARE: Final = 0.05
JUMP_M: Final = 0.03

_WIDE: Final = 6.0  # jumps that a gap must have: limbs that turn away bridge smaller ones
_NOISES: Final = 8.0

Floats = NDArray[np.float64]


def measure_mixed_pixels(recording: MarkedRecording) -> Finding:
    """The finding of "mixed_pixels": edges with a pixel between both ranges, against edges without one.

    A position nearer than a jump or `END` to either end counts as the end; the share is corrected for these, since
    positions are even over the gap. Edges with lost pixels between both surfaces are left out.
    """
    mixed, plain, between, beside, room = 0, 0, 0.0, 0.0, []
    for frame in recording.frames:
        jump = max(JUMP_M, _NOISES * frame.noise_m)
        for image, body in ((frame.range_m, frame.body), (frame.range_m.T, frame.body.T)):
            gaps_mixed, gaps_plain = _edges(image.astype(np.float64), body, jump)
            mixed += len(gaps_mixed)
            plain += len(gaps_plain)
            each = 1 / (1 - 2 * np.maximum(jump / gaps_mixed, END))
            between += float(each.sum())
            beside += float((each * 2 * jump / gaps_mixed).sum())  # so near to an end that they look like it
        room.append(float(np.median(frame.range_m[frame.room])) if frame.room.any() else np.nan)
    if mixed + plain < LEAST_EDGES:
        reason = f"{mixed + plain} edges before a measured surface, {LEAST_EDGES} are needed"
        return Finding("mixed_pixels", UNKNOWN, reason)
    share = min(between / (between + max(plain - beside, 0.0)), 1.0) if mixed else 0.0
    error = float(np.sqrt(max(share * (1 - share), 1e-4) / (mixed + plain)))
    estimates = {"share": Estimate(share, error)}
    reason = f"{mixed} of {mixed + plain} edges have a pixel between both ranges"
    if share < LEAST_MIXED_SHARE:
        return Finding("mixed_pixels", NOT_SEEN, reason, estimates)
    strengths = {"share": rounded(share)}
    if np.isfinite(room).any():
        strengths["background_m"] = rounded(float(np.nanmedian(room)))
    return Finding("mixed_pixels", NEEDED, reason, estimates, strengths)


def _edges(image: Floats, body: NDArray[np.bool_], jump: float) -> tuple[Floats, Floats]:
    """Gaps of the edges along rows, metres: with one pixel between both ranges [N], and without [M].

    Two pixels on either side must be of one surface each; the nearer is a body's.
    """
    step = np.diff(image, axis=1)
    known = image > 0
    joined = known[:, 1:] & known[:, :-1]
    flat = joined & (np.abs(step) < jump)
    rise, fall = joined & (step >= jump), joined & (step <= -jump)
    found = []
    for up, near_first in ((rise, True), (fall, False)):
        near, far = (1, 3) if near_first else (3, 1)
        two = flat[:, :-3] & up[:, 1:-2] & up[:, 2:-1] & flat[:, 3:]
        gap_two = np.abs(image[:, 3:-1] - image[:, 1:-3])
        two &= (gap_two >= _WIDE * jump) & body[:, near : near + two.shape[1]]
        with np.errstate(divide="ignore", invalid="ignore"):
            position = np.abs(step[:, 1:-2]) / gap_two
        two &= (position >= END) & (position <= 1 - END)
        near, far = (1, 2) if near_first else (2, 1)
        one = flat[:, :-2] & up[:, 1:-1] & flat[:, 2:]
        gap_one = np.abs(image[:, far : far + one.shape[1]] - image[:, near : near + one.shape[1]])
        one &= (gap_one >= _WIDE * jump) & body[:, near : near + one.shape[1]]
        found.append((gap_two[two], gap_one[one]))
    return np.concatenate([a for a, _ in found]), np.concatenate([b for _, b in found])


Side = Literal["left", "right"]

LEAST_GAPS: Final = 200
"""Fewest rows of both outlines, room behind them, for a verdict."""

LEAST_PX: Final = 2.0
"""Least width of a shadow, pixels; less is an edge."""

_LEAST_DEPTH_M: Final = 0.2
_ONE_SIDED: Final = 1.25  # least ratio of the wider to the narrower shadow that gives a side
_MIDDLE: Final = (0.2, 0.8)
_MARGIN: Final = 3


@dataclass(frozen=True)
class ProjectorShadow:
    """Gaps between bodies and the room behind. baseline_m: by side, width over focal length and difference of inverse
    range, with standard errors. width_px: by side, the median. side: of the wider gap, None if they are alike.
    gaps: rows counted.
    """

    baseline_m: dict[Side, Estimate]
    width_px: dict[Side, float]
    side: Side | None
    gaps: int

    @property
    def total_m(self) -> float:
        """Both sides' baselines together: from camera to projector, wherever between them the image is seen from."""
        return sum(estimate.value for estimate in self.baseline_m.values())


def measure_shadow(recording: MarkedRecording) -> ProjectorShadow | None:
    """Measure the gaps beside bodies in all rows; None where too few rows show the room on both sides."""
    gaps: dict[Side, list[Floats]] = {"left": [], "right": []}
    for frame in recording.frames:
        for side, found in _gaps(frame, recording.camera.focal_px).items():
            gaps[side].append(found)
    rows = {side: np.concatenate(found, 1) for side, found in gaps.items()}
    count = min(found.shape[1] for found in rows.values())
    if count < LEAST_GAPS:
        return None
    baselines, widths = {}, {}
    for side, (width, scale) in rows.items():
        each = width / scale
        low, high = np.quantile(each, _MIDDLE)
        middle = each[(each >= low) & (each <= high)]
        # Rows of one frame, and frames of one pose, are alike: as many independent ones as frames, times ten. Widths
        # are whole pixels, so the mean of the middle ones is finer than the median.
        independent = min(len(middle), 10 * len(recording.frames))
        baselines[side] = Estimate(float(middle.mean()), float(middle.std()) * 1.5 / np.sqrt(independent))
        widths[side] = float(np.median(width))
    narrow, wide = sorted(baselines, key=lambda side: baselines[side].value)
    clear = baselines[wide].value > _ONE_SIDED * baselines[narrow].value
    return ProjectorShadow(baselines, widths, wide if clear and widths[wide] >= LEAST_PX else None, count)


class ShadowFrames:
    """Keeps a few frames, evenly over a recording of `frames`, to tell at its end whether they are mirrored."""

    def __init__(self, frames: int, most: int) -> None:
        self._chosen = {*evenly_apart(frames, most)}
        self._kept: list[MarkedFrame] = []

    def add(self, number: int, name: str, range_m: NDArray[np.float32], bodies: Sequence[NDArray[np.intp]]) -> None:
        """Look at frame `number`, from 0: ranges [H, W], metres, and each body's pixels, flat indices."""
        if number in self._chosen:
            body = np.zeros(range_m.shape, np.bool_)
            for pixels in bodies:
                body.ravel()[pixels] = True
            self._kept.append(MarkedFrame(name, np.zeros(range_m.shape, np.uint16), range_m, body & (range_m > 0)))

    def mirrored(self, camera: FrameCamera) -> bool | None:
        """As `probably_mirrored`, of the frames kept; None without a projector beside the camera."""
        if camera.projector_side is None or not self._kept:
            return None
        shadow = measure_shadow(MarkedRecording(tuple(self._kept), camera.camera, step_m=0.001))
        return probably_mirrored(shadow, camera.projector_side)


def shadow_finding(shadow: ProjectorShadow | None, projector: Side | None) -> Finding:
    """The finding of "occlusion". projector: its side of the camera where the sensor is known."""
    if shadow is None:
        reason = f"fewer than {LEAST_GAPS} rows show the room behind a body on both sides"
        return Finding("occlusion", UNKNOWN, reason)
    estimates = {f"baseline_{side}_m": estimate for side, estimate in shadow.baseline_m.items()}
    widths = ", ".join(f"{width:.3g} px {side}" for side, width in shadow.width_px.items())
    if max(shadow.width_px.values()) < LEAST_PX:
        return Finding("occlusion", NOT_SEEN, f"gaps beside bodies are {widths}", estimates)
    sides = ", ".join(f"{estimate} m {side}" for side, estimate in shadow.baseline_m.items())
    reason = f"gaps of {widths}: baselines of {sides}"
    if shadow.side is None:
        return Finding("occlusion", UNKNOWN, f"{reason}, alike on both sides as edges are", estimates)
    narrow: Side = "left" if shadow.side == "right" else "right"
    if shadow.width_px[narrow] >= LEAST_PX:
        total = Estimate(shadow.total_m, math.hypot(*(each.error for each in shadow.baseline_m.values())))
        estimates["baseline_m"] = total
        reason += f", {total} m together: the image is seen from between camera and projector, or edges are lost too"
    else:
        estimates["baseline_m"] = shadow.baseline_m[shadow.side]
    if (mirrored := probably_mirrored(shadow, projector)) is not None:
        reason += (
            f"; a projector on the camera's {projector} " + ("cannot" if mirrored else "does") + " cast them there"
        )
        reason += ": frames are probably mirrored" if mirrored else ": frames are not mirrored"
    return Finding("occlusion", NEEDED, reason, estimates)


def probably_mirrored(shadow: ProjectorShadow | None, projector: Side | None) -> bool | None:
    """True if the wider shadow lies on the projector's own side, where it cannot; None if that cannot be told.

    Light from the right of the camera leaves the left of what is behind a body dark.
    """
    if shadow is None or shadow.side is None or projector is None:
        return None
    return shadow.side == projector


def _gaps(frame: MarkedFrame, focal_px: float) -> dict[Side, Floats]:
    """Gaps between body and room in the rows of a frame: widths in pixels and focal length times the difference of
    inverse ranges, [2, N] for each side.
    """
    found: dict[Side, Floats] = {}
    for side in ("left", "right"):
        flip = np.s_[:, ::-1] if side == "left" else np.s_[:, :]
        range_m, body = frame.range_m[flip].astype(np.float64), frame.body[flip]
        rows, ends, begins = _ends(range_m, body)
        near, far = range_m[rows, ends], range_m[rows, begins]
        apart = far - near >= _LEAST_DEPTH_M
        rows, ends, begins = rows[apart], ends[apart], begins[apart]
        inverse = 1 / near[apart] - 1 / far[apart]
        found[side] = np.stack([(begins - ends - 1).astype(np.float64), focal_px * inverse])
    return found


def _ends(range_m: Floats, body: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Rows in which room follows the last body pixel to the right: rows, that pixel's column, and the room's first."""
    columns = range_m.shape[1]
    index = np.arange(columns)
    last = np.where(body, index, -1).max(1)
    room = (range_m > 0) & ~body & (index > last[:, None])
    first = np.where(room, index, columns).min(1)
    usable = np.flatnonzero((last >= 0) & (first < columns - _MARGIN))
    # A wall goes on beside its first pixel; a flying pixel is alone.
    steady = [np.count_nonzero(room[row, first[row] : first[row] + _MARGIN]) == _MARGIN for row in usable]
    usable = usable[np.array(steady, np.bool_)] if len(usable) else usable
    return usable, last[usable], first[usable]
