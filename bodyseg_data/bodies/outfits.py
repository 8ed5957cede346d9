"""Outfits: the extent, looseness and folds of each garment, and how they are cut to a person.

A cut says which vertices each garment covers and how far the cloth is from them.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.skeleton import Floats
from bodyseg_data.meshes import find_edges, nearest_sources

_GATHERED: Final = 0.25  # share of loose outfits with bands
_SEEDS: Final = 1_000_000

_LOOSE: Final[dict[str, tuple[float, float]]] = {
    "sleeve": (0.3, 1.0), "hem": (0.4, 0.8), "leg": (0.25, 1.0), "top_loose_m": (0.01, 0.05),
    "leg_loose_m": (0.008, 0.045), "top_taper": (0.0, 0.06), "sleeve_taper": (0.0, 0.04), "leg_taper": (0.0, 0.2),
    "fold_m": (0.06, 0.16),
    "slack": (0.04, 0.12), "crumple": (0.03, 0.18),
}  # fmt: skip

_CLOSE: Final[dict[str, tuple[float, float]]] = _LOOSE | {
    "top_loose_m": (0.0, 0.004), "leg_loose_m": (0.0, 0.004), "top_taper": (0.35, 0.8), "sleeve_taper": (0.35, 0.8),
    "leg_taper": (0.35, 0.8), "slack": (0.0, 0.03), "crumple": (0.0, 0.05),
}  # fmt: skip

_BAND_M: Final = 0.05  # over which a band at hem or wrist pulls the cloth in
_END_M: Final = 0.16  # over which cloth gathers above the end of a sleeve or a trouser leg
_SLICE_M: Final = 0.025
_SECTORS: Final = 20
_NEIGHBOURS: Final = 6
_TUCK_M: Final = 0.006  # distance below a hem at which the cloth beneath it begins
_MOST_TUCKED: Final = 0.75
_SEAT_M: Final = 0.15  # below a top's hem, over which trousers widen from lying under it

_MEASURED_AT: Final = {
    "face": 132, "throat": 1522, "nape": 858, "Rt. hip": 4302, "Lt. hip": 10915, "Rt. armpit": 3770,
    "Lt. armpit": 10420, "Rt. shoulder": 1557, "Lt. shoulder": 8219, "Rt. wrist": 3535, "Lt. wrist": 10187,
    "Rt. fingertip": 2103, "Lt. fingertip": 8755, "Rt. ankle": 4810, "Lt. ankle": 11412,
}  # fmt: skip
"""Vertices of the open body from which clothes are cut. They are no landmarks: where these are placed changes labels,
and must not change what people wear."""


@dataclass(frozen=True)
class Outfit:
    """A top and trousers.

    sleeve: end of the sleeves, 0 shoulder to 1 wrist. hem: end of the top, 0 hip bones (ASIS) to 1 crotch; beyond 0.8 a
    top would have to join the legs.
    leg: end of the trousers, 0 crotch to 1 ankle bone.
    top_loose_m, leg_loose_m: mean distance of the cloth from the body, beyond that of a straight fall, metres.
    top_taper, sleeve_taper, leg_taper: metres by which the cloth narrows for every metre below the part that carries it
    (chest, shoulder, seat, thigh); 0 falls straight, large numbers follow the body.
    gathered: the top ends in a band at hem and wrists, and blouses above it, instead of hanging open.
    fold_m: wavelength of the folds. slack: excess length of the cloth at rest, as a share; it makes the folds of every
    pose. crumple: the same at the ends of sleeves and trousers, where cloth gathers. seed: of the fold patterns.
    """

    sleeve: float
    hem: float
    leg: float
    top_loose_m: float
    leg_loose_m: float
    top_taper: float
    sleeve_taper: float
    leg_taper: float
    gathered: bool
    fold_m: float
    slack: float
    crumple: float
    seed: int


OUTFITS: Final[dict[str, Outfit]] = {
    # A loose T-shirt that hangs over wide, long trousers.
    "B": Outfit(
        sleeve=0.42, hem=0.66, leg=1.0, top_loose_m=0.014, leg_loose_m=0.012, top_taper=0.04, sleeve_taper=0.0,
        leg_taper=0.06, gathered=False, fold_m=0.075, slack=0.07, crumple=0.14, seed=2,
    ),
    # A sweatshirt with bands at hem and wrists over straight trousers.
    "C": Outfit(
        sleeve=1.0, hem=0.45, leg=0.98, top_loose_m=0.026, leg_loose_m=0.012, top_taper=0.02, sleeve_taper=0.03,
        leg_taper=0.08, gathered=True, fold_m=0.085, slack=0.08, crumple=0.1, seed=3,
    ),
    # A T-shirt and wide shorts.
    "shorts": Outfit(
        sleeve=0.36, hem=0.52, leg=0.33, top_loose_m=0.01, leg_loose_m=0.014, top_taper=0.08, sleeve_taper=0.02,
        leg_taper=0.0, gathered=False, fold_m=0.075, slack=0.06, crumple=0.05, seed=4,
    ),
    # A wide jumper that hangs open over narrow trousers.
    "jumper": Outfit(
        sleeve=0.94, hem=0.7, leg=0.97, top_loose_m=0.024, leg_loose_m=0.004, top_taper=0.0, sleeve_taper=0.02,
        leg_taper=0.3, gathered=False, fold_m=0.095, slack=0.09, crumple=0.12, seed=5,
    ),
}  # fmt: skip
"""Outfits by name. "B" and "C" are for the subjects of those names."""


def of_every_third(index: int, first: int) -> Outfit | None:
    """The outfit of person number `index`: one in three from `first` on wears one, each time another; None for bare."""
    return [*OUTFITS.values()][index // 3 % len(OUTFITS)] if index % 3 == first else None


def drawn_outfit(draws: np.random.Generator, close: bool) -> Outfit:
    """Draw a top and trousers: loose shirts, jumpers, wide trousers, shorts; close: the same close to the body."""
    ranges = _CLOSE if close else _LOOSE
    values = {name: round(low + (high - low) * float(draws.random()), 4) for name, (low, high) in ranges.items()}
    gathered, seed = bool(draws.random() < _GATHERED), int(draws.random() * _SEEDS)
    return Outfit(**values, gathered=gathered, seed=seed)


@dataclass(frozen=True)
class Cut:
    """Outfit on every vertex of a person at rest. top, trousers: bool [V], covered by that garment (never by both).

    axis: float64 [V, 3], the direction in which the garment hangs. stand_off: [V], metres from the body.
    crumple: [V], share of length in excess. partner: int64 [V], another vertex for each. slide: float64 [V], share of
    the way to its partner at which the cloth of a vertex lies, so that hems are straight for any triangles.
    """

    top: NDArray[np.bool_]
    trousers: NDArray[np.bool_]
    axis: Floats
    stand_off: Floats
    crumple: Floats
    partner: NDArray[np.int64]
    slide: Floats


def cut(rest: Floats, faces: NDArray[np.int32], outfit: Outfit) -> Cut:
    """Cut `outfit` to a person at rest, vertices [V, 3] in metres, in the numbering of the open body."""
    at = {name: rest[vertex] for name, vertex in _MEASURED_AT.items()}
    arms = [_Arm(rest, faces, side, at) for side in ("Lt.", "Rt.")]
    armless = ~(arms[0].vertices | arms[1].vertices) & np.isfinite(_distances(rest, faces, _MEASURED_AT["face"]))
    hip = (at["Lt. hip"][1] + at["Rt. hip"][1]) / 2
    chest = (at["Lt. armpit"][1] + at["Rt. armpit"][1]) / 2
    crotch = rest[armless & (np.abs(rest[:, 0]) < 0.012) & (rest[:, 1] > 0.3 * hip), 1].min()
    ankle = (at["Lt. ankle"][1] + at["Rt. ankle"][1]) / 2
    hem = hip + outfit.hem * (crotch - hip)
    end = crotch + outfit.leg * (ankle - crotch)
    y = rest[:, 1]

    edges = find_edges(faces).ends.astype(np.int32)
    snap = _Snap(rest, edges)
    above_hem = snap(y - hem, armless)
    snap.tuck(y - hem, armless & ~above_hem)
    below_neck = snap(_below_neck(rest, at), armless & (y > chest))
    above_end = snap(y - end, armless)
    in_sleeve = [snap(outfit.sleeve * arm.length - arm.distance, arm.vertices) for arm in arms]
    top = (above_hem & (below_neck | (y <= chest))) | in_sleeve[0] | in_sleeve[1]
    trousers = armless & above_end & ~above_hem

    axis = np.tile([0.0, -1.0, 0.0], (len(rest), 1))
    stand_off = np.zeros(len(rest))
    crumple = np.zeros(len(rest))
    trunk = top & armless
    depth = np.maximum(chest - y[trunk], 0)
    stand_off[trunk] = _tube(depth, rest[trunk][:, [0, 2]], outfit.top_taper) * (y[trunk] < chest)
    stand_off[trunk] += outfit.top_loose_m * (0.4 + 0.8 * _smooth_step(depth / (chest - hip)))
    for arm, sleeved in zip(arms, in_sleeve, strict=True):
        axis[arm.vertices] = arm.axis
        stand_off[sleeved] = _tube(arm.distance[sleeved], arm.across[sleeved], outfit.sleeve_taper)
        stand_off[sleeved] += outfit.top_loose_m * (0.4 + 0.6 * _smooth_step(arm.along[sleeved] / outfit.sleeve))
        crumple[sleeved] += outfit.crumple * _near_end(arm.distance[sleeved], outfit.sleeve * arm.length)
    for side in (1, -1):
        leg = trousers & (y <= crotch) & (side * rest[:, 0] >= 0)
        stand_off[leg] = _tube(crotch - y[leg], rest[leg][:, [0, 2]], outfit.leg_taper)
    stand_off[trousers] += outfit.leg_loose_m * (0.1 + 0.9 * _smooth_step((hem - y[trousers]) / _SEAT_M))
    crumple[trousers] += outfit.crumple * _near_end(hip - y[trousers], hip - end)
    if outfit.gathered:
        band = y - hem
        for arm in arms:
            band = np.where(arm.vertices, outfit.sleeve * arm.length - arm.distance, band)
        stand_off = np.where(top, stand_off * _smooth_step(band / _BAND_M + 0.25), stand_off)
    return Cut(top, trousers, axis, stand_off, crumple, snap.partner, snap.slide)


class _Snap:
    """Finds the vertices inside a line on the surface, and moves the nearest ones along an edge onto the line."""

    def __init__(self, rest: Floats, edges: NDArray[np.int32]) -> None:
        self.partner = np.arange(len(rest))
        self.slide = np.zeros(len(rest))
        self._edges = np.concatenate([edges, edges[:, ::-1]])
        self._lengths = np.linalg.norm(rest[self._edges[:, 0]] - rest[self._edges[:, 1]], axis=1)

    def __call__(self, level: Floats, among: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return bool [V]: vertices of `among` where `level` [V] (metres) is positive, or that move onto its zero."""
        here, there = self._edges.T
        drop = level[here] - level[there]
        share = level[here] / np.where(drop == 0, 1, drop)
        crossing = (level[here] > 0) != (level[there] > 0)
        fit = np.flatnonzero(crossing & among[here] & among[there] & (share <= 0.5) & (self.slide[here] == 0))
        fit = fit[np.lexsort((np.abs(drop[fit]) / self._lengths[fit], here[fit]))]  # the steepest edge comes last
        self.partner[here[fit]], self.slide[here[fit]] = there[fit], share[fit]
        inside = among & (level > 0)
        inside[here[fit]] = True
        return inside

    def tuck(self, level: Floats, outside: NDArray[np.bool_]) -> None:
        """Move the first ring of vertices outside a line up to just below it, so that its hem falls steeply."""
        here, there = self._edges.T
        share = (level[here] + _TUCK_M) / np.where(level[here] == level[there], 1, level[here] - level[there])
        fit = np.flatnonzero(outside[here] & ~outside[there] & (share > 0) & (share < _MOST_TUCKED))
        fit = fit[np.lexsort((-share[fit], here[fit]))]
        self.partner[here[fit]], self.slide[here[fit]] = there[fit], share[fit]


