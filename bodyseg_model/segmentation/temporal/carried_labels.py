"""Labels of a video's frames, steadied by the evidence of earlier frames, without delay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig, check_int
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.core.rig import Camera
from bodyseg_data.core.system.divided_work import in_threads, pieces

if TYPE_CHECKING:
    from bodyseg_model.segmentation.temporal.cell_loops import Lens
    from bodyseg_model.segmentation.temporal.motion import BodyMotion, BodySurface, MotionModel

Labels = NDArray[np.uint8]
Body = tuple[NDArray[np.intp], NDArray[np.float32]]
"""Pixels of a body in a frame and the confidence of each, both [N]."""

SAME_BODY_M: Final = 0.5
"""Bodies of two frames are one if their middles are nearer, metres: 12 m/s at 25 frames a second."""

_LEAST_PIXELS: Final = 1 << 12  # of a thread that carries evidence, so that starting it pays


@dataclass(frozen=True)
class Carrying:
    """Parameters of `CarriedLabels`; docs/how-to/steady.md has their effect.

    motion: "parts" follows the parts of a body, "rigid" the body as a whole, "still" nothing: evidence stays at its
    pixel. keep: share of the evidence that is left after a frame, 0 to less than 1. slow: of a body that bends, it is
    keep / (1 + slow * pixels) at a point that moved so many pixels, as its place is less certain. margin: of a body
    that does not bend, evidence by which another label must exceed the one shown, in frames of confidence 1. border,
    border_share: of a body that bends, evidence for the label shown is multiplied by border_share where the new one is
    shown up to `border` pixels away: borders are where a wrong motion does harm. stiff_border, stiff_border_share: the
    same of a body that does not bend.
    tolerance_m, noises: a point is the same if ranges agree within tolerance_m or `noises` standard deviations of the
    ranges' noise, whichever is more. reach: pixels around the expected place at which it is sought. cell_m: side of the
    cells in which motion is estimated, metres. Raises BadConfig for values out of range.
    """

    motion: MotionModel = "parts"
    keep: float = 0.9
    slow: float = 0.02
    margin: float = 0.25
    border: int = 4
    border_share: float = 0.4
    stiff_border: int = 1
    stiff_border_share: float = 0.6
    tolerance_m: float = 0.03
    noises: float = 2.5
    reach: int = 2
    cell_m: float = 0.02

    def __post_init__(self) -> None:
        if not 0 <= self.keep < 1:
            raise BadConfig(f"the share of evidence that is kept must be 0 to less than 1, found {self.keep:g}")
        for name in ("border_share", "stiff_border_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise BadConfig(f"{name} of carried labels must be 0 to 1, found {getattr(self, name):g}")
        for name in ("slow", "margin", "tolerance_m", "noises"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise BadConfig(f"{name} of carried labels must be at least 0, found {getattr(self, name):g}")
        for name in ("reach", "border", "stiff_border"):
            check_int(f"the {name} of carried labels", getattr(self, name), 0)
        if not self.cell_m > 0:
            raise BadConfig(f"the cells of carried labels must be larger than 0 m, found {self.cell_m:g}")

    def to_json(self) -> dict[str, Any]:
        """The parameters as plain JSON, for summary.json."""
        return asdict(self)


@dataclass(frozen=True)
class _LastFrame:
    """The frame before: its camera, lens and bodies; ranges float32 [H * W], 0 off the bodies; slots of evidence."""

    camera: Camera
    lens: Lens
    bodies: list[tuple[BodySurface, BodyMotion]] = field(repr=False)
    range_m: NDArray[np.float32] = field(repr=False)
    slots: NDArray[np.uint32] = field(repr=False)


class CarriedLabels:
    """Steadies the labels of a recording's frames, called with each in turn.

    A label is kept on the point of the surface that it was found on: the body's motion since the last frame says where
    each point was, and where the ranges agree, its evidence is carried along, less by `carrying.keep`, and the new
    frame's confidence is added. Starts anew at `restart`, for frames of another camera, and for a body that was not
    seen in the last frame. The result is the same on every run, for any number of torch's threads. Raises
    MissingLibrary without numba.
    """

    def __init__(self, carrying: Carrying | None = None) -> None:
        self.carrying = carrying or Carrying()
        self._cells, self._motion, self._evidence = (
            import_module(f"{__package__}.{name}") for name in ("cell_loops", "motion", "evidence_loops")
        )
        self._last: _LastFrame | None = None
        self._spare: tuple[NDArray[np.float32], NDArray[np.uint32]] | None = None

    def __repr__(self) -> str:
        return f"CarriedLabels({self.carrying})"

    def restart(self) -> None:
        """Forget all frames, as at the start of a recording."""
        self._last = self._spare = None

    def __call__(
        self,
        range_m: NDArray[np.float32],
        labels: Labels,
        bodies: Sequence[Body],
        camera: Camera,
    ) -> Labels:
        """Steady the labels of the next frame; returns the label image, uint8 [H, W], 255 off the bodies.

        range_m: float32 [H, W], metres, 0 = nothing measured. labels: uint8 [H, W], the network's. bodies: pixels,
        int64 [N], row * W + column, ascending, and confidence, float32 [N], of each. camera: that of the frame.
        """
        last = self._last if self._last is not None and self._last.camera == camera else None
        flat, named = np.ascontiguousarray(range_m).ravel(), labels.ravel()
        seen = [(pixels, confidence) for pixels, confidence in bodies if len(pixels)]
        lens = self._lens(flat, seen[0][0], camera) if last is None and seen else None if last is None else last.lens
        steadied = np.full(labels.shape, BACKGROUND, np.uint8)
        if lens is None:  # nobody was seen yet
            return steadied
        ranges, slots = self._buffers(flat.size, last)
        surfaces = [
            self._motion.surface_of(self._cells.cells_of(flat, pixels, named, lens, self._motion.JUMP_M))
            for pixels, _ in seen
        ]
        found, threads = [], torch.get_num_threads()
        for body, surface, old in zip(seen, surfaces, self._pairs(surfaces, last), strict=True):
            written = ranges, slots, steadied.ravel()
            if last is None or old is None:
                motion = self._motion.unmoved(surface)
                self._evidence.begin(flat, body[0], named, body[1], *written)
            else:
                before = last.bodies[old]
                noise = float(np.hypot(surface.cells.noise_m, before[0].cells.noise_m))
                tolerance = np.float32(max(self.carrying.tolerance_m, self.carrying.noises * noise))
                images = self._motion.Pixels(flat, body[0], named, last.range_m, last.slots)
                rules = lens, tolerance, self.carrying.motion, threads
                motion = self._motion.motion_back(surface, *before, images, *rules)
                moved = motion.rigid.astype(np.float32), motion.field, surface.cells.grid, last.range_m, last.slots
                rule = tolerance, *self._rule(motion.bends)
                self._carry(flat, body, named, (lens, *moved, *rule, *written), threads)
            found.append((surface, motion))
        if last is not None:
            self._spare = last.range_m, last.slots
        self._last = _LastFrame(camera, lens, found, ranges, slots)
        return steadied

    def _carry(
        self, flat: NDArray[np.float32], body: Body, named: Labels, arguments: tuple[Any, ...], threads: int
    ) -> None:
        """Carry evidence to a body's pixels, which do not depend on each other, in several threads if they are many."""
        pixels, confidence = body

        def work(first: int, last: int) -> None:
            self._evidence.carry(flat, pixels[first:last], named, confidence[first:last], *arguments)

        in_threads(work, pieces(len(pixels), min(threads, max(1, len(pixels) // _LEAST_PIXELS))))

    def _rule(self, bends: bool) -> tuple[int, float, float, np.uint32, int, float]:
        """Reach, keep, slow, margin, border and its share as the loops take them."""
        rule = self.carrying
        if bends:
            return rule.reach, rule.keep, rule.slow, np.uint32(0), rule.border, rule.border_share
        margin = np.uint32(round(rule.margin * self._evidence.UNIT))
        return rule.reach, rule.keep, 0.0, margin, rule.stiff_border, rule.stiff_border_share

    def _lens(self, flat: NDArray[np.float32], pixels: NDArray[np.intp], camera: Camera) -> Lens:
        """The camera's numbers, and cells of the size that `carrying.cell_m` has at the range of the first body."""
        side = max(1, round(self.carrying.cell_m * camera.focal_px / float(np.median(flat[pixels]))))
        cells = -(-camera.columns // side), -(-camera.rows // side)
        lens: Lens = self._cells.Lens(camera.focal_px, *camera.centre_px, camera.columns, camera.rows, side, *cells)
        return lens

    def _buffers(self, size: int, last: _LastFrame | None) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
        """Memory of ranges, all 0, and slots for a frame: that of the frame before the last, where there is one."""
        if last is None or self._spare is None:
            return np.zeros(size, np.float32), np.empty((size, self._evidence.SLOTS), np.uint32)
        self._spare[0].fill(0)
        return self._spare

    def _pairs(self, surfaces: Sequence[BodySurface], last: _LastFrame | None) -> list[int | None]:
        """For every body its number in the last frame: the nearest that is left; None for a new one."""
        middles = {} if last is None else {number: body.middle for number, (body, _) in enumerate(last.bodies)}
        found: list[int | None] = []
        for surface in surfaces:
            away = {number: float(np.linalg.norm(middle - surface.middle)) for number, middle in middles.items()}
            nearest = min(away, key=lambda number: (away[number], number), default=None)
            if nearest is not None and away[nearest] <= SAME_BODY_M:
                middles.pop(nearest)
                found.append(nearest)
            else:
                found.append(None)
        return found
