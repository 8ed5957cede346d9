"""Rooms with people, drawn by their keys: what stands where, and what a rig's camera and projectors see of it.

A room's frame is y up, the floor at y = 0; the camera stands at x = z = 0 and looks towards -z. Everything is drawn
from sequences `n` of raw random words (`Numbers`), whose bits NumPy guarantees, so a sample has the same bytes however
it is packed. What is dark or shiny returns too little light: the camera measures nothing in patches of it, while it
still hides what is behind.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies import RigidMotion, about
from bodyseg_data.core import Draws
from bodyseg_data.labels import BACKGROUND, PART_CLASSES, UNLABELLED
from bodyseg_data.machine import compiled
from bodyseg_data.meshes import Mesh, Partition, Solid, cuboid, together
from bodyseg_data.packing import Numbers
from bodyseg_data.rendering import RasterRenderer
from bodyseg_data.renders import Render
from bodyseg_data.rigs import PlacedCamera, Rig, axes_at
from bodyseg_data.rooms.furnishings import FURNISHINGS, SEATS, ball, bent, both, clutter, coat, sheet, slab
from bodyseg_data.samples import HELD, Split

Floats = NDArray[np.float64]

_PARTS: Final = len(PART_CLASSES.names)
_EMPTY: Final = 0.09  # share of rooms with walls that have nobody in them
_BARE: Final = 0.12  # share of rooms without walls and floor
_COUNTS: Final = (1,) * 11 + (2,) * 6 + (3,) * 4  # number of people in the others: one of these is drawn
_NEAREST_M: Final = 0.7
_FARTHEST_M: Final = 6.0
_REACH_M: Final = 14.0  # of floors and walls
_SIT: Final = "sitting", "on_a_chair"
_LIE: Final = "lying", "on_the_back", "on_the_front", "on_the_side"
_HIPS: Final = ("Rt. PSIS", "Lt. PSIS", "Rt. Trochanterion", "Lt. Trochanterion")
_KNEES: Final = ("Rt. Femoral Lateral Epicn", "Lt. Femoral Lateral Epicn")
_TROUSERS: Final = (*_HIPS, *_KNEES, "Rt. Knee Crease", "Lt. Knee Crease", "Rt. ASIS", "Lt. ASIS")
_SHOES: Final = ("Rt. Digit II", "Lt. Digit II", "Rt. Lateral Malleolus", "Lt. Lateral Malleolus")

Loss = tuple[float, float, float]
"""What of a surface returns no light: the level below which a random field over space must lie there, in its standard
deviations; what is added to it where the surface is seen edge-on; the field's longest wave, metres.
"""
_KEPT: Final[Loss] = (-9.0, 0.0, 1.0)
_DARK: Final = (  # parts of somebody: names, how often they are dark, and from which level to which
    (PART_CLASSES.names, 0.1, -2.6, -0.8),
    (_TROUSERS, 0.15, -1.5, 0.3),
    (("Nuchale",), 0.3, -1.0, 1.6),
    (_SHOES, 0.15, -0.5, 2.0),
)
_CELLS: Final = 16  # of the field's lattice, along each axis
_LATTICE: Final[Floats] = Draws(0, 0, "losses").pixels("lattice", _CELLS**3, np.uint16) / 65535.0 - 0.5
_WAVES: Final = (1.0, 0.37, 0.12)  # as shares of the longest
_WEIGHTS: Final = (5.2, 3.1, 2.1)  # of the waves: their sum has a standard deviation of about 1


@dataclass(frozen=True)
class RoomPerson:
    """Somebody who may stand in a room: a body with its labels. pose: in words."""

    mesh: Mesh = field(repr=False)
    parts: Partition = field(repr=False)
    pose: str

    def middle(self, vertices: Floats, *names: str) -> Floats:
        """Middle of the parts of these names, [3], NaN without them; vertices: where the mesh's are, [V, 3]."""
        own = np.isin(self.parts.labels, [PART_CLASSES.names.index(name) for name in names])
        return vertices[own].mean(axis=0) if own.any() else np.full(3, np.nan)


def _facing(way: Floats) -> Floats:
    """The rotation about y that turns the front of a thing, -z, to `way`."""
    return about(math.atan2(-way[0], -way[2]))


