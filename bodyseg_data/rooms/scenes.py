"""Rooms with people, drawn by their keys: what stands where, and what a rig's camera and projectors see of it.

A room's frame is y up, the floor at y = 0; the camera stands at x = z = 0 and looks towards -z. Everything is drawn
from a sequence of raw random words of its own (`Numbers`), whose bits NumPy guarantees, so a sample has the same bytes
however it is packed. What is dark or shiny returns too little light: the camera measures nothing in patches of it, while
it still hides what is behind.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import Draws
from bodyseg_data.labels import BACKGROUND, PART_CLASSES, UNLABELLED
from bodyseg_data.machine import compiled
from bodyseg_data.meshes import Mesh, Partition, Solid, cuboid, together
from bodyseg_data.packing import Numbers
from bodyseg_data.rendering import RasterRenderer
from bodyseg_data.renders import Render
from bodyseg_data.rigs import PlacedCamera, Rig, axes_at
from bodyseg_data.rooms.furnishings import FURNISHINGS, SEATS, bag, ball, bed, bent, clutter, coat, sheet, slab
from bodyseg_data.samples import Split

Floats = NDArray[np.float64]

_PEOPLE: Final = (1,) * 11 + (2,) * 6 + (3,) * 4
"""Numbers of people in a room that has some, each as often."""
_EMPTY: Final = 0.08  # share of rooms without anybody
_BARE: Final = 0.12  # share of rooms without walls and floor
_NEAREST_M: Final = 0.7
_FARTHEST_M: Final = 6.0
_SIT: Final = "sitting", "on_a_chair"
_LIE: Final = "lying", "on_the_back", "on_the_front", "on_the_side"
_HIPS: Final = ("Rt. PSIS", "Lt. PSIS", "Rt. Trochanterion", "Lt. Trochanterion")
_KNEES: Final = ("Rt. Femoral Lateral Epicn", "Lt. Femoral Lateral Epicn")
_HAIR: Final = ("Nuchale",)
_TROUSERS: Final = (*_HIPS, *_KNEES, "Rt. Knee Crease", "Lt. Knee Crease", "Rt. ASIS", "Lt. ASIS")
_SHOES: Final = ("Rt. Digit II", "Lt. Digit II", "Rt. Lateral Malleolus", "Lt. Lateral Malleolus")


@dataclass(frozen=True)
class Person:
    """Somebody who may stand in a room: a body with its labels. pose: in words."""

    mesh: Mesh = field(repr=False)
    parts: Partition = field(repr=False)
    pose: str

    def among(self, names: Sequence[str]) -> NDArray[np.bool_]:
        """Which vertices belong to parts of these names, [V]."""
        return np.isin(self.parts.labels, [PART_CLASSES.names.index(name) for name in names])


# What of a surface returns no light: level (in standard deviations of a random field over space that lie below it),
# what is added to it where the surface is seen edge-on, and the longest wave of the field, metres.
Loss = tuple[float, float, float]
_KEPT: Final[Loss] = (-9.0, 0.0, 1.0)
_CELLS: Final = 16  # of the field's lattice, along each axis
_WAVES: Final = (1.0, 0.37, 0.12)  # as shares of the longest; weights below, divided by the sum's standard deviation
_WEIGHTS: Final = (5.2, 3.1, 2.1)


@dataclass(frozen=True)
class _Pose:
    """A rotation [3, 3], then a move [3], metres."""

    turn: Floats
    by_m: Floats

    def of(self, solid: Solid) -> Solid:
        return Solid(solid.vertices @ self.turn.T + self.by_m, solid.faces)

    def back(self, points: Floats) -> Floats:
        return (points - self.by_m) @ self.turn


def _about(angle_rad: float, axis: int = 1) -> Floats:
    """Rotation about an axis, [3, 3]: about y, from -z towards x."""
    one, two = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[one, one] = matrix[two, two] = math.cos(angle_rad)
    matrix[two, one], matrix[one, two] = math.sin(angle_rad), -math.sin(angle_rad)
    return matrix


@dataclass(frozen=True)
class _Wall:
    """A wall: points with normal . p = offset; the room is where that is less."""

    normal: Floats
    offset: float

    @property
    def angle_rad(self) -> float:
        """By which a thing with its back towards +z is turned to stand with its back to the wall."""
        return math.atan2(self.normal[0], self.normal[2])

    def free(self, slope: float) -> float:
        """Depth at which the ray of that slope across meets the wall, inf if it does not."""
        towards = self.normal[0] * slope - self.normal[2]
        return self.offset / towards if towards > 1e-6 else math.inf

    def depth_of(self, vertices: Floats) -> float:
        return float((vertices @ self.normal).max())


class Room:
    """One room: walls, things and people, as pieces of one surface."""

    def __init__(self, key: str, rig: Rig, people: Sequence[Person], kinds: Sequence[str], seed: int = 0) -> None:
        self._draws, self._key, self._kinds, self.rig = Draws(seed, 0, key), key, kinds, rig
        numbers = self.numbers("room")
        self.height_m = numbers.between(0.4, 2.2)
        low, high = max(-30.0, -45.0 * self.height_m / 2.2), 20.0 - 12.0 * self.height_m
        self.pitch_deg = numbers.between(low, max(high, low + 5))
        self._taken: list[tuple[float, float, float]] = []
        self._half = rig.camera.columns / 2 / rig.camera.focal_px
        self.solids: list[Solid] = []
        self.losses: list[Loss] = []
        self.persons: list[tuple[Person, _Pose]] = []
        self.worn: list[list[Loss]] = []
        self.walls: list[_Wall] = []
        bare, empty = numbers.between(0, 1) < _BARE, numbers.between(0, 1) < _EMPTY
        if not bare:
            self.walls = self._build_walls(numbers)
        for number in range(0 if empty else _PEOPLE[numbers.whole(0, len(_PEOPLE) - 1)]):
            own = self.numbers(f"person {number}")
            person = people[own.whole(0, len(people) - 1)]
            for _ in range(6):
                if self._place_person(person, own):
                    break
        for number in range(numbers.whole(0, 2) if bare else numbers.whole(2, 12)):
            self._place_thing(self.numbers(f"thing {number}"))
        if not numbers.whole(0, 2):
            self._stray(self.numbers("stray"))

    def numbers(self, purpose: str) -> Numbers:
        """Random numbers of a purpose of this room."""
        return Numbers(self._draws, purpose)

    def _add(self, solid: Solid, loss: Loss = _KEPT) -> None:
        self.solids.append(solid)
        self.losses.append(loss)

    def _loss(self, numbers: Numbers) -> Loss:
        """Of a thing: three of ten are dark or shiny, and as many lose a little."""
        kind = numbers.whole(0, 9)
        level = numbers.between(-0.5, 2.2) if kind < 3 else numbers.between(-2.6, -1.2) if kind < 6 else -9.0
        return level, numbers.between(0.0, 3.0), numbers.between(0.08, 0.6)

    def _clothes(self, numbers: Numbers) -> list[Loss]:
        """Losses of somebody's parts: all clothes, trousers, hair and shoes are dark at times."""
        names, found = PART_CLASSES.names, [_KEPT] * len(PART_CLASSES.names)
        some = (
            (names, 0.1, -2.6, -0.8),
            (_TROUSERS, 0.15, -1.5, 0.3),
            (_HAIR, 0.3, -1.0, 1.6),
            (_SHOES, 0.15, -0.5, 2.0),
        )
        for group, chance, low, high in some:
            dark, loss = numbers.between(0, 1) < chance, (numbers.between(low, high), 1.0, numbers.between(0.08, 0.4))
            found = [loss if dark and name in group else old for name, old in zip(names, found, strict=True)]
        return found

    def _build_walls(self, numbers: Numbers) -> list[_Wall]:
        """Floor, ceiling and three walls, with what hangs on them."""
        ceiling = max(numbers.between(2.2, 3.2), self.height_m + 0.2)
        for _ in range(30):
            yaw = numbers.between(-0.7, 0.7)
            far = numbers.between(2.0, 7.0) if numbers.whole(0, 9) else 12.0
            walls = []
            for turn, distance in ((0, far), (0.5, numbers.between(0.8, 4.5)), (-0.5, numbers.between(0.8, 4.5))):
                angle = yaw + turn * math.pi
                walls.append(_Wall(np.array([math.sin(angle), 0.0, -math.cos(angle)]), distance))
            ahead = [min(wall.free(step * self._half) for wall in walls) for step in (-0.9, -0.45, 0.0, 0.45, 0.9)]
            if ahead[2] > 2.2 and sorted(ahead)[1] > 1.7 and min(ahead) > 0.8:
                break
        reach = 14.0
        for at, loss in ((-0.01, self._floor_loss(numbers)), (ceiling + 0.01, _KEPT)):
            if at < 0 or numbers.whole(0, 4):
                self._add(cuboid((2 * reach, 0.02, 2 * reach), (0, at, 0)), loss)
        for number, wall in enumerate(walls):
            self._build_wall(wall, ceiling, self.numbers(f"wall {number}"))
        return walls

    def _floor_loss(self, numbers: Numbers) -> Loss:
        """Of a floor: most are polished and return less, the more they are seen edge-on."""
        if numbers.whole(0, 2) == 0:
            return _KEPT
        return numbers.between(-4.0, -1.6), numbers.between(0.0, 8.0), numbers.between(0.06, 0.4)

    def _build_wall(self, wall: _Wall, ceiling: float, numbers: Numbers) -> None:
        """A wall with at most one window or door and up to three things on it."""
        pieces, wide = [], 14.0
        middle = numbers.between(-1.5, 1.5)
        kind = numbers.whole(0, 3)
        if kind == 0:  # a window, through which nothing is measured
            half, low, high = (
                numbers.between(0.4, 1.2),
                numbers.between(0.5, 1.1),
                ceiling - numbers.between(0.1, 0.5),
            )
            pieces += [
                cuboid((wide, low, 0.1), (middle, low / 2, 0.05)),
                cuboid((wide, ceiling - high, 0.1), (middle, (ceiling + high) / 2, 0.05)),
            ]
            pieces += [
                cuboid((wide / 2, high - low, 0.1), (middle + s * (half + wide / 4), (high + low) / 2, 0.05))
                for s in (-1, 1)
            ]
            pieces += [
                cuboid((0.06, high - low, 0.06), (middle + s * half, (high + low) / 2, 0.02)) for s in (-1, 0, 1)
            ]
        else:
            pieces.append(cuboid((wide, ceiling, 0.1), (0, ceiling / 2, 0.05)))
        if kind == 1:
            pieces.append(cuboid((0.9, 2.0, 0.05), (middle, 1.0, numbers.between(-0.02, 0.02))))
            pieces.append(cuboid((0.12, 0.03, 0.08), (middle + 0.35, 1.02, -0.05)))
        if not numbers.whole(0, 2):  # curtains
            low = max(0.02, numbers.between(-0.6, ceiling - 1.2))
            for side in (-1, 1)[: numbers.whole(1, 2)]:
                width, folds = numbers.between(0.3, 1.5), numbers.between(3, 9)
                cloth = sheet(width, ceiling - low - 0.05, numbers.between(0.02, 0.1), folds * width, numbers)
                pieces.append(cloth.moved((middle + side * (0.3 + width / 2), low, -numbers.between(0.05, 0.2))))
        if not numbers.whole(0, 3):  # a radiator
            long, low = numbers.between(0.5, 1.4), numbers.between(0.08, 0.2)
            ribs = [
                cuboid((0.04, 0.55, 0.08), (middle + n * 0.06 - long / 2, low + 0.28, -0.07))
                for n in range(int(long / 0.06))
            ]
            pieces += [*ribs, cuboid((long, 0.04, 0.1), (middle, low + 0.56, -0.07))]
        self._add(_Pose(_about(wall.angle_rad), wall.normal * wall.offset).of(together(pieces)))
        for _ in range(numbers.whole(0, 4)):  # pictures, screens, boxes, shelves and coats on hooks
            size = numbers.between(0.2, 1.2), numbers.between(0.2, 0.9), numbers.between(0.02, 0.3)
            at = numbers.between(-2.5, 2.5), numbers.between(1.0, max(1.1, ceiling - 0.3))
            pieces = [cuboid(size, (at[0], at[1], -size[2] / 2))]
            if size[2] > 0.25:
                pieces = [coat(numbers, min(at[1] + 0.6, ceiling - 0.2)).moved((at[0], 0, -0.14))]
            elif size[2] > 0.15:
                board = clutter(numbers, size[0], size[2], at[1] + size[1] / 2, 3)
                pieces += [each.moved((at[0], 0, -size[2] / 2)) for each in board]
            placed = _Pose(_about(wall.angle_rad), wall.normal * wall.offset).of(together(pieces))
            self._add(placed, self._loss(numbers))

    def _spot(self, numbers: Numbers, radius: float, away: float) -> tuple[float, float] | None:
        """A free place in the room that the camera sees, at about that distance, or None."""
        for _ in range(12):
            x = numbers.between(-1.0, 1.0) * (self._half * away + 0.15)
            inside = all(wall.normal[0] * x - wall.normal[2] * away < wall.offset - 0.3 * radius for wall in self.walls)
            if inside and all(math.hypot(x - a, away - b) > 0.8 * (radius + taken) for a, b, taken in self._taken):
                return x, away
            away = numbers.between(_NEAREST_M + radius * 0.5, max(away, 2.0))
        return None

    def _stand(self, solid: Solid, turn: Floats, x: float, away: float, low: float = 0.0) -> tuple[_Pose, Solid, float]:
        """Pose of a solid that stands with its middle at a place; the solid there, and its radius."""
        turned = solid.vertices @ turn.T
        least, most = turned.min(axis=0), turned.max(axis=0)
        middle = (least + most) / 2
        pose = _Pose(turn, np.array([x - middle[0], low - least[1], -away - middle[2]]))
        return pose, pose.of(solid), 0.45 * math.hypot(most[0] - least[0], most[2] - least[2])

    def _off_walls(self, pose: _Pose, vertices: Floats, gap: float, only: _Wall | None = None) -> _Pose:
        """The pose moved out of all walls, or against one of them, up to a gap."""
        by = pose.by_m.copy()
        for _ in range(2):
            for wall in self.walls:
                out = wall.depth_of(vertices + (by - pose.by_m)) - (wall.offset - gap)
                if out > 0 or wall is only:
                    by -= out * wall.normal
        return _Pose(pose.turn, by)

    def _wall_behind(self, x: float, away: float) -> _Wall | None:
        """The wall that the camera sees behind a place."""
        behind = min(self.walls, key=lambda wall: wall.free(x / away), default=None)
        return behind if behind is not None and behind.free(x / away) < 7.0 else None

    def _place_person(self, person: Person, numbers: Numbers) -> bool:
        """Somebody stands free, close to a wall, beside another, on a seat or a bed, or behind something.

        Whether a place was found.
        """
        surface = Solid(person.mesh.vertices, person.mesh.faces)
        how, far = numbers.between(0, 1), numbers.between(0, 1)
        sits, lies = person.pose.startswith(_SIT), person.pose.startswith(_LIE)
        low = numbers.between(0.3, 0.6) if lies and how < 0.6 else 0.0
        nearest, farthest = (0.5, 1.2) if far < 0.15 else (3.0, _FARTHEST_M) if far > 0.5 else (1.0, 3.5)
        spot = self._spot(numbers, 0.4, numbers.between(nearest, farthest))
        if self.persons and how > 0.6:  # close to another
            x, away, radius = self._taken[numbers.whole(0, len(self.persons) - 1)]
            turn, apart = numbers.between(-math.pi, math.pi), radius * numbers.between(0.9, 1.6)
            spot = x + apart * math.sin(turn), max(away + apart * math.cos(turn), _NEAREST_M)
        if spot is None:
            return False
        turn_m = _about(numbers.between(-math.pi, math.pi))
        wall = self._wall_behind(*spot) if how < 0.45 and not lies else None
        if wall is not None and how < 0.1 and not sits:  # leaning at it
            back = _about(wall.angle_rad)
            turn_m = back @ _about(numbers.between(0.05, 0.2), 0) @ back.T @ turn_m
        pose, there, radius = self._stand(surface, turn_m, *spot, low)
        pose = self._off_walls(pose, there.vertices, numbers.between(0.0, 0.25) if wall else 0.02, wall)
        there = pose.of(surface)
        middle = (there.vertices.min(axis=0) + there.vertices.max(axis=0)) / 2
        if -middle[2] < 0.45 or abs(middle[0]) > 0.3 - 1.1 * self._half * middle[2]:
            return False
        if np.min(np.linalg.norm(there.vertices - (0.0, self.height_m, 0.0), axis=1)) < 0.4:
            return False
        self._taken.append((float(middle[0]), float(-middle[2]), radius))
        self.persons.append((person, pose))
        self.worn.append(self._clothes(numbers))
        if sits and numbers.whole(0, 9):
            self._seat_below(person, there, numbers)
        elif lies and low:
            self._bed_below(there, low, numbers)
        elif how > 0.8 and numbers.whole(0, 2):  # behind something
            self._before(middle, numbers)
        if not lies and numbers.between(0, 1) < 0.35:
            self._hold(person, there, numbers)
        return True

    def _hold(self, person: Person, there: Solid, numbers: Numbers) -> None:
        """Somebody holds or wears a thing: a box, a bag, a cloth, a rucksack, a load on a shoulder."""

        def at(*names: str) -> Floats:
            own = person.among(names)
            return there.vertices[own].mean(axis=0) if own.any() else np.full(3, np.nan)

        right, left, chest, back = at("Rt. Dactylion"), at("Lt. Dactylion"), at("Substernale"), at("10th Rib Midspine")
        front = chest - back
        front /= np.linalg.norm(front)
        angle, kind = math.atan2(-front[0], -front[2]), numbers.whole(0, 5)
        apart = right - left
        if kind < 3 and 0.1 < np.linalg.norm(apart) < 0.7 and abs(apart[1]) < 0.3:  # with both hands
            middle, wide = (right + left) / 2, float(np.linalg.norm(apart))
            angle = math.atan2(apart[2], apart[0]) * -1
            if kind == 0:
                thing = sheet(
                    wide + numbers.between(0, 0.2), numbers.between(0.3, 1.0), 0.03, numbers.between(1, 4), numbers
                )
                thing = bent(thing, numbers, 0.04).moved((0, -float(thing.vertices[:, 1].max()), 0))
            else:
                size = wide, numbers.between(0.1, 0.5), numbers.between(0.15, 0.45)
                thing = (cuboid if kind == 1 else slab)(size, (0, 0, 0))
                thing = bent(thing, numbers, 0.06) if kind == 2 else thing
                middle = middle + front * numbers.between(0.0, 0.1)
        elif kind < 3:  # in one hand
            middle = right if numbers.whole(0, 1) else left
            thing = (bag, coat, FURNISHINGS["box"])[kind](*((numbers, 0.0) if kind == 1 else (numbers,)))
            if kind == 2:
                thing = Solid(thing.vertices * 0.5, thing.faces)
            thing = thing.moved((0, -float(thing.vertices[:, 1].max()), 0))
            angle += numbers.between(-1, 1)
        elif kind == 3:  # a rucksack
            size = numbers.between(0.26, 0.36), numbers.between(0.35, 0.55), numbers.between(0.14, 0.28)
            thing = bent(ball(size, (0, 0, 0)) if numbers.whole(0, 1) else slab(size, (0, 0, 0)), numbers, 0.05)
            middle = back - front * (size[2] / 2) + (at("Cervicale") - back) * numbers.between(0.1, 0.5)
        elif kind == 4:  # on a shoulder
            size = numbers.between(0.12, 0.4), numbers.between(0.1, 0.3), numbers.between(0.3, 1.4)
            thing = bent(slab(size, (0, size[1] / 2 + 0.02, 0)), numbers, 0.04)
            middle = at(("Rt. Acromion", "Lt. Acromion")[numbers.whole(0, 1)])
        else:  # before the chest
            size = numbers.between(0.2, 0.5), numbers.between(0.2, 0.5), numbers.between(0.1, 0.4)
            thing = bent(slab(size, (0, 0, 0)), numbers, numbers.between(0.0, 0.08))
            middle = chest + front * (size[2] / 2 + numbers.between(-0.05, 0.05))
        if np.isfinite(middle).all():
            self._add(_Pose(_about(angle), middle).of(thing), self._loss(numbers))

    def _seat_below(self, person: Person, there: Solid, numbers: Numbers) -> None:
        hips, knees = person.among(_HIPS), person.among(_KNEES)
        if not hips.any() or not knees.any():
            return
        at, front = there.vertices[hips], there.vertices[knees].mean(axis=0)
        seat_m = float(np.quantile(at[:, 1], 0.02))
        if seat_m < 0.15:
            return
        names = [name for name in SEATS if name in self._kinds] or ["chair"]
        seat = SEATS[names[numbers.whole(0, len(names) - 1)]](numbers, seat_m)
        middle = at.mean(axis=0)
        way = front - middle
        turn = _about(math.atan2(-way[0], -way[2]))
        self._add(_Pose(turn, np.array([middle[0], 0.0, middle[2]])).of(seat), self._loss(numbers))

    def _bed_below(self, there: Solid, low: float, numbers: Numbers) -> None:
        least, most = there.vertices.min(axis=0), there.vertices.max(axis=0)
        flat = there.vertices[:, [0, 2]] - there.vertices[:, [0, 2]].mean(axis=0)
        way = np.linalg.eigh(flat.T @ flat)[1][:, 1]
        made = bed(numbers)
        top = float(np.quantile(made.vertices[:, 1], 0.6))
        made = Solid(made.vertices * (1.0, low / max(top, 0.1), 1.0), made.faces)
        middle = (least + most) / 2
        turn = _about(math.atan2(-way[1], way[0]))
        self._add(_Pose(turn, np.array([middle[0], -0.02, middle[2]])).of(made))

    def _before(self, middle: Floats, numbers: Numbers) -> None:
        """Something between a person and the camera."""
        thing = self._thing(numbers)
        share = numbers.between(0.45, 0.95)
        turn = _about(numbers.between(-math.pi, math.pi))
        _, stood, radius = self._stand(thing, turn, middle[0] * share, -middle[2] * share)
        gap = -middle[2] * (1 - share)
        if gap > 0.15 and -middle[2] * share - radius > 0.4:
            self._add(stood, self._loss(numbers))

    def _thing(self, numbers: Numbers) -> Solid:
        """A thing; a third of them are seats."""
        seats = [kind for kind in self._kinds if kind in SEATS]
        kinds = seats if seats and not numbers.whole(0, 3) else self._kinds
        return FURNISHINGS[kinds[numbers.whole(0, len(kinds) - 1)]](numbers)

    def _place_thing(self, numbers: Numbers) -> None:
        """A thing stands against a wall, free, or touches somebody; few lie on their side."""
        thing, how = self._thing(numbers), numbers.between(0, 1)
        radius = self._stand(thing, np.eye(3), 0.0, 2.0)[2]
        if how > 0.85 and self.persons:
            x, away, taken = self._taken[numbers.whole(0, len(self.persons) - 1)]
            turn, apart = numbers.between(-1.3, 1.3), (radius + taken) * numbers.between(0.6, 1.0)
            spot: tuple[float, float] | None = (x + apart * math.sin(turn), away + apart * math.cos(turn))
        else:
            spot = self._spot(numbers, radius, numbers.between(1.0, _FARTHEST_M))
        if spot is None:
            return
        wall = self._wall_behind(spot[0], max(spot[1], 0.1)) if how < 0.5 else None
        turned = _about(wall.angle_rad if wall else numbers.between(-math.pi, math.pi))
        if not numbers.whole(0, 24):
            turned = turned @ _about(math.pi / 2, 2 * numbers.whole(0, 1))
        pose, there, _ = self._stand(thing, turned, *spot)
        pose = self._off_walls(pose, there.vertices, numbers.between(0.0, 0.1), wall)
        there = pose.of(thing)
        least, most = there.vertices.min(axis=0), there.vertices.max(axis=0)
        near = -most[2]
        if (near < 0.45 and least[0] < 0.6 and most[0] > -0.6) or most[0] - least[0] > 1.6 * self._half * max(
            near, 0.1
        ):
            return
        self._taken.append((float(least[0] + most[0]) / 2, float(-least[2] - most[2]) / 2, radius))
        self._add(there, self._loss(numbers))

    def _stray(self, numbers: Numbers) -> None:
        """Small surfaces in the air, as of reflections."""
        for _ in range(numbers.whole(1, 8)):
            away, size = numbers.between(0.6, _FARTHEST_M), numbers.between(0.02, 0.15)
            x, y = numbers.between(-1, 1) * self._half * away, numbers.between(0.0, 2.5)
            piece = bent(slab((size, size * numbers.between(0.3, 2), 0.01), (0, 0, 0), 4), numbers, 0.03, 0.1)
            self._add(_Pose(_about(numbers.between(-1, 1)), np.array([x, y, -away])).of(piece), self._loss(numbers))

    def render(self, split: Split = "train") -> Render:
        """What the rig's devices see; the plane "person" counts people from 1, 0 elsewhere.

        Where a surface is lost, no range is stored and the label is 255.
        """
        bodies = [pose.of(Solid(person.mesh.vertices, person.mesh.faces)) for person, pose in self.persons]
        pieces = [*bodies, *self.solids]
        whole = together(pieces)
        ends = np.cumsum([0, *(len(body.faces) for body in bodies)])
        camera = PlacedCamera(self.rig.camera, axes_at(0, self.pitch_deg), np.array([0.0, self.height_m, 0.0]))
        renderer, step_m = RasterRenderer(whole), self.rig.range_step_m
        seen = renderer.render(camera)
        farthest = 65535.0 * step_m
        shape, face, range_m = seen.range.shape, seen.face.ravel(), seen.range.ravel()
        seen_at = (face >= 0) & (range_m < farthest)
        # Of each face, the row of its losses; a body's depend on the label.
        first = len(PART_CLASSES.names) * len(bodies)
        count = [len(piece.faces) for piece in pieces]
        rows_of = np.concatenate([np.repeat(np.arange(len(self.solids)) + first, count[len(bodies) :])]).astype(
            np.int32
        )
        labels, people = np.where(seen_at, np.uint8(UNLABELLED), np.uint8(BACKGROUND)), np.zeros(face.shape, np.uint8)
        row = np.full(face.shape, -1, np.int32)
        solid = np.flatnonzero(seen_at & (face >= ends[-1]))
        row[solid] = rows_of[face[solid] - ends[-1]]
        rays = self.rig.camera.pixel_rays().reshape(-1, 3)
        for number, (person, pose) in enumerate(self.persons):
            own = np.flatnonzero(seen_at & (face >= ends[number]) & (face < ends[number + 1]))
            points = camera.to_body(rays[own] * range_m[own, None])
            found = person.parts.labels_at(person.mesh, face[own] - np.int32(ends[number]), pose.back(points))
            body = found < UNLABELLED
            labels[own] = np.where(body, found, UNLABELLED)
            people[own] = np.where(body, number + 1, 0)
            row[own] = np.where(body, found.astype(np.int32) + len(PART_CLASSES.names) * number, -1)
        normals = whole.normals
        one_of = whole.vertices[whole.faces[:, 0]]
        sight = np.einsum("ij,ij->i", normals, one_of - camera.position)
        cosine_table = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-30)[:, None]
        losses = np.array([*(loss for worn in self.worn for loss in worn), *self.losses]).reshape(-1, 3)
        lost = np.zeros(face.shape, np.bool_)
        _lose(row, face, range_m, rays, camera.axes, camera.position, cosine_table, losses, _lattice(), lost)
        labels[lost], people[lost] = BACKGROUND, 0
        measured = seen_at & ~lost
        facing, lit = [], []
        for one in self.rig.by_projector():
            rotation, offset = one.camera_to_projector()
            place = camera.position - camera.axes.T @ (rotation.T @ offset)
            projector = PlacedCamera(one.projector, rotation @ camera.axes, place)
            towards = sight * np.einsum("ij,ij->i", normals, one_of - place) > 0
            facing.append((towards[face] & measured).reshape(shape))
            view = renderer.render(projector).range
            lit.append(np.where(view < farthest, view, 0))
        return Render(
            self._key,
            np.where(measured, range_m, 0).astype(np.float32).reshape(shape),
            labels.reshape(shape),
            np.concatenate(lit).astype(np.float32),
            np.stack(facing),
            None,
            split,
            {"height_cm": round(100 * self.height_m), "pitch_deg": round(self.pitch_deg), "people": len(self.persons)},
            {"person": people.reshape(shape)},
        )


