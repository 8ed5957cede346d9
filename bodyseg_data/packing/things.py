"""Things around a body: furniture drawn by the sample's key, placed before or behind it, seen by camera and projector.

A thing has no label. What is drawn depends on the key, the body's extent and the view alone, so that a set with things
has the same bytes however it is packed: every thing is drawn from a sequence of raw random words, whose bits NumPy
guarantees as it does not those of its distributions. Things are cuboids and turned solids, each in its own frame: x to
the right, y up, z away from the viewer; it stands on y = 0, around x = z = 0.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import Draws
from bodyseg_data.meshes import Mesh, Solid, cuboid, together, turned_solid
from bodyseg_data.rendering import Renderer, Surface
from bodyseg_data.rigs import PlacedCamera, axes_at
from bodyseg_data.samples import FARTHEST_STEPS, View

_MOST_DRAWS: Final = 4096

ThingsPlace = Literal["none", "before", "behind", "both"]
"""Places of things: between camera and body, behind or beside the body, or both."""

LEAST_HIDDEN: Final = 0.05
"""Least share of a body that things before it hide, unless no draw reaches it."""
MOST_HIDDEN: Final = 0.6
"""Greatest share of a body's pixels that things hide, from the camera or from every projector: a thing right before the
projector would leave the whole image without range.
"""

BEFORE: Final = ("plank", "box", "table", "chair", "bed", "machine", "bin", "plant", "lamp")
"""Kinds of things before a body."""
BEHIND: Final = ("box", "table", "chair", "bed", "machine", "bin", "plant", "lamp")
"""Kinds of things behind a body and beside it."""

ATTEMPTS: Final = 16
"""Draws until as much is hidden as asked for."""
_NEAREST_M: Final = 0.5  # of the camera to a thing
_GAP_M: Final = 0.05  # between a body and a thing, at least


# Furniture and machines.


class Numbers:
    """Random numbers of one purpose, one after another, at most 4096."""

    def __init__(self, draws: Draws, purpose: str) -> None:
        self._words = iter(draws.pixels(purpose, _MOST_DRAWS, np.uint32).tolist())

    def between(self, low: float, high: float) -> float:
        """A number, uniform from `low` to `high`."""
        return low + (high - low) * self._word() * 2.0**-32

    def whole(self, low: int, high: int) -> int:
        """A whole number, uniform from `low` to `high`, both included."""
        return low + (self._word() * (high - low + 1) >> 32)

    def _word(self) -> int:
        return int(next(self._words))


def box(numbers: Numbers) -> Solid:
    """A box or a cupboard."""
    width, height, depth = numbers.between(0.3, 1.0), numbers.between(0.3, 1.4), numbers.between(0.25, 0.7)
    return cuboid((width, height, depth), (0.0, height / 2, 0.0))


def table(numbers: Numbers) -> Solid:
    """A table: a top and four legs."""
    width, height, depth = numbers.between(0.7, 1.6), numbers.between(0.45, 1.0), numbers.between(0.5, 0.9)
    return together([_top(width, depth, height, numbers.between(0.02, 0.06)), *_legs(numbers, width, depth, height)])


def chair(numbers: Numbers) -> Solid:
    """A chair: a seat, four legs, and a back that is one board or three."""
    width, height, depth = numbers.between(0.38, 0.6), numbers.between(0.4, 0.52), numbers.between(0.38, 0.55)
    pieces = [_top(width, depth, height, numbers.between(0.03, 0.1)), *_legs(numbers, width, depth, height)]
    rise, boards = numbers.between(0.3, 0.65), (1, 3)[numbers.whole(0, 1)]
    for board in range(boards):
        tall = rise if boards == 1 else rise / 5
        middle = height + rise / 2 if boards == 1 else height + rise * (0.1 + 0.4 * board)
        pieces.append(cuboid((width, tall, 0.04), (0.0, middle, depth / 2 - 0.02)))
    if boards == 3:
        away = width / 2 - 0.02
        pieces += [cuboid((0.04, rise, 0.04), (x, height + rise / 2, depth / 2)) for x in (-away, away)]
    return together(pieces)


def bed(numbers: Numbers) -> Solid:
    """A bed: a mattress on a frame, and a board at its head."""
    width, depth, height = numbers.between(1.6, 2.1), numbers.between(0.8, 1.2), numbers.between(0.4, 0.8)
    under, head = numbers.between(0.0, 0.25), height + numbers.between(0.1, 0.5)
    pieces = [
        cuboid((width, height - under, depth), (0.0, (height + under) / 2, 0.0)),
        cuboid((0.05, head, depth), (-width / 2, head / 2, 0.0)),
    ]
    return together([*pieces, *_legs(numbers, width, depth, under)] if under > 0.05 else pieces)


def machine(numbers: Numbers) -> Solid:
    """A machine: a foot, a column, and two to four boxes, held out to the sides or to the front."""
    height, foot = numbers.between(0.9, 1.8), numbers.between(0.35, 0.7)
    thick = numbers.between(0.08, 0.3)
    pieces = [cuboid((foot, 0.12, foot), (0.0, 0.06, 0.0)), cuboid((thick, height, thick), (0.0, height / 2, 0.0))]
    for _ in range(numbers.whole(2, 4)):
        size = numbers.between(0.15, 0.6), numbers.between(0.08, 0.4), numbers.between(0.1, 0.4)
        out, above = numbers.between(-0.3, 0.3), numbers.between(0.3, 1.0) * height
        pieces.append(cuboid(size, (out, above, numbers.between(-0.2, 0.1))))
    return together(pieces)


def plank(numbers: Numbers) -> Solid:
    """A board at some height that hides what is behind it, such as a rail, a tray or the arm of a machine."""
    width, height = numbers.between(0.6, 1.8), numbers.between(0.06, 0.35)
    return cuboid((width, height, 0.04), (0.0, numbers.between(0.2, 1.6), 0.0))


def bin_(numbers: Numbers) -> Solid:
    """A bin, a barrel or a round stool."""
    height, low, high = numbers.between(0.35, 1.1), numbers.between(0.12, 0.35), numbers.between(0.12, 0.35)
    return turned_solid([(low, 0.0), (high, height)])


def plant(numbers: Numbers) -> Solid:
    """A plant or a large ball: an ellipsoid crown on a pot."""
    pot, across, tall = numbers.between(0.15, 0.5), numbers.between(0.2, 0.5), numbers.between(0.25, 0.7)
    angles = [math.pi * step / 12 for step in range(1, 12)]
    crown = [(across * math.sin(angle), pot + tall * (1 - math.cos(angle))) for angle in angles]
    return together([turned_solid([(0.12, 0.0), (0.16, pot)]), turned_solid(crown)])


def lamp(numbers: Numbers) -> Solid:
    """A lamp on a pole, or a stand with a hat or an umbrella."""
    height, shade = numbers.between(1.0, 1.8), numbers.between(0.15, 0.35)
    pole = turned_solid([(0.15, 0.0), (0.15, 0.03), (0.03, 0.05), (0.03, height - 0.1)])
    return together([pole, turned_solid([(shade, height - 0.3), (shade * numbers.between(0.3, 1.0), height)])])


FURNITURE: Final[dict[str, Callable[[Numbers], Solid]]] = {
    made.__name__.rstrip("_"): made for made in (box, table, chair, bed, machine, bin_, plant, lamp, plank)
}
"""Name -> a thing of that kind, drawn anew."""


def _top(width: float, depth: float, height: float, thick: float) -> Solid:
    return cuboid((width, thick, depth), (0.0, height - thick / 2, 0.0))


def _legs(numbers: Numbers, width: float, depth: float, height: float) -> list[Solid]:
    thick = numbers.between(0.03, 0.08)
    away = (width - thick) / 2, (depth - thick) / 2
    return [cuboid((thick, height, thick), (x * away[0], height / 2, z * away[1])) for x in (-1, 1) for z in (-1, 1)]


# Their places.


@dataclass(frozen=True)
class Things:
    """Things in a body's frame, and their renderer. hidden: the share of the body's pixels that they hide, 0 to 1."""

    solid: Solid
    step_m: float
    hidden: float = 0.0

    @cached_property
    def _renderer(self) -> Renderer:
        from bodyseg_data.rendering import RasterRenderer  # loads numba, which streaming and planning do not need

        return RasterRenderer(self.solid)

    def render(self, camera: PlacedCamera) -> Surface:
        """Render the things alone. What is farther than 16 bits hold is not measured."""
        seen = self._renderer.render(camera)
        beyond = seen.range > (float(FARTHEST_STEPS) - 0.5) * self.step_m
        return Surface(np.where(beyond, 0, seen.range), np.where(beyond, -1, seen.face)) if beyond.any() else seen

    def facing(self, faces: NDArray[np.int32], source: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Mark `faces` [N] that turn their outside to a light at `source` [3], bool [N]."""
        normals = self.solid.normals
        towards = np.einsum("ij,ij->i", normals, source - self.solid.vertices[self.solid.faces[:, 0]])
        return np.asarray(towards > 0).take(faces)


