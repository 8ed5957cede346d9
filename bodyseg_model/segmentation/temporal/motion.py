"""Motion of a body from one frame back to the one before, by its ranges and the labels of its parts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.system.divided_work import of_each, pieces
from bodyseg_model.segmentation.temporal.cell_loops import Cells, Lens
from bodyseg_model.segmentation.temporal.motion_loops import fit_rigid, misfit, moved, relax
from bodyseg_model.segmentation.temporal.part_loops import (
    count_matches,
    gain_of_shifts,
    match_parts,
    mean_points,
    part_shifts,
)

MotionModel = Literal["still", "rigid", "parts"]

JUMP_M: Final = 0.04
"""Neighbouring cells whose ranges differ by more are of two surfaces, metres; more in noise."""

_GATE_M: Final = 0.05  # cells further from the surface they meet do not count
_NOISES: Final = 2.0  # standard deviations of a cell's ranges that are added to a jump
_RIGID_STEPS: Final = 5
_RIGID_CELLS: Final = 800  # suffice for a rigid motion: of more, every second, third ... is used
_LEAST_CELLS: Final = 20  # of a part whose shift is used
_REACH_M: Final = 0.3  # greatest shift of a part beyond the body's own
_FAITH_NOISE_M: Final = 0.02  # noise that halves the weight of distances to planes
_PULL: Final = 0.05  # weight of a part's shift
_STILL: Final = 0.005  # weight of no motion beyond the body's own
_ROUNDS: Final = 2
_SWEEPS: Final = 4
_MATCH_REACH: Final = 2  # pixels by which the place of a part is improved
_MATCH_PIXELS: Final = 2000
_MATCH_PIECES: Final = 2  # in which matches are counted for any number of threads: sums of ranges depend on it
_FALL_M: Final = 0.001  # fall of ranges' differences that counts as much as _MORE cells of which the label agrees
_MORE: Final = 0.01
_REMEMBERED: Final = 0.7  # of the gain of shifting parts up to the frame before
_MOST_GAIN: Final = 2.0  # that is remembered, so that a body that begins to bend is soon seen to
_BENDS: Final = 2.0  # gain from which on a body bends

Motion = NDArray[np.float64]
"""A rigid motion, [3, 4]: rotation and, last, translation, metres."""


@dataclass(frozen=True)
class BodySurface:
    """A body in a frame: its cells, their mean point, float64 [3], metres, and the middles [256, 3], metres, and areas
    [256] of its parts.
    """

    cells: Cells
    middle: NDArray[np.float64]
    middles: NDArray[np.float64]
    areas: NDArray[np.float64]


def surface_of(cells: Cells) -> BodySurface:
    """A body's cells with the middles of its parts."""
    return BodySurface(cells, *mean_points(cells.points, cells.labels))


def still() -> Motion:
    """The motion that moves nothing."""
    return np.eye(4)[:3].copy()


class Pixels(NamedTuple):
    """A body's pixels, int64 [N], ascending, in its new frame, and the images of both frames as flat arrays: ranges,
    float32 [H * W], metres, the network's labels, uint8 [H * W], and the old frame's slots of evidence.
    """

    range_m: NDArray[np.float32]
    pixels: NDArray[np.intp]
    labels: NDArray[np.uint8]
    old_range_m: NDArray[np.float32]
    old_slots: NDArray[np.uint32]


@dataclass(frozen=True)
class BodyMotion:
    """Motion of a body from a frame back to the one before: a rigid one, further displacements of its cells, float32
    [M, 3], metres, and the gain of shifting its parts, summed up over the frames so far.
    """

    rigid: Motion
    field: NDArray[np.float32] = dataclass_field(repr=False)
    gain: float = 0.0

    @property
    def bends(self) -> bool:
        """True if ranges and labels fit better, over the last frames, when parts are shifted."""
        return self.gain > _BENDS


def unmoved(surface: BodySurface) -> BodyMotion:
    """The motion of a body that was not in the frame before: none."""
    return BodyMotion(still(), np.zeros_like(surface.cells.points))


def motion_back(
    new: BodySurface,
    old: BodySurface,
    before: BodyMotion,
    pixels: Pixels,
    lens: Lens,
    tolerance: np.float32,
    model: MotionModel,
    threads: int = 1,
) -> BodyMotion:
    """Motion of a body from its new frame to the old one.

    before: between the two frames before. The rigid fit starts from no motion, the shift of the body's middle or
    `before`, whichever fits best. model: "still": no motion at all; "rigid": of the body as a whole; "parts": with the
    displacements, which fit the surface smoothly and, if the body bends, start from the shifts of parts. These are the
    shifts of their middles, improved where their labels match the old frame better. tolerance: ranges that differ by
    less, metres, can be of one point. threads: at most so many compute; the motion does not depend on it.
    """
    if model == "still":
        return unmoved(new)
    shift = still()
    shift[:, 3] = old.middle - new.middle
    noise = max(new.cells.noise_m, old.cells.noise_m)
    gate = max(_GATE_M, (1 + _NOISES) * noise)
    target = old.cells.grid, old.cells.points
    starts = (still(), shift, before.rigid)
    some = np.ascontiguousarray(new.cells.points[:: max(1, len(new.cells.points) // _RIGID_CELLS)])
    errors = [misfit(some, start, *target, lens, gate) for start in starts]
    motion = starts[int(np.argmin(errors))].copy()
    fit_rigid(some, motion, *target, old.cells.normals, lens, gate, _RIGID_STEPS)
    if model == "rigid":
        return BodyMotion(motion, np.zeros_like(new.cells.points))
    least = _LEAST_CELLS * float(new.middle[2]) ** 2
    shifts, weights = part_shifts(motion, new.middles, new.areas, old.middles, old.areas, least, _REACH_M)
    matches = _matches(pixels, motion, shifts, lens, tolerance, threads)
    match_parts(*matches, lens.focal, shifts, weights)
    places = moved(motion, new.cells.points)
    fall_m, more = gain_of_shifts(places, new.cells.labels, shifts, weights, *target, old.cells.labels, lens, gate)
    gain = _REMEMBERED * min(max(before.gain, -_MOST_GAIN), _MOST_GAIN) + fall_m / _FALL_M + more / _MORE
    if gain <= _BENDS:
        shifts[:], weights[:] = 0, 0
    faith = 1 / (1 + (noise / _FAITH_NOISE_M) ** 2)
    scales = (np.float32(value) for value in (gate, faith, _PULL, _STILL))
    field: NDArray[np.float32] = relax(
        places, new.cells.neighbours, new.cells.labels, shifts, weights, *target, old.cells.normals, lens, *scales,
        _ROUNDS, _SWEEPS,
    )  # fmt: skip
    return BodyMotion(motion, field, float(gain))


def _matches(
    pixels: Pixels,
    motion: Motion,
    shifts: NDArray[np.float32],
    lens: Lens,
    tolerance: np.float32,
    threads: int,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """The sums over a body's pixels that `match_parts` takes, of about _MATCH_PIXELS of them.

    Two threads take as long as one for so few, but a processor that was busy just before is quicker with the evidence.
    """
    step = max(1, int(math.sqrt(len(pixels.pixels) / _MATCH_PIXELS)))

    def count(run: tuple[int, int]) -> Any:
        some = pixels._replace(pixels=pixels.pixels[slice(*run)])
        return count_matches(*some, motion, shifts, lens, tolerance, _MATCH_REACH, step)

    one, other = of_each(count, pieces(len(pixels.pixels), _MATCH_PIECES), threads)
    return one[0] + other[0], one[1] + other[1], one[2] + other[2]