def _lattice() -> Floats:
    """Values of the random field of losses at its lattice's points, -0.5 to 0.5, [16 ** 3]."""
    return Draws(0, 0, "losses").pixels("lattice", _CELLS**3, np.uint16) / 65535.0 - 0.5


def _lose_loop(
    row: Any,
    face: Any,
    range_m: Any,
    rays: Any,
    axes: Any,
    position: Any,
    normals: Any,
    losses: Any,
    lattice: Any,
    lost: Any,
) -> None:
    """Write whether pixels are lost, by the losses [L, 3] in their `row`, -1 for none.

    The field is a sum of three of the lattice's waves, interpolated linearly; each row sees another piece of it.
    """
    for pixel in range(len(row)):
        if row[pixel] < 0 or losses[row[pixel], 0] + max(losses[row[pixel], 1], 0.0) < -4.0:
            continue
        level, graze, wave = losses[row[pixel], 0], losses[row[pixel], 1], losses[row[pixel], 2]
        a, b, c = rays[pixel, 0], rays[pixel, 1], rays[pixel, 2]
        away, across = range_m[pixel], 0.0
        place = np.empty(3)
        for axis in range(3):
            ray = a * axes[0, axis] + b * axes[1, axis] + c * axes[2, axis]
            across += ray * normals[face[pixel], axis]
            place[axis] = position[axis] + away * ray
        edge = 1.0 - abs(across) / np.sqrt(a * a + b * b + c * c)
        value = 0.0
        for octave in range(3):
            scale = 1.0 / (wave * _WAVES[octave])
            x = place[0] * scale + 5.3 * (row[pixel] + 1) + 1024
            y = place[1] * scale + 3.7 * octave + 1024
            z = place[2] * scale + 1024
            i, j, k = int(x), int(y), int(z)
            u, v, w = x - i, y - j, z - k
            here = 0.0
            for corner in range(8):
                di, dj, dk = corner & 1, corner >> 1 & 1, corner >> 2
                share = (u if di else 1 - u) * (v if dj else 1 - v) * (w if dk else 1 - w)
                at = ((i + di) % _CELLS * _CELLS + (j + dj) % _CELLS) * _CELLS + (k + dk) % _CELLS
                here += share * lattice[at]
            value += _WEIGHTS[octave] * here
        lost[pixel] = value < level + graze * edge**4


_lose: Any = compiled(_lose_loop, "rooms")
