"""Pixels lost on bodies, divided into random ones, patches, stripes, grazing surfaces and edges."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, UNKNOWN, Estimate, Finding, rounded
from bodyseg_model.sensor_fit.outlines import RINGS, BodyOutline
from bodyseg_model.sensor_fit.recording import dilated, opening

LEAST_PIXELS: Final = 2000
LEAST_SHARE: Final = 0.002
"""Least share of lost pixels for which an artifact is needed."""

NAMES: Final = ("missing_data", "patch_loss", "stripe_loss", "grazing_loss", "edge_loss")

_SOLID_PX: Final = 2
_STEEP_DEG: Final = 60.0
_IN_FRAMES: Final = 0.1  # of the frames with that much lost show that it is no chance
_STRIPED_FRAMES: Final = 0.4  # the same for stripes, which patches across a limb look like
_ALIKE: Final = 0.15  # rates closer than this share of themselves are one
_MOST_RATES: Final = 4

Mask = NDArray[np.bool_]


def measure_losses(outlines: Sequence[BodyOutline]) -> list[Finding]:
    """Findings of "missing_data", "patch_loss", "stripe_loss", "grazing_loss" and "edge_loss"."""
    pixels = sum(int(np.count_nonzero(outline.inside)) for outline in outlines)
    if pixels < LEAST_PIXELS:
        reason = f"bodies have {pixels} pixels away from their outline, {LEAST_PIXELS} are needed"
        return [Finding(name, UNKNOWN, reason) for name in NAMES]
    solid = [_solid(outline) for outline in outlines]
    areas = [scattered(outline, patches) for outline, patches in zip(outlines, solid, strict=True)]
    grazing, edge = measure_surface_losses(outlines, areas)
    cut = float(grazing.strengths.get("from_deg", 90.0))
    return [_random(outlines, areas, cut), _patches(outlines, solid), _stripes(outlines), grazing, edge]


def _solid(outline: BodyOutline) -> Mask:
    """Lost pixels in areas with none left: a square of five pixels fits in."""
    core = opening(outline.lost, _SOLID_PX)
    return dilated(core, 1) & outline.lost


def _striped(outline: BodyOutline) -> Mask:
    return outline.stripes["rows"] | outline.stripes["columns"]


def scattered(outline: BodyOutline, solid: Mask) -> Mask:
    """Pixels where single lost ones are counted: not in patches, stripes or shadows, nor next to them."""
    return outline.full & ~dilated(solid | _striped(outline) | outline.shadow, _SOLID_PX)


def _random(outlines: Sequence[BodyOutline], areas: Sequence[Mask], cut_deg: float) -> Finding:
    rates, counts = [], []
    for outline, singly in zip(outlines, areas, strict=True):
        flat = np.nan_to_num(outline.incidence_deg, nan=0.0) < min(cut_deg, _STEEP_DEG)
        area = singly & outline.inside & flat
        counts.append(int(np.count_nonzero(area)))
        rates.append(np.count_nonzero(outline.lost & area) / max(counts[-1], 1))
    mean = float(np.average(rates, weights=np.maximum(counts, 1)))
    error = float(np.sqrt(max(mean * (1 - mean), 1e-6) / max(sum(counts), 1)))
    estimates = {"share": Estimate(mean, error)}
    if mean < LEAST_SHARE:
        return Finding("missing_data", NOT_SEEN, f"{mean:.2%} of {sum(counts)} pixels lost singly", estimates)
    strengths, reason = _rates(np.array(rates), np.array(counts))
    return Finding("missing_data", NEEDED, f"{mean:.2%} of pixels lost singly; {reason}", estimates, strengths)


def _rates(rates: NDArray[np.float64], counts: NDArray[np.int64]) -> tuple[dict[str, object], str]:
    """One rate, a few that frames change between, or an interval."""
    groups: list[list[float]] = []
    ordered: list[float] = np.sort(rates[counts > 0]).tolist()
    for rate in ordered:
        if groups and rate - groups[-1][0] <= max(0.01, _ALIKE * rate):
            groups[-1].append(rate)
        else:
            groups.append([rate])
    levels = [float(np.mean(group)) for group in groups]
    if len(levels) == 1:
        return {"rates": (rounded(levels[0]),)}, "the same share in all frames"
    if len(levels) <= _MOST_RATES and all(len(group) > 1 for group in groups):
        named = tuple(rounded(level) if level >= LEAST_SHARE / 2 else 0.0 for level in levels)
        return {"rates": named}, f"frames change between {', '.join(f'{level:.1%}' for level in named)}"
    low, high = _uniform(rates)
    return {"between": (rounded(low), rounded(high))}, f"from {low:.1%} to {high:.1%} in a frame"


def _patches(outlines: Sequence[BodyOutline], solid: Sequence[Mask]) -> Finding:
    shares = _shares(
        outlines, [patches & ~dilated(_striped(o), _SOLID_PX) for o, patches in zip(outlines, solid, strict=True)]
    )
    if outlines[0].still:
        return _area_loss("patch_loss", "patches", shares, {}, _IN_FRAMES, "")
    unseen = "patches that cut the outline are only seen on still bodies"
    found = _area_loss("patch_loss", "patches", shares, {}, _IN_FRAMES, f"; at least, as {unseen}")
    if found.verdict == NOT_SEEN:
        return replace(found, verdict=UNKNOWN, reason=f"{found.reason}; {unseen}")
    return found


def _stripes(outlines: Sequence[BodyOutline]) -> Finding:
    both = {along: _shares(outlines, [o.stripes[along] for o in outlines]) for along in ("rows", "columns")}
    along = max(both, key=lambda name: float(both[name].mean()))
    missed = "" if outlines[0].still else "; at least, as those at the body's ends are only seen on still bodies"
    return _area_loss("stripe_loss", f"whole {along}", both[along], {"along": along}, _STRIPED_FRAMES, missed)


def _shares(outlines: Sequence[BodyOutline], masks: Sequence[Mask]) -> NDArray[np.float64]:
    """Share of each body's pixels in a mask, [N]."""
    lost = np.array([np.count_nonzero(mask) for mask in masks], np.float64)
    shares: NDArray[np.float64] = lost / [max(int(np.count_nonzero(outline.full)), 1) for outline in outlines]
    return shares


