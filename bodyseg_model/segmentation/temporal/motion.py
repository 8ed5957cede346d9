"""Motion of a body from one frame back to the one before, by its ranges and the middles of its parts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_model.segmentation.temporal.cell_loops import Cells, Lens
from bodyseg_model.segmentation.temporal.motion_loops import (
    fit_rigid,
    gain_of_shifts,
    misfit,
    moved,
    part_middles,
    part_shifts,
    relax,
)

MotionModel = Literal["still", "rigid", "parts"]

JUMP_M: Final = 0.04
"""Neighbouring cells whose ranges differ by more are of two surfaces, metres; more in noise."""

_GATE_M: Final = 0.05  # cells further from the surface they meet do not count
_NOISES: Final = 2.0  # standard deviations of a cell's ranges that are added to a jump
_RIGID_STEPS: Final = 5
_LEAST_CELLS: Final = 20  # of a part whose shift is used
_REACH_M: Final = 0.3  # greatest shift of a part beyond the body's own
_FAITH_NOISE_M: Final = 0.02  # noise that halves the weight of distances to planes
_PULL: Final = 0.05  # weight of a part's shift
_STILL: Final = 0.005  # weight of no motion beyond the body's own
_ROUNDS: Final = 3
_SWEEPS: Final = 4

Motion = NDArray[np.float64]
"""A rigid motion, [3, 4]: rotation and, last, translation, metres."""


@dataclass(frozen=True)
class BodySurface:
    """A body in a frame: its cells, and the middles [256, 3], metres, and areas [256] of its parts."""

    cells: Cells
    middles: NDArray[np.float64]
    areas: NDArray[np.float64]

    @property
    def middle(self) -> NDArray[np.float64]:
        """The body's mean point, float64 [3], metres."""
        mean: NDArray[np.float64] = self.cells.points.mean(axis=0, dtype=np.float64)
        return mean


def surface_of(cells: Cells) -> BodySurface:
    """A body's cells with the middles of its parts."""
    return BodySurface(cells, *part_middles(cells.points, cells.labels))


def still() -> Motion:
    """The motion that moves nothing."""
    return np.eye(4)[:3].copy()


def motion_back(
    new: BodySurface, old: BodySurface, before: Motion, lens: Lens, model: MotionModel
) -> tuple[Motion, NDArray[np.float32], bool]:
    """Motion of a body from its new frame to the old one: a rigid one; further displacements of `new.cells`, float32
    [M, 3], metres; and whether the body bends: whether ranges fit better when parts are shifted.

    before: the rigid motion between the two frames before. The rigid fit starts from no motion, the shift of the body's
    middle or `before`, whichever fits best. model: "still": no motion at all; "rigid": of the body as a whole; "parts":
    with the displacements, which fit the surface
    smoothly and, if the body bends, start from the shifts of the middles of parts.
    """
    motion, none = still(), np.zeros_like(new.cells.points)
    if model == "still":
        return motion, none, False
    shift = still()
    shift[:, 3] = old.middle - new.middle
    noise = max(new.cells.noise_m, old.cells.noise_m)
    gate = max(_GATE_M, (1 + _NOISES) * noise)
    target = old.cells.grid, old.cells.points
    starts = (motion, shift, before)
    errors = [misfit(new.cells.points, start, *target, lens, gate) for start in starts]
    motion = starts[int(np.argmin(errors))].copy()
    fit_rigid(new.cells.points, motion, *target, old.cells.normals, lens, gate, _RIGID_STEPS)
    if model == "rigid":
        return motion, none, False
    least = _LEAST_CELLS * float(new.middle[2]) ** 2
    shifts, weights = part_shifts(motion, new.middles, new.areas, old.middles, old.areas, least, _REACH_M)
    places = moved(motion, new.cells.points)
    bends = gain_of_shifts(places, new.cells.labels, shifts, weights, *target, lens, gate) > 0
    if not bends:
        shifts[:], weights[:] = 0, 0
    faith = 1 / (1 + (noise / _FAITH_NOISE_M) ** 2)
    scales = (np.float32(value) for value in (gate, faith, _PULL, _STILL))
    field: NDArray[np.float32] = relax(
        places, new.cells.neighbours, new.cells.labels, shifts, weights, *target, old.cells.normals, lens, *scales,
        _ROUNDS, _SWEEPS,
    )  # fmt: skip
    return motion, field, bool(bends)
