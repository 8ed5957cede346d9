"""Silhouettes before a farther surface: mixed (flying) pixels, and jitter of the outline."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, UNKNOWN, Estimate, Finding, rounded
from bodyseg_model.sensor_fit.recording import Recording

LEAST_EDGES: Final = 200
"""Fewest edges at which one surface ends beside a farther one, both measured, for a verdict."""

END: Final = 0.2
"""Share of a gap at either end that counts as the end itself: limbs turn away steeply before their edge."""

LEAST_SHARE: Final = 0.05
JUMP_M: Final = 0.03

_WIDE: Final = 6.0  # jumps that a gap must have: limbs that turn away bridge smaller ones
_NOISES: Final = 8.0

Floats = NDArray[np.float64]


def measure_mixed_pixels(recording: Recording) -> Finding:
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
    if share < LEAST_SHARE:
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
