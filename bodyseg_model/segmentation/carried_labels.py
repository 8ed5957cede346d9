"""Labels of a video's frames, steadied by the evidence of earlier frames, without delay."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import import_module
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.bodies import from_rotation_vector
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.machine import of_each, pieces
from bodyseg_data.rigs import Camera
from bodyseg_model.segmentation.views import check_size

Labels = NDArray[np.uint8]
Floats = NDArray[np.float32]
SeenBody = tuple[NDArray[np.intp], Floats]
"""Pixels of a body in a frame and the confidence of each, both [N]."""

Middle = NDArray[np.float64]
"""The middle of a body's surface, [3], metres."""

Rigid = NDArray[np.float64]
"""A rigid motion, [3, 4]: rotation and, last, translation, metres."""

SAME_BODY_M: Final = 0.5
"""Bodies of two frames are one if their middles are nearer, metres: 12 m/s at 25 frames a second."""

_AWAY_FRAMES: Final = 30  # frames for which a body may be out of sight and keep its number
_AWAY_M: Final = 1.0  # how far it may have moved then: people pass behind others
_UNMOVED: Final = np.eye(3, 4, dtype=np.float32)
_LEAST_PIXELS: Final = 1 << 12  # fewest pixels for which a further thread pays
_NOWHERE: Final = -1.0  # a tolerance within which no range is: evidence starts anew
_JUMP_M: Final = 0.04  # neighbouring cells whose ranges differ by more are of two surfaces
_GATE_M: Final = 0.05  # cells further from the surface they meet do not count
_NOISES: Final = 3.0  # the gate is at least this many standard deviations of a cell's ranges
_NEARLY: Final = 1.5  # ratio within which the size of cells may differ from what it should be
_RIGID_STEPS: Final = 5
_RIGID_CELLS: Final = 800  # enough for a rigid motion: of more cells, every second, third ... is used
_STILL: Final = np.repeat([0.002, 1.0], 3)  # weights of no turn, square metres, and of no shift; that of a cell is 1
_PART_CELLS: Final = 20  # fewest cells of a part that moves by itself
_PART_REACH_M: Final = 0.3  # greatest shift of a part beyond the body's own
_PULL: Final = 0.05  # weight of a part's shift
_FAITH_NOISE_M: Final = 0.02  # noise that halves the weight of distances to planes
_FALL_M: Final = 0.001  # fall of the mean difference of range that counts as much as _MORE cells whose label agrees
_MORE: Final = 0.01
_REMEMBERED: Final = 0.7  # share of the earlier frames' gain of shifting parts that counts in the next frame
_MOST_GAIN: Final = 2.0  # most gain that is remembered, so that a body that begins to bend is soon recognised
_BENDS: Final = 1.5  # gain from which on a body bends


@dataclass(frozen=True)
class Carrying:
    """Parameters of `CarriedLabels`; docs/how-to/steady.md has their effect.

    keep: share of the evidence that is left after a frame, 0 to less than 1; bending_keep: of a body that bends, as the
    place of its points is less certain. margin: of a body that does not bend, evidence by which another label must
    exceed the one shown, in frames of confidence 1. border, border_share: of a body that bends, evidence for the label
    shown is multiplied by border_share where the new one is shown up to `border` pixels away: borders are where a wrong
    motion does harm. stiff_border, stiff_border_share: the same of a body that does not bend.
    tolerance_m, noises: a point is the same if ranges agree within tolerance_m or `noises` standard deviations of the
    ranges' noise, whichever is more. reach: pixels around the expected place at which it is sought. cell_m: side of the
    cells in which motion is estimated, metres.
    """

    keep: float = 0.9
    bending_keep: float = 0.8
    margin: float = 0.25
    border: int = 4
    border_share: float = 0.3
    stiff_border: int = 1
    stiff_border_share: float = 0.6
    tolerance_m: float = 0.03
    noises: float = 2.5
    reach: int = 2
    cell_m: float = 0.02


class CellLens(NamedTuple):
    """Numbers of a camera, and the cells of its image: focal length and principal point (x, y) in pixels; columns and
    rows of the image; the side of a cell, pixels; columns and rows of cells.
    """

    focal: float
    x: float
    y: float
    columns: int
    rows: int
    side: int
    across: int
    down: int