def nearest(body: Surface, things: Surface, faces: int) -> Surface:
    """The nearer of two surfaces at every pixel; triangles of things count on from `faces`, the body's number."""
    before = in_front(things, body)
    numbers = things.face + np.int32(faces)
    return Surface(np.where(before, things.range, body.range), np.where(before, numbers, body.face))


def in_front(things: Surface, body: Surface) -> NDArray[np.bool_]:
    """True where a thing is seen, and nearer than the body or beside it, bool [H, W]."""
    return (things.face >= 0) & ((body.face < 0) | (things.range < body.range))


def draw_things(
    place: ThingsPlace,
    key: str,
    mesh: Mesh,
    view: View,
    camera: PlacedCamera,
    seen: Surface,
    step_m: float,
    hidden: tuple[float, float] = (LEAST_HIDDEN, MOST_HIDDEN),
    attempts: int = ATTEMPTS,
    projectors: Sequence[tuple[PlacedCamera, Surface]] = (),
) -> Things:
    """Draw the things of a sample, which hide at most `hidden[1]` of the body's pixels.

    seen: what `camera` sees of the body alone. step_m: of the rig. Up to `attempts` draws are made until the things
    before the body hide at least `hidden[0]` of it; if none does, the one that hides most of it counts. projectors:
    each with what it sees of the body alone; one of them, too, must have no more than `hidden[1]` of it hidden.
    """
    room = _Room(mesh, view, camera)
    best = Things(together([]), step_m)
    for attempt in range(attempts):
        numbers = Numbers(Draws(0, 0, key), f"things {attempt}")
        solids = []
        if place in ("before", "both"):
            solids += [room.before(numbers) for _ in range(numbers.whole(1, 2))]
        if place in ("behind", "both"):
            solids += [room.behind(numbers) for _ in range(numbers.whole(1, 4))]
        found = Things(together(solids), step_m)
        share = _hidden_share(found, camera, seen)
        better = share <= hidden[1] and (share > best.hidden or not len(best.solid.faces))
        if better and (not projectors or min(_hidden_share(found, *each) for each in projectors) <= hidden[1]):
            best = Things(found.solid, step_m, share)
        if best.hidden >= hidden[0] or (place == "behind" and len(best.solid.faces)):
            break
    return best