def _area_loss(
    name: str, what: str, shares: NDArray[np.float64], more: dict[str, str], in_frames: float, missed: str
) -> Finding:
    mean = float(shares.mean())
    error = float(shares.std(ddof=1) / np.sqrt(len(shares))) if len(shares) > 1 else mean
    low, high = _uniform(shares)
    estimates = {"share": Estimate(mean, error), "low": Estimate(low), "high": Estimate(high)}
    if (shares >= LEAST_SHARE).sum() < max(min(2, len(shares)), in_frames * len(shares)):
        return Finding(name, NOT_SEEN, f"{mean:.2%} of the bodies lost in {what}", {"share": estimates["share"]})
    reason = (
        f"{estimates['share']} of the bodies lost in {what}, {shares.min():.1%} to {shares.max():.1%} a frame{missed}"
    )
    if len(shares) == 1:
        low = high = mean
    return Finding(name, NEEDED, reason, estimates, {"low": rounded(low), "high": rounded(high), **more})


def _uniform(values: NDArray[np.float64]) -> tuple[float, float]:
    """Ends of a uniform distribution by the extremes of the values, widened as their number says, within 0 to 1."""
    count, low, high = len(values), float(values.min()), float(values.max())
    if count < 2:
        return low, high
    beyond = (high - low) / (count - 1)
    return max(low - beyond, 0.0), min(high + beyond, 1.0)


LEAST_SURFACE_SHARE: Final = 0.05
"""Least share of pixels lost, beyond those everywhere: outlines are known to half a pixel."""