@dataclass(frozen=True)
class _Wall:
    """A wall: points with normal . p = offset; the room is where that is less."""

    normal: Floats
    offset: float

    def free(self, slope: float) -> float:
        """Depth at which a ray with this slope sideways meets the wall, inf if it does not."""
        towards = self.normal[0] * slope - self.normal[2]
        return self.offset / towards if towards > 1e-6 else math.inf

    @property
    def pose(self) -> RigidMotion:
        """Pose of a thing with its back to the middle of the wall."""
        return RigidMotion(_facing(-self.normal), self.normal * self.offset)


class Room:
    """One room: walls, things and people. kinds: names of `FURNISHINGS`; coats hang where there are coat stands. own:
    names and surfaces of further things, of which one to three are in each room.
    """

    def __init__(
        self,
        key: str,
        rig: Rig,
        people: Sequence[RoomPerson],
        kinds: Sequence[str],
        seed: int = 0,
        own: Sequence[tuple[str, Solid]] = (),
    ) -> None:
        self._draws, self._key, self._kinds, self.rig = Draws(seed, 0, key), key, kinds, rig
        self.solids: list[tuple[Solid, Loss]] = []
        self.things: dict[int, str] = {}
        """Place among `solids` -> kind of the thing; the room itself is not among them."""
        self.persons: list[tuple[RoomPerson, RigidMotion, list[Loss]]] = []
        self.walls: list[_Wall] = []
        self._taken: list[tuple[float, float, float]] = []  # x, distance and radius: of people, then of things
        n = Numbers(self._draws, "room")
        self.height_m = n.between(0.4, 2.2)
        self._eye = np.array([0.0, self.height_m, 0.0])
        low, high = max(-30.0, -20.0 * self.height_m), 20.0 - 12.0 * self.height_m
        self.pitch_deg = n.between(low, max(high, low + 5))
        self._axes, sides = axes_at(0, self.pitch_deg, rig.camera.roll_deg), (rig.camera.columns, rig.camera.rows)
        self._half = float(np.abs(self._axes[:2, 0]) @ sides) / 2 / rig.camera.focal_px
        bare, empty = n.between(0, 1) < _BARE, n.between(0, 1) < _EMPTY
        if not bare:
            self._build_walls(n)
        for number in range(0 if not people or (empty and not bare) else _COUNTS[n.whole(0, len(_COUNTS) - 1)]):
            drawn = Numbers(self._draws, f"person {number}")
            person = people[drawn.whole(0, len(people) - 1)]
            any(self._place_person(person, drawn) for _ in range(6))
        for number in range(Numbers(self._draws, "own things").whole(1, 3) if own else 0):
            drawn = Numbers(self._draws, f"own thing {number}")
            thing = own[drawn.whole(0, len(own) - 1)]
            (self._place_thing if drawn.whole(0, 3) else self._place_before)(drawn, thing)
        for number in range(n.whole(0, 2) if bare else n.whole(2, 12)):
            self._place_thing(Numbers(self._draws, f"thing {number}"))
        for _ in range(0 if n.whole(0, 2) else n.whole(1, 8)):  # small surfaces in the air, as of reflections
            away, size = n.between(0.6, _FARTHEST_M), n.between(0.02, 0.15)
            at = np.array([n.between(-1, 1) * self._half * away, n.between(0.0, 2.5), -away])
            piece = bent(n, slab((size, size * n.between(0.3, 2), 0.01), (0, 0, 0), 2), 0.03, 0.1)
            self._add(RigidMotion(about(n.between(-1, 1)), at).of(piece), n)

    def _add(self, solid: Solid, n: Numbers, kind_of_thing: str = "") -> None:
        """Add a thing: three of ten are dark or shiny, and as many lose a little."""
        if kind_of_thing:
            self.things[len(self.solids)] = kind_of_thing
        kind = n.whole(0, 9)
        level = n.between(-0.5, 2.2) if kind < 3 else n.between(-2.6, -1.2) if kind < 6 else -9.0
        self.solids.append((solid, (level, n.between(0.0, 3.0), n.between(0.08, 0.6))))

    def _build_walls(self, n: Numbers) -> None:
        """Floor, ceiling and three walls, with what hangs on them. Most floors are polished."""
        ceiling = max(n.between(2.2, 3.2), self.height_m + 0.2)
        for _ in range(30):
            yaw, far = n.between(-0.7, 0.7), n.between(2.0, 7.0) if n.whole(0, 9) else 12.0
            self.walls = []
            for turn, distance in ((0, far), (0.5, n.between(0.8, 4.5)), (-0.5, n.between(0.8, 4.5))):
                angle = yaw + turn * math.pi
                self.walls.append(_Wall(np.array([math.sin(angle), 0.0, -math.cos(angle)]), distance))
            ahead = [min(wall.free(step * self._half) for wall in self.walls) for step in (-0.9, -0.45, 0.0, 0.45, 0.9)]
            if ahead[2] > 2.2 and sorted(ahead)[1] > 1.7 and min(ahead) > 0.8:
                break
        loss = n.between(-4.0, -1.6), n.between(0.0, 8.0), n.between(0.06, 0.4)
        floor = cuboid((2 * _REACH_M, 0.02, 2 * _REACH_M), (0, -0.01, 0))
        self.solids.append((floor, loss if n.whole(0, 2) else _KEPT))
        if n.whole(0, 4):
            self.solids.append((floor.moved((0, ceiling + 0.02, 0)), _KEPT))
        for number, wall in enumerate(self.walls):
            self._build_wall(wall, ceiling, Numbers(self._draws, f"wall {number}"))

    def _build_wall(self, wall: _Wall, ceiling: float, n: Numbers) -> None:
        """A wall with at most one window or door, curtains, a radiator, and up to four things on it."""
        wide, middle, kind = _REACH_M, n.between(-1.5, 1.5), n.whole(0, 3)
        pieces, pose = [cuboid((wide, ceiling, 0.1), (0, ceiling / 2, 0.05))], wall.pose
        if kind == 0:  # a window, through which nothing is measured
            half, low, high = n.between(0.4, 1.2), n.between(0.5, 1.1), ceiling - n.between(0.1, 0.5)
            bands = (low, low / 2), (ceiling - high, (ceiling + high) / 2)
            window = [cuboid((wide, tall, 0.1), (0, level, 0.05)) for tall, level in bands]
            window += both(cuboid((wide / 2, high - low, 0.1), (half + wide / 4, (high + low) / 2, 0.05)))
            window += [cuboid((0.06, high - low, 0.06), (bar, (high + low) / 2, 0.02)) for bar in (-half, 0, half)]
            pieces = [together(window).moved((middle, 0, 0))]
        elif kind == 1:
            pieces.append(cuboid((0.9, 2.0, 0.1), (middle, 1.0, n.between(0.02, 0.06))))
            pieces.append(cuboid((0.12, 0.03, 0.1), (middle + 0.35, 1.02, -0.05)))
        if not n.whole(0, 2):  # curtains
            low = max(0.02, n.between(-0.6, ceiling - 1.2))
            for side in (-1, 1)[: n.whole(1, 2)]:
                width, folds = n.between(0.3, 1.5), n.between(3, 9)
                cloth = sheet(n, width, ceiling - low - 0.05, n.between(0.02, 0.1), folds * width)
                pieces.append(cloth.moved((middle + side * (0.3 + width / 2), low, -n.between(0.05, 0.2))))
        if not n.whole(0, 3):  # a radiator
            ribs, low = n.whole(8, 24), n.between(0.08, 0.2)
            pieces += [cuboid((0.04, 0.55, 0.08), (middle + 0.06 * rib, low + 0.28, -0.07)) for rib in range(ribs)]
            pieces.append(cuboid((0.06 * ribs, 0.04, 0.1), (middle + 0.03 * ribs, low + 0.56, -0.07)))
        self.solids.append((pose.of(together(pieces)), _KEPT))
        for _ in range(n.whole(0, 4)):  # pictures, screens, boxes, shelves and coats on hooks
            size = n.between(0.2, 1.2), n.between(0.2, 0.9), n.between(0.02, 0.3)
            x, y = n.between(-2.5, 2.5), n.between(1.0, max(1.1, ceiling - 0.3))
            pieces = [cuboid(size, (0, y, 0))]
            if size[2] > 0.25 and "coat_stand" in self._kinds:
                pieces = [coat(n, min(y + 0.6, ceiling - 0.2))]
            elif size[2] > 0.15:
                pieces += clutter(n, size[0], size[2] / 2, y + size[1] / 2, 3)
            self._add(pose.of(together(pieces).moved((x, 0, -size[2] / 2))), n)

    def _wall_behind(self, x: float, away: float) -> _Wall | None:
        """The wall that the camera sees behind a place."""
        behind = min(self.walls, key=lambda wall: wall.free(x / away), default=None)
        return behind if behind is not None and behind.free(x / away) < 7.0 else None

    def _spot(self, n: Numbers, radius: float, away: float) -> tuple[float, float] | None:
        """A free place in the room that the camera sees, x and distance, at about that distance if there is one."""
        for _ in range(12):
            x = n.between(-1.0, 1.0) * (self._half * away + 0.15)
            inside = all(wall.normal[0] * x - wall.normal[2] * away < wall.offset - 0.3 * radius for wall in self.walls)
            if inside and all(math.hypot(x - a, away - b) > 0.8 * (radius + taken) for a, b, taken in self._taken):
                return x, away
            away = n.between(_NEAREST_M + radius * 0.5, max(away, 2.0))
        return None

    def _beside(self, n: Numbers, radius: float, most_rad: float) -> tuple[float, float]:
        """A place that touches a person, or nearly, at most `most_rad` off the direction away from the camera."""
        x, away, taken = self._taken[n.whole(0, len(self.persons) - 1)]
        turn, apart = n.between(-most_rad, most_rad), (radius + taken) * n.between(0.5, 0.9)
        return x + apart * math.sin(turn), max(away + apart * math.cos(turn), _NEAREST_M)

    def _stand(
        self, solid: Solid, turn: Floats, spot: tuple[float, float], low: float, gap: float, against: _Wall | None
    ) -> tuple[RigidMotion, Floats, Floats]:
        """Pose of a solid at a spot, `gap` from the wall `against`, at least that from others; its extreme corners."""
        turned = solid.vertices @ turn.T
        least, most = turned.min(axis=0), turned.max(axis=0)
        by = np.array([spot[0], low, -spot[1]]) - ((least[0] + most[0]) / 2, least[1], (least[2] + most[2]) / 2)
        for wall in self.walls * 2:
            out = float((turned @ wall.normal).max() + by @ wall.normal) - (wall.offset - gap)
            if out > 0 or wall is against:
                by = by - out * wall.normal
        return RigidMotion(turn, by), least + by, most + by

    def _place_person(self, person: RoomPerson, n: Numbers) -> bool:
        """Place a person free, at a wall, beside another, on a seat or a bed, or behind something; False: no room."""
        surface = Solid(person.mesh.vertices, person.mesh.faces)
        how, far = n.between(0, 1), n.between(0, 1)
        sits, lies = person.pose.startswith(_SIT), person.pose.startswith(_LIE)
        low = n.between(0.3, 0.6) if lies and how < 0.6 and "bed" in self._kinds else 0.0
        nearest, farthest = (0.5, 1.2) if far < 0.15 else (3.0, _FARTHEST_M) if far > 0.5 else (1.0, 3.5)
        spot = self._spot(n, 0.4, n.between(nearest, farthest))
        if self.persons and how > 0.6:
            spot = self._beside(n, 0.4, math.pi)
        if spot is None:
            return False
        turn, gap = about(n.between(-math.pi, math.pi)), n.between(0.0, 0.25)
        wall = self._wall_behind(*spot) if how < 0.45 and not lies else None
        if wall is not None and how < 0.1 and not sits:  # leaning at it
            back = wall.pose.turn
            turn = back @ about(n.between(0.05, 0.2), 0) @ back.T @ turn
        pose, least, most = self._stand(surface, turn, spot, low, gap if wall else 0.02, wall)
        vertices, middle = pose.of(surface).vertices, (least + most) / 2
        near = np.min(np.linalg.norm(vertices - self._eye, axis=1))
        if -middle[2] < 0.45 or abs(middle[0]) > 0.3 - 1.1 * self._half * middle[2] or near < 0.4:
            return False
        self._taken.append((float(middle[0]), float(-middle[2]), 0.45 * math.hypot(*(most - least)[::2])))
        self.persons.append((person, pose, self._clothes(n)))
        if low or (sits and n.whole(0, 9)):
            self._support(person, vertices, low, n)
        elif how > 0.8 and n.whole(0, 2):  # behind something
            share = n.between(0.45, 0.95)
            turn, (name, thing) = about(n.between(-math.pi, math.pi)), self._thing(n)
            before, _, most = self._stand(thing, turn, (middle[0] * share, -middle[2] * share), 0.0, 0.0, None)
            if -middle[2] * (1 - share) > 0.15 and most[2] < -0.4:
                self._add(before.of(thing), n, name)
        if not lies and n.between(0, 1) < 0.6:
            self._hold(person, vertices, n)
        return True

    def _clothes(self, n: Numbers) -> list[Loss]:
        """Losses of a person's parts."""
        found = [_KEPT] * _PARTS
        for names, often, low, high in _DARK:
            dark, loss = n.between(0, 1) < often, (n.between(low, high), 1.0, n.between(0.08, 0.4))
            for label, name in enumerate(PART_CLASSES.names):
                found[label] = loss if dark and name in names else found[label]
        return found

    def _hold(self, person: RoomPerson, vertices: Floats, n: Numbers) -> None:
        """Add a thing that a person holds or wears: a box, a bag, a cloth, a rucksack, a load on a shoulder."""
        right, left = (person.middle(vertices, name) for name in ("Rt. Dactylion", "Lt. Dactylion"))
        chest, back = (person.middle(vertices, name) for name in ("Substernale", "10th Rib Midspine"))
        front, apart, kind = (chest - back) / np.linalg.norm(chest - back), right - left, n.whole(0, 5)
        turn, wide = _facing(front), float(np.linalg.norm(apart))
        size = n.between(0.15, 0.5), n.between(0.15, 0.5), n.between(0.1, 0.4)
        thing = bent(n, (slab, ball)[n.whole(0, 1)](size, (0, 0, 0)), n.between(0.0, 0.08))
        if kind < 3 and 0.1 < wide < 0.7 and abs(apart[1]) < 0.3:  # with both hands
            at, turn = (right + left) / 2, about(-math.atan2(apart[2], apart[0]))
            if kind:
                thing = Solid(thing.vertices * (wide / size[0], 1, 1), thing.faces)
                at = at + front * n.between(0.0, 0.1)
            else:
                thing = bent(n, sheet(n, wide + n.between(0, 0.2), -n.between(0.3, 1.0), 0.03, n.between(1, 4)), 0.04)
        elif kind < 3:  # in one hand
            at = (left, right)[n.whole(0, 1)]
            if kind < 2 and ("coat_stand", "bag")[kind] in self._kinds:
                thing = FURNISHINGS["bag"](n) if kind else coat(n, 0.0)
            thing = thing.moved((0, -float(thing.vertices[:, 1].max()), 0)).turned(n.between(-1, 1))
        elif kind == 3:  # a rucksack
            at = back - front * (size[2] / 2)
        elif kind == 4:  # on a shoulder
            shoulder = person.middle(vertices, ("Rt. Acromion", "Lt. Acromion")[n.whole(0, 1)])
            at = np.add(shoulder, (0, 0.02 + size[1] / 2, 0))
            thing = Solid(thing.vertices * (1, 1, n.between(1, 3)), thing.faces)
        else:  # before the chest
            at = chest + front * (size[2] / 2 + n.between(-0.05, 0.05))
        if np.isfinite([*at, turn[0, 0]]).all():
            self._add(RigidMotion(turn, at).of(thing), n, HELD)

    def _support(self, person: RoomPerson, vertices: Floats, low: float, n: Numbers) -> None:
        """Add a seat under a person, or for one who lies at height `low`, a bed along him and at times a cover."""
        hips, knees, head = (person.middle(vertices, *names) for names in (_HIPS, _KNEES, ("Nuchale",)))
        if low and np.isfinite(head).all():
            made, (way, _, along) = FURNISHINGS["bed"](n), hips - head
            made = Solid(made.vertices * (1.0, low / float(np.quantile(made.vertices[:, 1], 0.6)), 1.0), made.faces)
            cover = bent(n, slab((n.between(0.5, 1.4), 0.15, 0.9), (n.between(0.0, 0.5), low + 0.2, 0), 16), 0.08)
            made = together([made, cover]) if not n.whole(0, 2) else made
            self._add(RigidMotion(about(math.atan2(-along, way)), hips * (1, 0, 1)).of(made), n, "bed")
        elif not low and hips[1] > 0.27 and np.isfinite(knees).all():
            names = [name for name in SEATS if name in self._kinds]
            if names:
                name = names[n.whole(0, len(names) - 1)]
                seat = SEATS[name](n, float(hips[1]) - 0.12)
                self._add(RigidMotion(_facing(knees - hips), hips * (1, 0, 1)).of(seat), n, name)

    def _thing(self, n: Numbers) -> tuple[str, Solid]:
        seats = [kind for kind in self._kinds if kind in SEATS] * (not n.whole(0, 3))
        name = (seats or self._kinds)[n.whole(0, len(seats or self._kinds) - 1)]
        return name, FURNISHINGS[name](n)

    def _place_before(self, n: Numbers, named: tuple[str, Solid]) -> None:
        """Add a thing that reaches in from the image's border, near the camera, in any pose, as a robot's own arm."""
        (name, thing), edge, beside = named, (-1.0, 1.0)[n.whole(0, 1)], n.between(-1, 1)
        turn = about(n.between(-math.pi, math.pi)) @ about(n.between(-math.pi, math.pi), 0)
        middle = (thing.vertices.min(axis=0) + thing.vertices.max(axis=0)) / 2
        radius = float(np.linalg.norm(thing.vertices - middle, axis=1).max())
        across, down = (edge, beside) if n.whole(0, 1) else (beside, edge)
        camera = self.rig.camera
        ray = np.array([across * (camera.columns / 2 / camera.focal_px), down * camera.rows / 2 / camera.focal_px, 1.0])
        way = ray @ self._axes / np.linalg.norm(ray)
        at = self._eye + way * (radius + n.between(0.25, 0.6))
        if all(math.hypot(at[0] - x, -at[2] - away) > 0.8 * (radius + taken) for x, away, taken in self._taken):
            self._add(RigidMotion(turn, at - turn @ middle).of(thing), n, name)

    def _place_thing(self, n: Numbers, named: tuple[str, Solid] | None = None) -> None:
        """Add a thing against a wall, free, or touching a person; few lie on their side. named: which; else drawn."""
        (name, thing), how = named or self._thing(n), n.between(0, 1)
        radius = 0.45 * math.hypot(*np.ptp(thing.vertices, axis=0)[::2])
        spot = self._spot(n, radius, n.between(1.0, _FARTHEST_M))
        if how > 0.85 and self.persons:
            spot = self._beside(n, radius, 1.3)
        if spot is None:
            return
        wall = self._wall_behind(*spot) if how < 0.5 else None
        turn = wall.pose.turn if wall else about(n.between(-math.pi, math.pi))
        if not n.whole(0, 24):
            turn = turn @ about(math.pi / 2, 2 * n.whole(0, 1))
        pose, least, most = self._stand(thing, turn, spot, 0.0, n.between(0.0, 0.1), wall)
        if most[2] > -0.45 or most[0] - least[0] > -1.6 * self._half * most[2]:
            return  # it would fill the image
        self._taken.append((spot[0], spot[1], radius))
        self._add(pose.of(thing), n, name)

    def render(self, split: Split = "train", with_things: bool = False) -> Render:
        """Render what the rig's devices see; the plane "person" counts people from 1, 0 elsewhere.

        with_things: also a plane "thing", which counts `things`.

        Where a surface is lost, no range is stored and the label is 255.
        """
        bodies = [pose.of(Solid(person.mesh.vertices, person.mesh.faces)) for person, pose, _ in self.persons]
        pieces = [*bodies, *(solid for solid, _ in self.solids)]
        whole, camera = together(pieces), PlacedCamera(self.rig.camera, self._axes, self._eye)
        renderer, farthest = RasterRenderer(whole), 65535.0 * self.rig.range_step_m
        seen = renderer.render(camera)
        face, range_m = np.where(seen.range < farthest, seen.face, np.int32(-1)), seen.range
        labels, people = np.where(face < 0, np.uint8(BACKGROUND), np.uint8(UNLABELLED)), np.zeros(face.shape, np.uint8)
        (across, down), first = self.rig.camera.slopes, 0
        for number, (person, pose, _) in enumerate(self.persons):
            own = np.nonzero((face >= first) & (face < first + len(person.mesh.faces)))
            points = pose.back(camera.points(seen.range, *own))
            found = person.parts.labels_at(person.mesh, face[own] - np.int32(first), points)
            body, first = found < UNLABELLED, first + len(person.mesh.faces)
            labels[own], people[own] = np.where(body, found, UNLABELLED), np.where(body, number + 1, 0)
        # For each face its row in `losses`: the rows of people's parts come first, one person after another.
        rows = np.arange(len(pieces)) + (_PARTS - 1) * len(bodies)
        losses = np.array([*(loss for *_, worn in self.persons for loss in worn), *(loss for _, loss in self.solids)])
        surface = face, np.repeat(rows, [len(piece.faces) for piece in pieces]), whole.normals
        view = camera.axes, camera.position, across, down
        lost = _lose(range_m, labels, people, surface, view, losses.reshape(-1, 3), _LATTICE)
        face[lost], labels[lost], people[lost] = -1, BACKGROUND, 0
        planes = {"person": people}
        if with_things:
            counts = np.zeros(len(pieces), np.uint8)
            counts[np.array([*self.things], np.intp) + len(bodies)] = np.arange(1, len(self.things) + 1)
            of_faces = np.repeat(counts, [len(piece.faces) for piece in pieces])
            planes["thing"] = np.append(of_faces, np.uint8(0))[face]
        corners, facing, lit = whole.vertices[whole.faces[:, 0]], [], []
        sight = np.einsum("ij,ij->i", surface[2], corners - camera.position)
        for one in self.rig.by_projector():
            rotation, offset = one.camera_to_projector()
            place = camera.position - camera.axes.T @ (rotation.T @ offset)
            towards = sight * np.einsum("ij,ij->i", surface[2], corners - place) > 0
            facing.append(np.append(towards, False)[face])
            ranges = renderer.render(PlacedCamera(one.projector, rotation @ camera.axes, place)).range
            lit.append(np.where(ranges < farthest, ranges, np.float32(0)))
        range_m[face < 0] = 0
        told = {"height_cm": round(100 * self.height_m), "pitch_deg": round(self.pitch_deg), "people": len(bodies)}
        images = range_m, labels, np.concatenate(lit), facing[0] if len(facing) == 1 else np.stack(facing), None
        return Render(self._key, *images, split, told, planes)


