"""Edges before a farther surface: mixed (flying) pixels, and the projector's shadow, by its side and width."""

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.rigs import Rig
from bodyseg_model.recordings import FrameCamera, evenly_apart
from bodyseg_model.segmentation import LabelledFrame
from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, UNKNOWN, Estimate, Finding, rounded
from bodyseg_model.sensor_fit.recording import Floats, MarkedFrame, MarkedRecording

_LEAST_EDGES: Final = 200  # edges, each between two measured surfaces, that a verdict needs
_END: Final = 0.2  # share of a gap at either end that counts as the end: limbs turn away steeply before their edge
_LEAST_MIXED_SHARE: Final = 0.05
_JUMP_M: Final = 0.03
_WIDE: Final = 6.0  # least gap, in jumps: limbs that turn away bridge smaller ones
_NOISES: Final = 8.0
_LEAST, _MOST = 0.7, 1.5  # measured baseline over the rig's, which is 0.71 for a projector as far above as beside


def measure_mixed_pixels(recording: MarkedRecording) -> Finding:
    """The finding of "mixed_pixels": edges with a pixel between both ranges, against edges without one.

    A position nearer than `_END`, which is more than a jump, to either end counts as the end; the share is corrected
    for these, since positions are even over the gap. Edges with lost pixels between both surfaces are left out.
    """
    mixed, plain, ends, room = 0, 0, 0.0, []
    for frame in recording.frames:
        jump = max(_JUMP_M, _NOISES * frame.noise_m)
        image = frame.range_m.astype(np.float64)
        for quarters in range(4):
            gaps_mixed, gaps_plain = _edges(np.rot90(image, quarters), np.rot90(frame.body, quarters), jump)
            mixed += len(gaps_mixed)
            plain += len(gaps_plain)
            ends += float((2 * jump / gaps_mixed).sum())  # shares of a gap so near an end that they look like it
        room.append(float(np.median(frame.range_m[frame.room])) if frame.room.any() else np.nan)
    if mixed + plain < _LEAST_EDGES:
        few = f"{mixed + plain} edges before a measured surface, {_LEAST_EDGES} are needed"
        return Finding("mixed_pixels", UNKNOWN, few)
    between, beside = mixed / (1 - 2 * _END), ends / (1 - 2 * _END)
    share = between / (between + max(plain - beside, 0.0)) if mixed else 0.0
    error = float(np.sqrt(max(share * (1 - share), 1e-4) / (mixed + plain)))
    estimates = {"share": Estimate(share, error)}
    reason = f"{mixed} of {mixed + plain} edges have a pixel between both ranges"
    if share < _LEAST_MIXED_SHARE:
        return Finding("mixed_pixels", NOT_SEEN, reason, estimates)
    behind = {"background_m": rounded(float(np.nanmedian(room)))} if np.isfinite(room).any() else {}
    return Finding("mixed_pixels", NEEDED, reason, estimates, {"share": rounded(share), **behind})


def _edges(image: Floats, body: NDArray[np.bool_], jump: float) -> tuple[Floats, Floats]:
    """Gaps, metres, at edges after which a row goes on farther away: of edges with one pixel between both ranges [N],
    and without [M]. Two pixels on either side must be of one surface each; the nearer surface is a body's.
    """
    step, joined = np.diff(image), (image[:, 1:] > 0) & (image[:, :-1] > 0)
    flat, rise = joined & (np.abs(step) < jump), joined & (step >= jump)
    two = flat[:, :-3] & rise[:, 1:-2] & rise[:, 2:-1] & flat[:, 3:] & body[:, 1:-3]
    gap = image[:, 3:-1] - image[:, 1:-3]
    two &= (gap >= _WIDE * jump) & (step[:, 1:-2] >= _END * gap) & (step[:, 1:-2] <= (1 - _END) * gap)
    one = flat[:, :-2] & rise[:, 1:-1] & flat[:, 2:] & body[:, 1:-2] & (step[:, 1:-1] >= _WIDE * jump)
    one[:, :-1] &= joined[:, 3:]  # as many measured pixels as of the others, or lost pixels would leave more of these
    return gap[two], step[:, 1:-1][one]


Side = Literal["left", "right"]

_LEAST_GAPS: Final = 200  # rows of both outlines, with room behind them, that a verdict needs
_LEAST_PX: Final = 2.0  # least width of a shadow; less is an edge
_LEAST_DEPTH_M: Final = 0.2
_ONE_SIDED: Final = 1.25  # least ratio of the wider to the narrower shadow that gives a side
_MIDDLE: Final = (0.2, 0.8)
_MARGIN: Final = 3
_MIXED_M: Final = 0.05  # least step from a body's pixel to a mixed one beside it; limbs curve by less


@dataclass(frozen=True)
class ProjectorShadow:
    """Gaps between bodies and the room behind. baseline_m: by side, width over focal length and difference of inverse
    range, with standard errors. width_px: by side, the median. side: of the wider gap, None if they are alike.
    """

    baseline_m: dict[Side, Estimate]
    width_px: dict[Side, float]
    side: Side | None