class _Arm:
    """One arm at rest. vertices: bool [V]. along: [V], 0 at the shoulder to 1 at the wrist. distance: in metres."""

    def __init__(self, rest: Floats, faces: NDArray[np.int32], side: str, at: dict[str, Floats]) -> None:
        distance = _distances(rest, faces, _MEASURED_AT[f"{side} fingertip"])
        self.vertices: NDArray[np.bool_] = distance < distance[_MEASURED_AT[f"{side} armpit"]] + 0.02
        shoulder = (at[f"{side} shoulder"] + at[f"{side} armpit"]) / 2
        ring = rest[np.abs(distance - distance[_MEASURED_AT[f"{side} wrist"]]) < 0.015]
        wrist = (ring.min(axis=0) + ring.max(axis=0)) / 2
        self.length = float(np.linalg.norm(wrist - shoulder))
        self.axis: Floats = (wrist - shoulder) / self.length
        self.distance = np.where(self.vertices, np.maximum((rest - shoulder) @ self.axis, 0), 0)
        self.along = self.distance / self.length
        sideways = np.cross(self.axis, [0.0, 0.0, 1.0])
        sideways /= np.linalg.norm(sideways)
        self.across: Floats = (rest - shoulder) @ np.stack([sideways, np.cross(self.axis, sideways)], axis=1)