class Images(NamedTuple):
    """Images of a frame, flat: ranges, float32 [H * W], metres, 0 off the bodies; slots of evidence, uint32 [H * W,
    carried_loops.SLOTS]; the label shown, uint8 [H * W].
    """

    range_m: Floats
    slots: NDArray[np.uint32]
    shown: NDArray[np.uint8]


class BodyPixels(NamedTuple):
    """A body in a new frame: its pixels, int64 [N], ascending, and its confidence at them, float32 [N]; the frame's
    ranges, float32 [H * W], metres, and labels, uint8 [H * W].
    """

    pixels: NDArray[np.intp]
    confidence: Floats
    range_m: Floats
    labels: NDArray[np.uint8]


class Cells(NamedTuple):
    """M cells of a body, in reading order. grid: int32 [down * across], a cell's number, -1 where the body has none.
    points: float32 [M, 3], metres, the mean of one surface. normals: float32 [M, 3], of unit length, 0 where neighbours
    lack. neighbours: int64 [M, 4], left, right, above, below, a cell itself where it has none. labels: uint8 [M], of
    one pixel of the cell. noise_m: median deviation of ranges within a cell, metres.
    """

    grid: NDArray[np.int32]
    points: Floats
    normals: Floats
    neighbours: NDArray[np.int64]
    labels: NDArray[np.uint8]
    noise_m: float


class Rule(NamedTuple):
    """Rule by which evidence is carried; see `Carrying`. steps: int64 [S, 2], rows and columns to the pixels at which a
    point is sought, (0, 0) first; reach: the largest of them. tolerance_m: metres. keep, border_keep: of 1024.
    border: pixels. margin: in 1 / carried_loops.UNIT.
    """

    steps: NDArray[np.int64]
    reach: int
    tolerance_m: np.float32
    keep: np.uint32
    border_keep: np.uint32
    border: int
    margin: np.uint32


@dataclass(frozen=True)
class _LastFrame:
    """The frame before: camera, images; of each body its cells, their lens, and the gain of shifting parts so far."""

    camera: Camera
    images: Images = field(repr=False)
    bodies: list[tuple[Cells, CellLens, float]] = field(repr=False)


def _loops() -> Any:
    """The compiled loops, in a module that needs numba."""
    return import_module(f"{__package__}.carried_loops")