def _lose_loop(range_m: Any, labels: Any, people: Any, surface: Any, view: Any, losses: Any, lattice: Any) -> Any:
    """Mark lost pixels, [H, W], by the losses [L, 3] of what they show.

    surface: the face of each pixel, each face's row of the losses and normal; of people, the part's row is used. view:
    axes and position of the camera, slopes of its rays. The field is a sum of three waves; each row sees another piece.
    """
    (face, rows, normals), (axes, position, across, down) = surface, view
    lost, place, parts = np.zeros(face.shape, np.bool_), np.empty(3), _PARTS
    for line in range(face.shape[0]):
        for column in range(face.shape[1]):
            seen = face[line, column]
            if seen < 0:
                continue
            row, person = rows[seen], people[line, column]
            if person > 0:
                row = parts * (person - 1) + labels[line, column]
            level, graze, wave = losses[row, 0], losses[row, 1], losses[row, 2]
            if level + graze < -4.0:
                continue
            a, b, sight, square = across[column], down[line], 0.0, 0.0
            for axis in range(3):
                ray, normal = a * axes[0, axis] + b * axes[1, axis] + axes[2, axis], normals[seen, axis]
                sight, square = sight + ray * normal, square + normal * normal
                place[axis] = position[axis] + range_m[line, column] * ray
            edge = 1.0 - abs(sight) / np.sqrt((a * a + b * b + 1.0) * max(square, 1e-30))
            level += graze * edge**4
            if level < -4.0:
                continue
            value = 0.0
            for octave in range(3):
                scale = 1.0 / (wave * _WAVES[octave])
                # The numbers added make all of them positive.
                x, y = place[0] * scale + 5.3 * (row + 1) + 8192.0, place[1] * scale + 3.7 * octave + 8192.0
                z = place[2] * scale + 8192.0
                i, j, k = int(x), int(y), int(z)
                u, v, w = x - i, y - j, z - k
                for corner in range(8):
                    di, dj, dk = corner & 1, corner >> 1 & 1, corner >> 2
                    share = (u if di else 1 - u) * (v if dj else 1 - v) * (w if dk else 1 - w)
                    at = ((i + di) % _CELLS * _CELLS + (j + dj) % _CELLS) * _CELLS + (k + dk) % _CELLS
                    value += _WEIGHTS[octave] * share * lattice[at]
            lost[line, column] = value < level
    return lost


_lose: Any = compiled(_lose_loop, "rooms")
