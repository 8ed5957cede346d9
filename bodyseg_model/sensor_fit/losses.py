"""Pixels lost on bodies, divided into random ones, patches and stripes; edges and shadows are left out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np

from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, UNKNOWN, Estimate, Finding, rounded
from bodyseg_model.sensor_fit.recording import (
    Floats,
    MarkedFrame,
    MarkedRecording,
    Mask,
    closing,
    dilated,
    eroded,
    jumps,
    mean_of,
    smooth_surface,
)

_MARGIN_PX: Final = 6  # so near an edge of a surface, lost pixels are not counted singly: they are not lost at random
_SEEN_SHARE: Final = 0.1  # least share of a still body's frames that show it in a pixel which counts as the body's
_LEAST_PIXELS: Final = 2000
_LEAST_SHARE: Final = 0.002  # share of lost pixels from which on an artifact is needed
_CLOSED_PX: Final = 2
_JUMP_M: Final = 0.03
_NOISES: Final = 8.0
_TURNED: Final = 1.2  # slope, as its tangent, of a surface that turns away from the camera
_RIM_PX: Final = 4
_BAND: Final = 0.02  # most pixels of a row that is a stripe, as a share of those in a typical row
_RUN_PX: Final = 15  # run of lost pixels that is no chance, nor an edge
_FEWEST_BANDS: Final = 2  # a single band may be a patch across a limb, as may several of different widths
_FEWEST_CUT: Final = 3  # fewest bands if only one of them is not cut off by an end of the body
_ALIKE_BANDS: Final = 0.6
_SOLID_PX: Final = 2
_IN_FRAMES: Final = 0.1  # share of frames with that much lost from which on it is no chance
_STRIPED_FRAMES: Final = 0.4  # the same for stripes, which patches across a limb look like
_ALIKE: Final = 0.15  # rates closer than this share of themselves are one
_MOST_RATES: Final = 4


@dataclass(frozen=True)
class BodyOutline:
    """The body of one frame as it would be without loss, all arrays bool [H, W].

    full: its pixels; inside: those farther than `_MARGIN_PX` from an edge. lost: those without a range, shadows aside;
    shadow: lost behind an edge of the body. stripes: in whole rows or columns that are lost. still: whether the outline
    is known from other frames of a body that stands still.
    """

    full: Mask
    inside: Mask
    lost: Mask
    shadow: Mask
    stripes: dict[str, Mask]
    still: bool

    @property
    def striped(self) -> Mask:
        """Pixels in stripes of either direction, bool [H, W]."""
        return self.stripes["rows"] | self.stripes["columns"]

    @property
    def solid(self) -> Mask:
        """Lost pixels in areas with none left, bool [H, W]: a square of five pixels fits in."""
        return dilated(eroded(self.lost, _SOLID_PX), _SOLID_PX + 1) & self.lost


def outlines_of(recording: MarkedRecording) -> list[BodyOutline]:
    """The outline of each frame's body; a still body's is that of all frames together."""
    if recording.still:
        return _outlines(recording.frames, recording)
    return [_outlines((frame,), recording)[0] for frame in recording.frames if frame.body.any()]


def _outlines(frames: Sequence[MarkedFrame], recording: MarkedRecording) -> list[BodyOutline]:
    """The outlines of one body in a single frame, or in several that differ by losses and noise alone."""
    seen = sum(frame.body.astype(np.int64) for frame in frames)
    room = np.asarray(sum(frame.room.astype(np.int64) for frame in frames) > len(frames) // 2)
    shown = np.asarray(seen >= max(1.0, _SEEN_SHARE * len(frames))) & ~room
    if len(frames) == 1:
        shown = _bridged(shown)
    mean, known, noise_m = mean_of(frames)
    surface = partial(smooth_surface, mean, known, noise_m, recording.camera)
    full = _without_gaps(filled(shown, room), shown, surface)
    edges = jumps(mean, known, _JUMP_M + _NOISES * noise_m)
    inside = eroded(full, _MARGIN_PX) & ~dilated(edges, _MARGIN_PX - 1)
    found = []
    for frame in frames:
        missing, behind = full & (frame.range_m == 0), _behind_edges(frame) & (seen == 0)
        rows, columns = _striped_rows(frame.body, full), _striped_rows(frame.body.T, full.T)
        stripes = {"rows": _stripes_along(rows, missing), "columns": _stripes_along(columns, missing.T).T}
        found.append(BodyOutline(full, inside, missing & ~behind, missing & behind, stripes, recording.still))
    return found


def _stripes_along(striped: Mask, missing: Mask) -> Mask:
    """Lost pixels of rows that are lost whole, and long runs of them in the next rows: stripes may end within a row."""
    from scipy.ndimage import binary_opening

    beside, runs = striped | np.roll(striped, 1) | np.roll(striped, -1), np.ones((1, _RUN_PX))
    return missing & (striped[:, None] | np.asarray(binary_opening(missing & beside[:, None], runs), np.bool_))


def filled(body: Mask, room: Mask) -> Mask:
    """A body with its holes: gaps of a few pixels, and whatever no path through empty pixels joins to the outside."""
    from skimage.measure import label

    closed = closing(body, _CLOSED_PX) & ~room
    regions = label(np.pad(~closed, 1, constant_values=True), connectivity=1)  # 0 on the body
    outside = np.append(regions[1:-1, 1:-1][room], (regions[0, 0]))
    return ~np.isin(regions[1:-1, 1:-1], outside)


def _without_gaps(full: Mask, shown: Mask, surface: Callable[[], tuple[Floats, Floats]]) -> Mask:
    """A body without the holes through which nothing was there to see, such as between arm and trunk.

    surface: `smooth_surface` of the body, called if there are holes. Around a gap the surface turns away from the
    camera; around a lost patch it does not.
    """
    from skimage.measure import label

    empty = full & ~closing(shown, _CLOSED_PX)
    holes = label(dilated(eroded(empty, 1), 2) & empty, connectivity=1)
    kept = full.copy()
    slope = surface()[1] if holes.any() else np.zeros(full.shape)
    for number in range(1, int(holes.max()) + 1):
        hole = holes == number
        rim = slope[dilated(hole, _RIM_PX) & np.isfinite(slope)]
        if len(rim) and np.median(rim) > _TURNED:
            kept &= ~dilated(hole, _CLOSED_PX) | shown
    return kept


def _bridged(body: Mask) -> Mask:
    """A body with each band of lost rows or columns filled from its nearer end, so that the body's area is right."""
    bridged = body.copy()
    for image, out in ((body, bridged), (body.T, bridged.T)):
        kept = np.flatnonzero(~_striped_rows(image, image))
        out |= image[kept[np.abs(np.arange(len(image))[:, None] - kept).argmin(1)]]
    return bridged


