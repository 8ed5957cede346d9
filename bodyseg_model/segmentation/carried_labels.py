"""Labels of a video's frames, steadied by the evidence of earlier frames, without delay.

A body is taken to move as a whole: the rigid motion that brings cells of its pixels onto those of the frame before says
where each point of its surface was.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import lru_cache
from importlib import import_module
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.labels import BACKGROUND
from bodyseg_data.rigs import Camera

Labels = NDArray[np.uint8]
Floats = NDArray[np.float64]
SeenBody = tuple[NDArray[np.intp], NDArray[np.float32]]
"""Pixels of a body in a frame and the confidence of each, both [N]."""

SAME_BODY_M: Final = 0.5
"""Bodies of two frames are one if their middles are nearer, metres: 12 m/s at 25 frames a second."""

SLOTS: Final = 3
"""Labels that a pixel has evidence for, at most; a new one replaces the weaker of those not shown."""

_NOWHERE: Final = -1.0  # a tolerance within which no range is: evidence starts anew
_NEAREST_M: Final = 0.1  # before the camera
_JUMP_M: Final = 0.04  # neighbouring cells whose ranges differ by more are of two surfaces
_GATE_M: Final = 0.05  # cells further from the surface they meet do not count
_NOISES: Final = 3.0  # standard deviations of a cell's ranges that the gate is at least
_LEAST_FOR_NOISE: Final = 6  # pixels of a cell whose ranges say how noisy the frame is
_STEPS: Final = 5
_CELLS: Final = 800  # suffice for a motion: of more, every second, third ... is used
_STILL: Final = np.diag((0.002,) * 3 + (1.0,) * 3)  # of no turn, square metres, and of no shift, against 1 of each cell


class Carrying(NamedTuple):
    """Parameters of `CarriedLabels`; docs/how-to/steady.md has their effect.

    keep: share of the evidence that is left after a frame, 0 to less than 1. margin: evidence by which another label
    must exceed the one shown, in frames of confidence 1. border, border_share: evidence for the label shown is
    multiplied by border_share where the new one is shown up to `border` pixels away: borders are where a wrong motion
    does harm. bending_keep, bending_border, bending_share: the same of a body that bends, without margin, as the place
    of its points is less certain; bends: share of its cells that meet no surface after the motion from which on it
    does. tolerance_m, noises: a point is the same if ranges agree within tolerance_m or `noises` standard
    deviations of the ranges' noise, whichever is more. reach: pixels around the expected place at which it is sought.
    cell_m: side of the cells in which motion is estimated, metres.
    """

    keep: float = 0.8
    margin: float = 0.25
    border: int = 1
    border_share: float = 0.6
    bending_keep: float = 0.5
    bending_border: int = 4
    bending_share: float = 0.3
    bends: float = 0.05
    tolerance_m: float = 0.03
    noises: float = 2.5
    reach: int = 2
    cell_m: float = 0.02


class Images(NamedTuple):
    """Images of a frame, flat: ranges, float32 [H * W], metres, 0 off the bodies; slots of evidence, uint32 [H * W,
    `SLOTS`]; the label shown, uint8 [H * W].
    """

    range_m: NDArray[np.float32]
    slots: NDArray[np.uint32]
    shown: Labels


class Lens(NamedTuple):
    """Numbers of a camera: focal length and principal point (x, y), columns and rows of its images, and the side of a
    cell, pixels.
    """

    focal: float
    x: float
    y: float
    columns: int
    rows: int
    side: int


class _Cells(NamedTuple):
    """Cells of a body, in the rows and columns of the image and one more all round. points: float64 [R, C, 3], metres,
    means of one surface, NaN where the body has none. normals: [R, C, 3], of unit length, 0 where neighbours lack. own:
    [M, 3], the points in reading order, of which `middle` is the mean. noise_m: median deviation of a cell's ranges.
    """

    points: Floats
    normals: Floats
    own: Floats
    middle: Floats
    noise_m: float


class _LastFrame(NamedTuple):
    camera: Camera
    lens: Lens
    images: Images
    bodies: list[_Cells]


class CarriedLabels:
    """Steadies the labels of a recording's frames, called with each in turn.

    A label is kept on the point of the surface that it was found on: the body's motion since the last frame says where
    each point was, and where the ranges agree, its evidence is carried along, less by `carrying.keep`, and the new
    frame's confidence is added. Starts anew at `restart`, for frames of another camera, and for a body that was not
    seen in the last frame. The result is the same on every run. Raises MissingLibrary without numba.
    """

    def __init__(self, carrying: Carrying | None = None) -> None:
        self.carrying = carrying or Carrying()
        self._carry = import_module(f"{__package__}.pixel_loops").carry
        self._last: _LastFrame | None = None

    def restart(self) -> None:
        """Forget all frames, as at the start of a recording."""
        self._last = None

    def __call__(
        self, range_m: NDArray[np.float32], labels: Labels, bodies: Sequence[SeenBody], camera: Camera
    ) -> Labels:
        """Steady the labels of the next frame; returns the label image, uint8 [H, W], 255 off the bodies.

        range_m: float32 [H, W], metres, 0 = nothing measured. labels: uint8 [H, W], the network's. bodies: pixels,
        int64 [N], row * W + column, ascending, and confidence, float32 [N], of each. camera: that of the frame.
        """
        last, given = self._last if self._last is None or self._last.camera == camera else None, self.carrying
        flat, named = np.ascontiguousarray(range_m).ravel(), np.ascontiguousarray(labels).ravel()
        seen = [body for body in bodies if len(body[0])]
        slots = np.empty((flat.size, SLOTS), np.uint32)
        new = Images(np.zeros(flat.size, np.float32), slots, np.full(flat.size, BACKGROUND, np.uint8))
        if last is None and seen:
            pixels_a_metre = camera.focal_px / float(np.median(flat[seen[0][0]]))
            side = max(1, round(given.cell_m * pixels_a_metre))
            lens = Lens(camera.focal_px, *camera.centre_px, camera.columns, camera.rows, side)
            last = _LastFrame(camera, lens, new, [])
        if last is not None:
            left, cells = list(last.bodies), [_cells_of(pixels, flat, last.lens) for pixels, _ in seen]
            for body, own in zip(seen, cells, strict=True):
                motion, tolerance_m, rule = np.eye(3, 4), _NOWHERE, given
                away = [float(np.linalg.norm(own.middle - other.middle)) for other in left]
                if away and min(away) <= SAME_BODY_M:
                    earlier = left.pop(int(np.argmin(away)))
                    motion, unmet = _motion(own, earlier, last.lens)
                    if unmet > given.bends:
                        rule = given._replace(keep=given.bending_keep, margin=0.0)
                        rule = rule._replace(border=given.bending_border, border_share=given.bending_share)
                    noise_m = math.hypot(own.noise_m, earlier.noise_m)
                    tolerance_m = max(given.tolerance_m, given.noises * noise_m)
                how = rule, np.float32(tolerance_m), nearest_first(given.reach)
                self._carry(*body, flat, named, last.lens, motion.astype(np.float32), last.images, how, new)
            last = _LastFrame(camera, last.lens, new, cells)
        self._last = last
        return new.shown.reshape(labels.shape).copy()


@lru_cache(maxsize=8)
def nearest_first(reach: int) -> NDArray[np.int64]:
    """Steps along rows and columns, int64 [N, 2], of all pixels up to `reach` away along each axis: the nearest first,
    equally near ones in reading order.
    """
    line = range(-reach, reach + 1)
    return np.array(sorted(itertools.product(line, line), key=lambda step: step[0] ** 2 + step[1] ** 2), np.int64)


def _cells_of(pixels: NDArray[np.intp], range_m: NDArray[np.float32], lens: Lens) -> _Cells:
    """Average a body's pixels, [N], in cells; range_m: of the frame, flat. A pixel further than `_JUMP_M` from the mean
    of its cell does not count, so that a cell with two surfaces has one of them or none. Of large cells, every second,
    third ... row and column is used.
    """
    shape = -(-lens.rows // lens.side) + 2, -(-lens.columns // lens.side) + 2
    size, step = shape[0] * shape[1], max(1, lens.side // 3)
    row, column = np.divmod(pixels.astype(np.int32), np.int32(lens.columns))
    used = (row % step == 0) & (column % step == 0)
    row, column, z = row[used], column[used], range_m[pixels[used]].astype(np.float64)
    cell = (row // lens.side + 1) * shape[1] + column // lens.side + 1
    with np.errstate(invalid="ignore"):  # of empty cells
        count = np.bincount(cell, minlength=size)
        off = z - (np.bincount(cell, z, size) / count)[cell]
        spread = np.bincount(cell, off * off, size)[count >= _LEAST_FOR_NOISE] / (count[count >= _LEAST_FOR_NOISE] - 1)
        noise_m = math.sqrt(np.median(spread)) if len(spread) else 0.0
        kept = np.abs(off) <= max(_JUMP_M, 2 * noise_m)
        count = np.bincount(cell[kept], minlength=size)
        u, v, ahead = (np.bincount(cell[kept], each[kept], size) / count for each in (column, row, z))
        x, y = (u + 0.5 - lens.x) / lens.focal * ahead, (v + 0.5 - lens.y) / lens.focal * ahead
        points = np.stack([x, y, ahead], axis=1).reshape(*shape, 3)
        ends = [np.roll(points, step, axis) for axis in (1, 0) for step in (-1, 1)]
        same = [np.where(np.abs(end - points)[..., 2:] < _JUMP_M, end, points) for end in ends]
        normals = np.cross(same[0] - same[1], same[2] - same[3])
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    own = points[points[..., 2] > 0]
    return _Cells(points, np.nan_to_num(normals), own, own.mean(axis=0), noise_m)


def _motion(own: _Cells, earlier: _Cells, lens: Lens) -> tuple[Floats, float]:
    """Rigid motion of a body back to the frame before, [3, 4]: rotation and, last, translation, metres; and the share
    of its points that meet no cell after it.

    Sought from no motion or the shift of its middle, whichever fits better, by Gauss-Newton steps (Chen and Medioni
    1992) on the distances of its points to the planes of the cells they meet, with Tukey's weights.
    """
    gate = max(_GATE_M, _NOISES * max(own.noise_m, earlier.noise_m))
    points = own.own[:: max(1, len(own.own) // _CELLS)]
    still = np.eye(3, 4)
    shifted = np.column_stack([np.eye(3), earlier.middle - own.middle])
    motion = min(still, shifted, key=lambda start: _met(_moved(start, points), earlier, lens, gate)[2])
    for _ in range(_STEPS):
        places = _moved(motion, points)
        off, normals, _ = _met(places, earlier, lens, gate)
        away, middle = np.einsum("ij,ij->i", normals, off), places.mean(axis=0)
        lines = np.hstack([np.cross(places - middle, normals), normals])
        weighed = lines.T * np.maximum(1 - (away / gate) ** 2, 0) ** 2
        step = np.linalg.solve(weighed @ lines + _STILL, weighed @ away)
        turn = rotation(step[:3])
        motion = turn @ motion
        motion[:, 3] += middle - turn @ middle + step[3:]
    return motion, _met(_moved(motion, points), earlier, lens, gate)[2][1]


def _met(places: Floats, cells: _Cells, lens: Lens, gate: float) -> tuple[Floats, Floats, tuple[float, float]]:
    """Of places [M, 3] the way to the cell that each meets, into which it projects and which is at most `gate` metres
    away in range, and its normal, both 0 for none; and the mean distance in range, `gate` for none, and the
    share of those that meet none.
    """
    ahead = np.maximum(places[:, 2], _NEAREST_M)
    line, row = (
        np.clip((places[:, axis] / ahead * lens.focal + centre) // lens.side + 1, 0, cells.points.shape[1 - axis] - 1)
        for axis, centre in ((0, lens.x), (1, lens.y))
    )
    at = row.astype(np.intp), line.astype(np.intp)
    off = cells.points[at] - places
    meets = np.abs(off[:, 2:]) <= gate
    distance_m = float(np.where(meets, np.abs(off[:, 2:]), gate).mean())
    return np.where(meets, off, 0), np.where(meets, cells.normals[at], 0), (distance_m, 1 - float(meets.mean()))


def _moved(rigid: Floats, points: Floats) -> Floats:
    """Points [M, 3] after a rigid motion [3, 4]."""
    return points @ rigid[:, :3].T + rigid[:, 3]


def rotation(vector: Floats) -> Floats:
    """Matrix [3, 3] of a rotation vector [3], radians (Rodrigues' formula)."""
    angle = max(float(np.linalg.norm(vector)), 1e-12)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    matrix: Floats = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)
    return matrix