class CarriedLabels:
    """Steadies the labels of a recording's frames: called with each frame in turn, it returns the labels to show.

    Evidence for a label stays on the point of the surface on which it was found. The body's motion since the last frame
    says where each point was; where the ranges agree, its evidence is carried along, less by `carrying.keep`, and the
    new frame's confidence is added. It begins anew at `restart`, for frames of another camera, and for a body that was
    not in the last frame. The result is the same on every run, for any number of torch's threads.

    tracks: number, from 1, of each body of the last frame. A body keeps it while it moves by at most `SAME_BODY_M` from
    frame to frame; while the camera changes, or it is out of sight for 30 frames at most, by at most a metre.
    Raises MissingLibrary without numba.
    """

    def __init__(self, carrying: Carrying | None = None) -> None:
        self.carrying = carrying or Carrying()
        _loops()  # now, so that a missing library is told
        self.restart()

    def restart(self, *, numbers: bool = True) -> None:
        """Forget all frames, as at the start of a recording. numbers: of bodies, begin at 1 again, else they go on."""
        self._last: _LastFrame | None = None
        self._frame = 0
        self._highest: int = 0 if numbers else self._highest
        self._tracked: dict[int, tuple[Middle, int]] = {}  # number -> middle, and the frame in which it was there
        self.tracks: list[int] = []

    def __call__(self, range_m: Floats, labels: Labels, bodies: Sequence[SeenBody], camera: Camera) -> Labels:
        """Steady the labels of the next frame; returns the label image, uint8 [H, W], 255 off the bodies.

        range_m: float32 [H, W], metres, 0 = nothing measured. labels: uint8 [H, W], the network's. bodies: of each its
        pixels, int64 [N], row * W + column, ascending, and their confidence, float32 [N]. camera: the frame's. Raises
        BadConfig for arrays that do not fit the camera or each other.
        """
        _check_frame(range_m, labels, bodies, camera)
        if self._last is not None and self._last.camera != camera:
            self._last = None
        last = self._last
        flat, named = np.ascontiguousarray(range_m).ravel(), np.ascontiguousarray(labels).ravel()
        seen = [BodyPixels(*body, flat, named) for body in bodies if len(body[0])]
        slots = np.empty((flat.size, _loops().SLOTS), np.uint32)
        new = Images(np.zeros(flat.size, np.float32), slots, np.full(flat.size, BACKGROUND, np.uint8))
        lenses = [self._lens(body, camera) for body in seen]
        cells, known = list(map(self._cells, seen, lenses)), []
        middles = list(map(_middle, cells))
        pairs = _nearest(middles, dict(enumerate(_middle(body) for body, *_ in last.bodies)) if last else {})
        for body, lens, own, number in zip(seen, lenses, cells, pairs, strict=True):
            rigid, field, gain = _UNMOVED, np.zeros_like(own.points), 0.0
            old, rule = new, self._rule(_NOWHERE)
            if last is not None and number is not None:
                earlier, before, gain = last.bodies[number]
                rigid, field, gain = self._motion(own, earlier, gain, before, (before.side / lens.side) ** 2)
                noise = float(np.hypot(own.noise_m, earlier.noise_m))
                rule = self._rule(max(self.carrying.tolerance_m, self.carrying.noises * noise), gain > _BENDS)
                old = last.images
            self._carry(body, lens, rigid, field, own.grid, old, rule, new)
            known.append((own, lens, gain))
        self._track(middles, pairs)  # last, as is the frame: an interrupt before leaves both as they were
        self._last = _LastFrame(camera, new, known)
        return new.shown.reshape(labels.shape).copy()

    def _lens(self, body: BodyPixels, camera: Camera) -> CellLens:
        """The camera's numbers, and cells as large as `carrying.cell_m` is at the body's range; or those of a body of
        the last frame if their size is nearly that, so that it seldom changes.
        """
        some = body.pixels[:: len(body.pixels) // _LEAST_PIXELS + 1]
        side = max(1, round(self.carrying.cell_m * camera.focal_px / float(np.median(body.range_m[some]))))
        side = min(side, max(camera.columns, camera.rows))
        for _, lens, _ in [] if self._last is None else self._last.bodies:
            if max(side, lens.side) <= _NEARLY * min(side, lens.side):
                return lens
        cells = -(-camera.columns // side), -(-camera.rows // side)
        return CellLens(camera.focal_px, *camera.centre_px, camera.columns, camera.rows, side, *cells)

    def _cells(self, body: BodyPixels, lens: CellLens) -> Cells:
        grid, place, points, labels, noise_m = _loops().cells_of(body, lens, np.float32(_JUMP_M))
        around = np.pad(grid.reshape(lens.down, lens.across), 1, constant_values=-1)
        row, column = np.divmod(place, lens.across)
        sides = (row + 1, column), (row + 1, column + 2), (row, column + 1), (row + 2, column + 1)
        beside = np.stack([around[side] for side in sides], axis=1).astype(np.int64)
        apart = (beside < 0) | (np.abs(points[beside, 2] - points[:, 2:]) >= _JUMP_M)
        beside = np.where(apart, np.arange(len(place))[:, None], beside)
        left, right, above, below = points[beside.T]
        normals = np.cross(right - left, below - above)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        return Cells(grid, points, normals, beside, labels, noise_m)

    def _track(self, middles: Sequence[Middle], pairs: Sequence[int | None]) -> None:
        """Number the next frame's bodies: as in the frame before, else as bodies that were out of sight, else anew."""
        self._frame += 1
        known = {n: seen for n, seen in self._tracked.items() if seen[1] >= self._frame - _AWAY_FRAMES}
        numbers = [None if pair is None else self.tracks[pair] for pair in pairs]
        away = {n: middle for n, (middle, _) in known.items() if n not in numbers}
        back = iter(_nearest([middle for middle, n in zip(middles, numbers, strict=True) if n is None], away, _AWAY_M))
        new = itertools.count(self._highest + 1)
        self.tracks = [n or next(back) or next(new) for n in numbers]
        self._highest = max([self._highest, *self.tracks])
        self._tracked = known | {n: (middle, self._frame) for n, middle in zip(self.tracks, middles, strict=True)}

    def _rule(self, tolerance_m: float, bends: bool = False) -> Rule:
        """The parameters as the loops take them."""
        given = self.carrying
        keep, share, border, margin = given.keep, given.stiff_border_share, given.stiff_border, given.margin
        if bends:
            keep, share, border, margin = given.bending_keep, given.border_share, given.border, 0.0
        kept, border_kept = (np.uint32(round(1024 * part)) for part in (keep, share * keep))
        least, tolerance = np.uint32(round(margin * _loops().UNIT)), np.float32(tolerance_m)
        return Rule(nearest_first(given.reach), given.reach, tolerance, kept, border_kept, border, least)

    def _motion(
        self, own: Cells, earlier: Cells, gain: float, lens: CellLens, larger: float
    ) -> tuple[Floats, Floats, float]:
        """Motion of a body back to the frame before (`carry`), and the gain of shifting its parts, summed up. lens:
        of the earlier cells, whose area is so many times `larger`.

        A rigid motion, and displacements that fit the surface smoothly. These start from the shifts of parts only if
        ranges and labels fit better with them over the last frames. Else the body is rigid: if it turns, the middles of
        its parts follow what comes into view, not the skin.
        """
        noise = max(own.noise_m, earlier.noise_m)
        gate = max(_GATE_M, _NOISES * noise)
        rigid = self._rigid(own, earlier, lens, gate)
        places = moved(rigid, own.points)
        shifts, weights = part_shifts(places, own.labels, earlier, larger)
        some = weights > 0
        (away, same), (away_shifted, same_shifted) = (
            self._fit(each[some], own.labels[some], earlier, lens, gate) for each in (places, places + shifts)
        )
        gain = _REMEMBERED * min(max(gain, -_MOST_GAIN), _MOST_GAIN)
        gain += (away - away_shifted) / _FALL_M + (same_shifted - same) / _MORE
        if gain <= _BENDS:
            shifts[:], weights[:] = 0, 0
        faith = np.float32(1 / (1 + (noise / _FAITH_NOISE_M) ** 2))
        field = _loops().smooth_field(places, own, shifts, weights, earlier, lens, np.float32(gate), faith)
        return rigid.astype(np.float32), field, gain

    def _rigid(self, own: Cells, earlier: Cells, lens: CellLens, gate: float) -> Rigid:
        """Rigid motion of a body back to the frame before: the better fit, from no motion or its middle's shift."""
        every = max(1, len(own.points) // _RIGID_CELLS)
        some, labels = np.ascontiguousarray(own.points[::every]), np.ascontiguousarray(own.labels[::every])
        shift = np.eye(3, 4)
        shift[:, 3] = _middle(earlier) - _middle(own)
        starts = np.eye(3, 4), shift
        rigid = min(starts, key=lambda start: self._fit(moved(start, some), labels, earlier, lens, gate)[0])
        for _ in range(_RIGID_STEPS):  # of Gauss and Newton (Chen and Medioni 1992), with Tukey's weights
            places = moved(rigid, some)
            met = _loops().cells_met(places, earlier, lens, gate)
            middle, (seen,) = places.mean(axis=0, dtype=np.float64), np.nonzero(met >= 0)
            normals, arms = earlier.normals[met[seen]].astype(np.float64), places[seen] - middle
            away = np.einsum("ij,ij->i", normals, earlier.points[met[seen]] - places[seen])
            lines = np.hstack([np.cross(arms, normals), normals])
            weighed = lines * np.square(np.maximum(1 - (away / gate) ** 2, 0.0))[:, None]
            step = np.linalg.solve(np.einsum("ij,ik->jk", weighed, lines) + np.diag(_STILL), away @ weighed)
            turn = from_rotation_vector(step[:3])
            rigid = turn @ rigid
            rigid[:, 3] += middle - turn @ middle + step[3:]
        return rigid

    def _fit(self, places: Floats, labels: Labels, old: Cells, lens: CellLens, gate: float) -> tuple[float, float]:
        """Fit of places, float32 [M, 3], metres, to the old cells: the mean difference of range, metres, `gate` where
        none is met; and the share of those that meet a cell of their own label.
        """
        if not len(places):
            return 0.0, 0.0
        met = _loops().cells_met(places, old, lens, gate)
        away = np.where(met >= 0, np.abs(old.points[met, 2] - places[:, 2]), gate)
        return float(away.mean(dtype=np.float64)), float(((met >= 0) & (old.labels[met] == labels)).mean())

    def _carry(self, body: BodyPixels, *arguments: Any) -> None:
        """Carry evidence to a body's pixels, which do not depend on each other, in several threads if they are many."""

        def work(run: tuple[int, int]) -> None:
            some = body._replace(pixels=body.pixels[slice(*run)], confidence=body.confidence[slice(*run)])
            _loops().carry(some, *arguments)

        count = len(body.pixels)
        threads = min(torch.get_num_threads(), max(1, count // _LEAST_PIXELS))
        of_each(work, pieces(count, threads), threads)


@lru_cache(maxsize=8)
def nearest_first(reach: int) -> NDArray[np.int64]:
    """Steps along rows and columns, int64 [N, 2], up to `reach` each way: the nearest first, then in reading order."""
    line = range(-reach, reach + 1)
    return np.array(sorted(itertools.product(line, line), key=lambda step: step[0] ** 2 + step[1] ** 2), np.int64)


def moved(rigid: Rigid, points: Floats) -> Floats:
    """Points, float32 [M, 3], after a rigid motion."""
    return (points @ rigid[:, :3].T + rigid[:, 3]).astype(np.float32)


def part_shifts(places: Floats, labels: Labels, earlier: Cells, larger: float = 1.0) -> tuple[Floats, Floats]:
    """Displacement of the part of each cell from the frame before, float32 [M, 3], metres, and its weight, float32 [M]:
    0 where a part is small or would move too far.

    places: the cells after the rigid motion, float32 [M, 3]; labels: uint8 [M]; larger: area of an earlier cell, where
    that of these is 1. Displacements are of the middle; parts of which less or more was in view before weigh less.
    """
    (middles, areas), (old_middles, old_areas) = _parts(places, labels), _parts(earlier.points, earlier.labels)
    shifts, old_areas = old_middles - middles, larger * old_areas
    smaller = np.minimum(areas, old_areas)
    counts = (smaller > _PART_CELLS * places[:, 2].mean() ** 2) & (np.linalg.norm(shifts, axis=1) < _PART_REACH_M)
    weights = np.where(counts, _PULL * (smaller / np.maximum(np.maximum(areas, old_areas), 1e-6)) ** 2, 0)
    return np.where(counts[:, None], shifts, 0).astype(np.float32)[labels], weights.astype(np.float32)[labels]


def _parts(points: Floats, labels: Labels) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Middles of parts, float64 [256, 3], metres, weighted by cells' areas; and sums of these, cells times metres²."""
    area = points[:, 2].astype(np.float64) ** 2
    areas: NDArray[np.float64] = np.bincount(labels, area, 256).astype(np.float64)
    sums = np.stack([np.bincount(labels, area * along, 256) for along in points.T], axis=1)
    return sums / np.maximum(areas, 1e-6)[:, None], areas


def _check_frame(range_m: Floats, labels: Labels, bodies: Sequence[SeenBody], camera: Camera) -> None:
    """Raise BadConfig for what does not fit together: compiled loops check no place."""
    check_size(range_m.shape, camera)
    check_size(labels.shape, camera)
    for pixels, confidence in bodies:
        inside = not len(pixels) or (pixels[0] >= 0 and pixels[-1] < camera.rows * camera.columns)
        if not inside or len(confidence) != len(pixels) or (pixels[1:] <= pixels[:-1]).any():
            raise BadConfig("a body has pixels of the frame, ascending, and a confidence for each, found others")


def _nearest(middles: Sequence[Middle], known: dict[int, Middle], within_m: float = SAME_BODY_M) -> list[int | None]:
    """For every body the number of a known one, the nearest pairs first; None for a new one."""
    away = {(at, n): float(np.linalg.norm(own - known[n])) for at, own in enumerate(middles) for n in known}
    found: list[int | None] = [None] * len(middles)
    for at, n in sorted((pair for pair in away if away[pair] <= within_m), key=away.__getitem__):  # none is NaN
        if found[at] is None and n not in found:
            found[at] = n
    return found


def _middle(cells: Cells) -> Middle:
    """Mean point of a body, float64 [3], metres; NaN of one that is too small for a cell."""
    middle: NDArray[np.float64] = cells.points.sum(axis=0, dtype=np.float64) / (len(cells.points) or np.nan)
    return middle