def _striped_rows(body: Mask, full: Mask) -> Mask:
    """Rows of the full body that show next to nothing, bool [H], if stripes of one width, but for one at an end."""
    striped = np.zeros(len(body), np.bool_)
    counts, reach = np.count_nonzero(body, axis=1), np.flatnonzero(full.any(1))
    if not counts.any() or not len(reach):
        return striped
    top, bottom = int(reach[0]), int(reach[-1]) + 1
    empty = counts <= _BAND * np.median(counts[counts > 0])
    empty[:top] = empty[bottom:] = False
    edges = np.flatnonzero(np.diff(np.concatenate([[0], empty.astype(np.int8), [0]]))).reshape(-1, 2)
    bands = edges[(edges[:, 0] > 0) & (edges[:, 1] < len(counts))]
    cut = (bands[:, 0] == top) | (bands[:, 1] == bottom)
    inner = np.count_nonzero(~cut)
    if not inner or (inner == 1 and len(bands) < _FEWEST_CUT):
        return striped
    widths = np.diff(bands)[:, 0]
    beyond = widths - np.median(widths[~cut])
    alike = (np.abs(beyond) <= _CLOSED_PX) | (cut & (beyond <= _CLOSED_PX))
    if np.count_nonzero(alike) >= max(_FEWEST_BANDS, _ALIKE_BANDS * len(bands)):
        for start, end in bands:
            striped[start:end] = True
    return striped


def _behind_edges(frame: MarkedFrame) -> Mask:
    """Lost pixels between two pixels of a row whose ranges differ by an edge, where a projector's shadow lies."""
    image = frame.range_m.astype(np.float64)
    count = image.shape[1]
    left = np.maximum.accumulate(np.where(image > 0, np.arange(count), -1), 1)
    right = np.minimum.accumulate(np.where(image > 0, np.arange(count), count)[:, ::-1], 1)[:, ::-1]
    before = np.take_along_axis(image, np.clip(left, 0, count - 1), 1)
    behind = np.take_along_axis(image, np.clip(right, 0, count - 1), 1)
    found: Mask = (image == 0) & (left >= 0) & (right < count) & (right - left > 2)
    return found & (np.abs(before - behind) > _JUMP_M + _NOISES * frame.noise_m)


def measure_losses(outlines: Sequence[BodyOutline]) -> list[Finding]:
    """Findings of "missing_data", "patch_loss" and "stripe_loss"."""
    pixels = sum(int(np.count_nonzero(outline.inside)) for outline in outlines)
    if pixels < _LEAST_PIXELS:
        few = f"bodies have {pixels} pixels away from their outline, {_LEAST_PIXELS} are needed"
        return [Finding(name, UNKNOWN, few) for name in ("missing_data", "patch_loss", "stripe_loss")]
    return [_random(outlines), _patches(outlines), _stripes(outlines)]


