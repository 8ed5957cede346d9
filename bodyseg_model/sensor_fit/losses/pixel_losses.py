"""Pixels lost on bodies, divided into random ones, patches, stripes, grazing surfaces and edges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, UNKNOWN, Estimate, Finding, rounded
from bodyseg_model.sensor_fit.losses.outlines import Outline
from bodyseg_model.sensor_fit.losses.surface_losses import measure_surface_losses
from bodyseg_model.sensor_fit.masks import dilated, opening

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


def measure_losses(outlines: Sequence[Outline]) -> list[Finding]:
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


def _solid(outline: Outline) -> Mask:
    """Lost pixels in areas with none left: a square of five pixels fits in."""
    core = opening(outline.lost, _SOLID_PX)
    return dilated(core, 1) & outline.lost


def _striped(outline: Outline) -> Mask:
    return outline.stripes["rows"] | outline.stripes["columns"]


def scattered(outline: Outline, solid: Mask) -> Mask:
    """Pixels where single lost ones are counted: not in patches, stripes or shadows, nor next to them."""
    return outline.full & ~dilated(solid | _striped(outline) | outline.shadow, _SOLID_PX)


def _random(outlines: Sequence[Outline], areas: Sequence[Mask], cut_deg: float) -> Finding:
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


def _patches(outlines: Sequence[Outline], solid: Sequence[Mask]) -> Finding:
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


def _stripes(outlines: Sequence[Outline]) -> Finding:
    both = {along: _shares(outlines, [o.stripes[along] for o in outlines]) for along in ("rows", "columns")}
    along = max(both, key=lambda name: float(both[name].mean()))
    missed = "" if outlines[0].still else "; at least, as those at the body's ends are only seen on still bodies"
    return _area_loss("stripe_loss", f"whole {along}", both[along], {"along": along}, _STRIPED_FRAMES, missed)


def _shares(outlines: Sequence[Outline], masks: Sequence[Mask]) -> NDArray[np.float64]:
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