_FIRST_DEG, _LAST_DEG = 50, 83
_MOST_WIDTH: Final = 5
_LEAST_STEEP: Final = 300
_PRICE: Final = 10.0  # of log likelihood, that an artifact must be worth
_SURE_SHARE: Final = 0.3  # lost pixels whose slope is guessed from their neighbours
_BARE: Final = 0.05  # of the pixels just below an angle: so few above it are none
_GRADUAL: Final = 0.5
_NEAR_DEG: Final = 4
_LAST_BARE_DEG: Final = 80  # slopes of range images end at 85

Floats = NDArray[np.float64]


def measure_surface_losses(outlines: Sequence[BodyOutline], areas: Sequence[Mask]) -> tuple[Finding, Finding]:
    """Findings of "grazing_loss" and "edge_loss". areas: the pixels to count in each outline, bool [H, W]."""
    total, lost = _counted(outlines, areas)
    edge_counts, edge_lost = total.sum(1), lost.sum(1)
    steep = int(total[:, 70 - 1 :].sum())
    best, chosen = -np.inf, (0, 90)
    cuts = [90, *(cut for cut in range(_FIRST_DEG, _LAST_DEG + 1) if total[:, cut:].sum() >= _LEAST_STEEP)]
    for width in range(_MOST_WIDTH + 1):
        for cut in cuts:
            likelihood, _ = _fit(total, lost, width, cut)
            likelihood -= _PRICE * ((width > 0) + (cut < 90))
            if likelihood > best:
                best, chosen = likelihood, (width, cut)
    width, cut = chosen
    _, (_, at_edge, at_grazing) = _fit(total, lost, width, cut)
    inside = edge_lost[0] / max(edge_counts[0], 1)
    rates = (edge_lost[1:] / np.maximum(edge_counts[1:], 1) - inside) / max(1 - inside, 1e-6)
    exact = all(outline.exact for outline in outlines)
    edge = _edge(width, at_edge, rates, int(edge_counts[1 : width + 1].sum()), exact)
    if (bare := _bare(total)) is not None and exact:
        return bare, edge
    return _grazing(cut, at_grazing, steep, int(total[:, min(cut, 89) :].sum()), exact), edge


def _counted(outlines: Sequence[BodyOutline], areas: Sequence[Mask]) -> tuple[Floats, Floats]:
    """All pixels and the lost ones by ring (0 is the inside) and whole degrees of incidence, [RINGS + 1, 90] each."""
    total, lost = np.zeros((RINGS + 1) * 90), np.zeros((RINGS + 1) * 90)
    for outline, area in zip(outlines, areas, strict=True):
        degrees = np.clip(np.nan_to_num(outline.incidence_deg, nan=0.0), 0, 89).astype(np.int64)
        known = area & (np.isfinite(outline.incidence_deg) | (outline.ring > 0))
        cell = outline.ring * 90 + degrees
        total += np.bincount(cell[known], minlength=len(total))
        lost += np.bincount(cell[known & outline.lost], minlength=len(lost))
    return total.reshape(RINGS + 1, 90), lost.reshape(RINGS + 1, 90)


def _fit(total: Floats, lost: Floats, width: int, cut: int) -> tuple[float, tuple[float, float, float]]:
    """Log likelihood, and the shares lost everywhere, by edges of a width, and by incidence from a cut on.

    Pixels survive all three independently, so shares of survivors multiply; four cells, with and without each.
    """
    count = np.array([[total[g][:, s].sum() for s in _halves(cut)] for g in _rows(width)])
    gone = np.array([[lost[g][:, s].sum() for s in _halves(cut)] for g in _rows(width)])
    kept = (count - gone + 0.5) / (count + 1)
    weight = count * kept / np.maximum(1 - kept, 1e-3)
    everywhere = kept[0, 0]
    edge = _mean_ratio(kept[1] / kept[0], np.minimum(weight[1], weight[0])) if width else 1.0
    steep = _mean_ratio(kept[:, 1] / kept[:, 0], np.minimum(weight[:, 1], weight[:, 0])) if cut < 90 else 1.0
    model = everywhere * np.array([[1.0, steep], [edge, edge * steep]])
    model = np.clip(model, 1e-6, 1 - 1e-6)
    likelihood = float((gone * np.log(1 - model) + (count - gone) * np.log(model)).sum())
    return likelihood, (1 - everywhere, 1 - edge, 1 - steep)


