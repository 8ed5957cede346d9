"""Pixels lost for how the surface lies: at grazing incidence, and beside edges, told apart by counting both at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, UNKNOWN, Estimate, Finding, rounded
from bodyseg_model.sensor_fit.losses.outlines import RINGS, Outline

LEAST_SHARE: Final = 0.05
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

Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]


def measure_surface_losses(outlines: Sequence[Outline], areas: Sequence[Mask]) -> tuple[Finding, Finding]:
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


def _counted(outlines: Sequence[Outline], areas: Sequence[Mask]) -> tuple[Floats, Floats]:
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
    if not width or share < LEAST_SHARE:
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
    if cut == 90 or share < LEAST_SHARE:
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