def _random(outlines: Sequence[BodyOutline]) -> Finding:
    """The finding of "missing_data": single lost pixels, counted away from edges, patches, stripes and shadows."""
    areas = [each.inside & ~dilated(each.solid | each.striped | each.shadow, _SOLID_PX) for each in outlines]
    counts = np.array([np.count_nonzero(area) for area in areas])
    lost = [np.count_nonzero(outline.lost & area) for outline, area in zip(outlines, areas, strict=True)]
    rates = lost / np.maximum(counts, 1)
    mean = float(np.sum(lost) / max(counts.sum(), 1))
    apart = np.sum((mean * counts - lost) ** 2) / max(counts.sum(), 1)  # frames may differ in their shares
    variance = (max(mean * (1 - mean), 1e-6) + apart) / max(counts.sum(), 1)
    estimates = {"share": Estimate(mean, float(np.sqrt(variance)))}
    if mean < _LEAST_SHARE:
        return Finding("missing_data", NOT_SEEN, f"{mean:.2%} of {counts.sum()} pixels lost singly", estimates)
    strengths, reason = _rates(rates[counts > 0])
    return Finding("missing_data", NEEDED, f"{mean:.2%} of pixels lost singly; {reason}", estimates, strengths)


def _rates(rates: Floats) -> tuple[dict[str, Any], str]:
    """Strengths by the frames' rates, and a reason: one rate, a few that frames change between, or an interval."""
    groups: list[list[float]] = []
    ordered: list[float] = np.sort(rates).tolist()
    for rate in ordered:
        if groups and rate - groups[-1][0] <= max(0.01, _ALIKE * rate):
            groups[-1].append(rate)
        else:
            groups.append([rate])
    levels = [float(np.mean(group)) for group in groups]
    if len(levels) == 1:
        return {"rates": (rounded(levels[0]),)}, "the same share in all frames"
    if len(levels) <= _MOST_RATES and all(len(group) > 1 for group in groups):
        named = tuple(rounded(level) if level >= _LEAST_SHARE / 2 else 0.0 for level in levels)
        return {"rates": named}, f"frames change between {', '.join(f'{level:.1%}' for level in named)}"
    low, high = _uniform(rates)
    return {"between": (rounded(low), rounded(high))}, f"from {low:.1%} to {high:.1%} in a frame"


def _patches(outlines: Sequence[BodyOutline]) -> Finding:
    masks = [each.solid & ~dilated(each.striped, _SOLID_PX) for each in outlines]
    missed = "patches that cut the outline are only seen on still bodies"
    found = _area_loss("patch_loss", "patches", outlines, masks, _IN_FRAMES, missed)
    if found.verdict == NOT_SEEN and not outlines[0].still:
        return replace(found, verdict=UNKNOWN, reason=f"{found.reason}; {missed}")
    return found


def _stripes(outlines: Sequence[BodyOutline]) -> Finding:
    def lost(along: str) -> int:
        return sum(int(np.count_nonzero(each.stripes[along])) for each in outlines)

    along = max(("rows", "columns"), key=lost)
    masks, missed = [each.stripes[along] for each in outlines], "those at the body's ends are only seen on still bodies"
    found = _area_loss("stripe_loss", f"whole {along}", outlines, masks, _STRIPED_FRAMES, missed)
    return replace(found, strengths={**found.strengths, "along": along}) if found.verdict == NEEDED else found


def _area_loss(
    name: str, what: str, outlines: Sequence[BodyOutline], masks: Sequence[Mask], in_frames: float, missed: str
) -> Finding:
    """A finding by the masks' shares of the bodies' pixels. missed: a text on what moving bodies do not show."""
    full = np.array([max(np.count_nonzero(outline.full), 1) for outline in outlines])
    shares = np.array([np.count_nonzero(mask) for mask in masks]) / full
    mean = float(shares.mean())
    error = float(shares.std(ddof=1) / np.sqrt(len(shares))) if len(shares) > 1 else mean
    low, high = _uniform(shares)
    estimates = {"share": Estimate(mean, error), "low": Estimate(low), "high": Estimate(high)}
    if (shares >= _LEAST_SHARE).sum() < max(min(2, len(shares)), in_frames * len(shares)):
        return Finding(name, NOT_SEEN, f"{mean:.2%} of the bodies lost in {what}", {"share": estimates["share"]})
    reason = f"{estimates['share']} of the bodies lost in {what}, {shares.min():.1%} to {shares.max():.1%} a frame"
    reason += "" if outlines[0].still else f"; at least, as {missed}"
    return Finding(name, NEEDED, reason, estimates, {"low": rounded(low), "high": rounded(high)})


def _uniform(values: Floats) -> tuple[float, float]:
    """Ends of a uniform distribution by the extremes of the values, widened as their number says, within 0 to 1."""
    low, high = float(values.min()), float(values.max())
    beyond = (high - low) / max(len(values) - 1, 1)
    return max(low - beyond, 0.0), min(high + beyond, 1.0)