def _rows(width: int) -> tuple[list[int], list[int]]:
    near = list(range(1, width + 1))
    return [ring for ring in range(RINGS + 1) if ring not in near], near


def _halves(cut: int) -> tuple[slice, slice]:
    return slice(0, cut), slice(cut, 90)


def _mean_ratio(ratios: Floats, weights: Floats) -> float:
    return min(float(np.exp(np.average(np.log(ratios), weights=weights + 1e-9))), 1.0)


def _edge(width: int, share: float, rates: Floats, count: int, exact: bool) -> Finding:
    shown = ", ".join(f"{rate:.1%}" for rate in rates[: max(width, 1) + 1])
    reason = f"pixels lost from edges inwards, beyond those inside: {shown}"
    error = float(np.sqrt(max(share * (1 - share), 1e-4) / max(count, 1)))
    if not width or share < LEAST_SURFACE_SHARE:
        return Finding("edge_loss", NOT_SEEN, reason, {"share": Estimate(float(rates[0]), error)})
    if not exact:
        reason += "; at least, as the outline is only known from what is left"
    estimates = {"share": Estimate(share, error), "width_px": Estimate(float(width))}
    return Finding("edge_loss", NEEDED, reason, estimates, {"width_px": width, "share": rounded(min(share, 1.0))})


def _grazing(cut: int, share: float, steep: int, count: int, exact: bool) -> Finding:
    if steep < _LEAST_STEEP:
        return Finding("grazing_loss", UNKNOWN, f"{steep} pixels are known to be seen at more than 70 degrees")
    if not exact and (cut == 90 or share < _SURE_SHARE):
        return Finding("grazing_loss", UNKNOWN, "noise or motion hides how the lost pixels lay to the camera")
    if cut == 90 or share < LEAST_SURFACE_SHARE:
        return Finding("grazing_loss", NOT_SEEN, "pixels seen at grazing angles are lost as often as others")
    error = float(np.sqrt(share * (1 - share) / max(count, 1)))
    estimates = {"from_deg": Estimate(float(cut), 1.0), "share": Estimate(share, error)}
    reason = f"{share:.1%} lost above {cut} degrees, beyond those lost everywhere"
    if not exact:
        reason += "; at least, as the slope of lost pixels is that of their neighbours"
    strengths = {"from_deg": float(cut), "share": rounded(share)}
    return Finding("grazing_loss", NEEDED, reason, estimates, strengths)


def _bare(total: Floats) -> Finding | None:
    """The finding where pixels end abruptly at an angle, though bodies turn away gradually; else None.

    Nothing is left above the angle, while just below there are hardly fewer pixels than further down.
    """
    counts = total.sum(0)
    for cut in range(_FIRST_DEG, _LAST_BARE_DEG + 1):
        above, below = counts[cut : cut + _NEAR_DEG].sum(), counts[cut - _NEAR_DEG : cut].sum()
        before = counts[cut - 2 * _NEAR_DEG : cut - _NEAR_DEG].sum()
        abrupt = above < _BARE * below and below > _GRADUAL * before and counts[cut:].sum() < 2 * _BARE * below
        if abrupt and below >= _LEAST_STEEP:
            reason = f"pixels are measured up to {cut} degrees and hardly one beyond, though bodies turn away gradually"
            estimates = {"from_deg": Estimate(float(cut), 1.0), "share": Estimate(1.0)}
            return Finding("grazing_loss", NEEDED, reason, estimates, {"from_deg": float(cut), "share": 1.0})
    return None