def _hidden_share(things: Things, camera: PlacedCamera, seen: Surface) -> float:
    """The share of the body's pixels that things hide from a camera; seen: what it sees of the body alone."""
    body = seen.face >= 0
    return int(np.count_nonzero(in_front(things.render(camera), seen) & body)) / max(int(np.count_nonzero(body)), 1)


class _Room:
    """The body's extent in a frame whose z is the camera's direction along the floor; y is 0 at its lowest point."""

    def __init__(self, mesh: Mesh, view: View, camera: PlacedCamera) -> None:
        right, down, forward = axes_at(view.azimuth_deg)
        self._axes = np.stack([right, -down, forward])
        points = mesh.surface_vertices
        self._origin = np.array([mesh.centre[0], points[:, 1].min(), mesh.centre[2]])
        local = (points - self._origin) @ self._axes.T
        self._left, _, self._front = map(float, local.min(axis=0))
        self._right, _, self._back = map(float, local.max(axis=0))
        self._camera = float((camera.position - self._origin) @ forward)

    def before(self, numbers: Numbers) -> Solid:
        """A thing between body and camera, turned by up to 40 degrees."""
        thing = _kind(BEFORE, numbers).turned(numbers.between(-0.7, 0.7))
        low, high = thing.vertices.min(axis=0), thing.vertices.max(axis=0)
        across = numbers.between(self._left - 0.8 * high[0], self._right - 0.8 * low[0])
        nearest_z = self._camera + _NEAREST_M - low[2]
        farthest_z = self._front - _GAP_M - high[2]
        return self._put(thing, across, max(farthest_z - numbers.between(0.0, 0.8), min(nearest_z, farthest_z)))

    def behind(self, numbers: Numbers) -> Solid:
        """A thing behind the body or, one time in three, beside it, turned in any way."""
        thing = _kind(BEHIND, numbers).turned(numbers.between(-np.pi, np.pi))
        low, high = thing.vertices.min(axis=0), thing.vertices.max(axis=0)
        gap = numbers.between(_GAP_M, 1.0)
        if numbers.whole(0, 2):
            return self._put(thing, numbers.between(self._left - 1.0, self._right + 1.0), self._back + gap - low[2])
        on_left = numbers.whole(0, 1)
        across = self._left - gap / 2 - high[0] if on_left else self._right + gap / 2 - low[0]
        return self._put(thing, across, numbers.between(self._front, self._back + 0.5))

    def _put(self, thing: Solid, across: float, away: float) -> Solid:
        return thing.moved((across, 0.0, away)).placed(self._axes, self._origin)


def _kind(names: tuple[str, ...], numbers: Numbers) -> Solid:
    return FURNITURE[names[numbers.whole(0, len(names) - 1)]](numbers)