def _tube(depth: Floats, across: Floats, taper: float) -> Floats:
    """Distance from the body of cloth that falls straight from the widest part above it, metres [N].

    depth: distance below the top of the garment, [N]. across: the other two coordinates, [N, 2].
    """
    from scipy.ndimage import map_coordinates

    line = np.polynomial.polynomial.polyfit(depth, across, 1)
    x, z = across.T - (line[0][:, None] + line[1][:, None] * depth)
    radius, angle = np.hypot(x, z), np.arctan2(z, x)
    slices = np.arange(0, depth.max() + _SLICE_M, _SLICE_M)
    sectors = np.linspace(-np.pi, np.pi, _SECTORS + 1)
    body = _unrolled(depth, angle, radius, slices, sectors)
    widest = body.copy()
    for index in range(1, len(widest)):
        widest[index] = np.maximum(widest[index], widest[index - 1] - taper * _SLICE_M)
    coordinates = [depth / _SLICE_M, (angle + np.pi) * _SECTORS / (2 * np.pi)]
    return np.asarray(map_coordinates(widest - body, coordinates, order=1, mode="nearest"), np.float64)


def _unrolled(depth: Floats, angle: Floats, radius: Floats, slices: Floats, sectors: Floats) -> Floats:
    """Return a limb's radius [slices, sectors]: the mean of the nearest vertices, weighted by closeness."""
    from scipy.spatial import cKDTree

    scale = np.array([_SLICE_M, 2 * np.pi / _SECTORS])
    coordinates = np.stack([depth, angle], axis=1) / scale
    turn = np.array([0.0, _SECTORS])
    tree = cKDTree(np.concatenate([coordinates, coordinates - turn, coordinates + turn]))
    grid = np.stack(np.meshgrid(slices, sectors, indexing="ij"), axis=2) / scale
    distances, nearest = tree.query(grid, _NEIGHBOURS)
    weights = 1 / (distances**2 + 0.1)
    found = (weights * np.tile(radius, 3)[nearest]).sum(axis=2) / weights.sum(axis=2)
    return np.asarray(found, np.float64)


def _near_end(distance: Floats, end: float) -> Floats:
    return _smooth_step(1 - (end - distance) / _END_M)


def _smooth_step(x: Floats) -> Floats:
    x = np.clip(x, 0, 1)
    return np.asarray(x * x * (3 - 2 * x), np.float64)


def _below_neck(rest: Floats, at: dict[str, Floats]) -> Floats:
    """Depth below a cone around the neck, metres [V]; the cone passes near the nape and the notch of the breastbone."""
    front, nape = at["throat"], at["nape"]
    slope = (nape[1] - front[1]) / (nape[2] - front[2])
    height = rest[:, 1] - front[1] - slope * (rest[:, 2] - front[2])
    return np.asarray(0.5 * np.abs(rest[:, 0]) - 0.012 - height, np.float64)


def _distances(rest: Floats, faces: NDArray[np.int32], source: int) -> Floats:
    return nearest_sources("edges", rest, faces.astype(np.int64), np.array([source])).distance