def measure_shadow(recording: MarkedRecording) -> ProjectorShadow | None:
    """Measure the gaps beside bodies in all rows; None where too few rows show the room on both sides."""
    sides: tuple[Side, Side] = ("left", "right")
    frames, focal_px = recording.frames, recording.camera.focal_px
    rows = {side: np.concatenate([_gaps(frame, focal_px, side) for frame in frames], 1) for side in sides}
    if min(found.shape[1] for found in rows.values()) < _LEAST_GAPS:
        return None
    baselines: dict[Side, Estimate] = {}
    widths: dict[Side, float] = {}
    for side, (width, scale) in rows.items():
        each = width / scale
        low, high = np.quantile(each, _MIDDLE)
        middle = each[(each >= low) & (each <= high)]
        # Rows of one frame, and frames of one pose, are alike: ten rows a frame count as independent. Widths are whole
        # pixels, so the mean of the middle ones is finer than the median; rows of one depth share their rounding.
        independent = min(len(middle), 10 * len(recording.frames))
        error = np.hypot(middle.std() * 1.5 / np.sqrt(independent), 1 / np.sqrt(12) / np.median(scale))
        baselines[side] = Estimate(float(middle.mean()), float(error))
        widths[side] = float(np.median(width))
    narrow, wide = sorted(baselines, key=lambda side: baselines[side].value)
    clear = baselines[wide].value > _ONE_SIDED * baselines[narrow].value
    return ProjectorShadow(baselines, widths, wide if clear and widths[wide] >= _LEAST_PX else None)


class ShadowFrames:
    """Keeps a few frames, evenly over a recording of `frames`, to tell at its end whether they are mirrored."""

    def __init__(self, frames: int, most: int) -> None:
        self._chosen = {*evenly_apart(frames, most)}
        self._kept: list[MarkedFrame] = []

    def add(self, frame: LabelledFrame) -> None:
        """Look at a frame of the recording."""
        if frame.number in self._chosen:
            range_m, body = frame.range_m, (frame.persons > 0) & (frame.range_m > 0)
            self._kept.append(MarkedFrame(np.zeros(range_m.shape, np.uint16), range_m, body))

    def mirrored(self, camera: FrameCamera) -> bool | None:
        """As `probably_mirrored`, of the frames kept; None without a projector beside the camera."""
        if camera.projector_side is None or not self._kept:
            return None
        shadow = measure_shadow(MarkedRecording(tuple(self._kept), camera.camera, step_m=0.001))
        return probably_mirrored(shadow, camera.projector_side)


def shadow_finding(shadow: ProjectorShadow | None, projector: Side | None, rig: Rig | None = None) -> Finding:
    """The finding of "occlusion". projector: its side of the camera where the sensor is known; rig: the sensor's."""
    if shadow is None:
        return Finding("occlusion", UNKNOWN, f"fewer than {_LEAST_GAPS} rows show the room behind a body on both sides")
    estimates = {f"baseline_{side}_m": estimate for side, estimate in shadow.baseline_m.items()}
    widths = ", ".join(f"{width:.3g} px {side}" for side, width in shadow.width_px.items())
    several = rig is not None and rig.second_projector is not None
    if max(shadow.width_px.values()) < _LEAST_PX:
        beside = projector is not None or rig is None or several or rig.baseline_m == 0
        verdict, why = (NOT_SEEN, "") if beside else (UNKNOWN, ": a projector above or below casts none there")
        return Finding("occlusion", verdict, f"gaps beside bodies are {widths}{why}", estimates)
    sides = ", ".join(f"{estimate} m {side}" for side, estimate in shadow.baseline_m.items())
    reason = f"gaps of {widths}: baselines of {sides}"
    if shadow.side is None:
        return Finding("occlusion", UNKNOWN, f"{reason}, alike on both sides as edges are", estimates)
    if min(shadow.width_px.values()) >= _LEAST_PX:
        both = shadow.baseline_m.values()
        total = Estimate(sum(each.value for each in both), math.hypot(*(each.error for each in both)))
        estimates |= {"baseline_m": total}
        reason += f", {total} m together: the image is seen from between camera and projector, or edges are lost too"
    else:
        estimates["baseline_m"] = shadow.baseline_m[shadow.side]
    if (mirrored := probably_mirrored(shadow, projector)) is not None:
        can, are = ("cannot", "probably") if mirrored else ("does", "not")
        reason += f"; a projector on the camera's {projector} {can} cast them there: frames are {are} mirrored"
        if rig and not several and not _LEAST <= estimates["baseline_m"].value / rig.baseline_m <= _MOST:
            reason += f"; the rig's baseline is {rig.baseline_m:.3g} m"
    return Finding("occlusion", NEEDED, reason, estimates)


def probably_mirrored(shadow: ProjectorShadow | None, projector: Side | None) -> bool | None:
    """True if the wider shadow lies on the projector's own side, where it cannot; None if that cannot be told.

    Light from the right of the camera leaves the left of what is behind a body dark.
    """
    if shadow is None or shadow.side is None or projector is None:
        return None
    return shadow.side == projector


def _gaps(frame: MarkedFrame, focal_px: float, side: Side) -> Floats:
    """Gaps in rows between body and room: width, pixels; focal length times inverse ranges' difference, [2, N]."""
    flip = np.s_[:, ::-1] if side == "left" else np.s_[:, :]
    range_m, body, room = frame.range_m[flip].astype(np.float64), frame.body[flip], frame.room[flip]
    columns = np.arange(range_m.shape[1])
    last = np.where(body, columns, -1).max(1)
    first = np.where(room & (columns > last[:, None]), columns, len(columns)).min(1)
    rows = np.flatnonzero((last >= 0) & (first < len(columns) - _MARGIN))
    # A wall goes on beside its first pixel; a flying pixel is alone.
    steady = room[rows[:, None], first[rows, None] + np.arange(_MARGIN)].all(1)
    near, far = range_m[rows, last[rows]], range_m[rows, first[rows]]
    for inner in range(1, _MARGIN):  # the last pixels may be mixed ones, farther away
        at = np.maximum(last[rows] - inner, 0)
        near = np.where(body[rows, at] & (near - range_m[rows, at] > _MIXED_M), range_m[rows, at], near)
    found = np.stack([(first - last - 1)[rows].astype(np.float64), focal_px * (1 / near - 1 / far)])
    return found[:, steady & (far - near >= _LEAST_DEPTH_M)]
