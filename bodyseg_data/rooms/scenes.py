"""Rooms with people, drawn by their keys: what stands where, and what a rig's camera and projectors see of it.

A room's frame is y up, the floor at y = 0; the camera stands at x = z = 0 and looks towards -z. Everything is drawn
from a sequence of raw random words of its own (`Numbers`), whose bits NumPy guarantees, so a sample has the same bytes
however it is packed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import Draws
from bodyseg_data.labels import BACKGROUND, PART_CLASSES, UNLABELLED
from bodyseg_data.meshes import Mesh, Partition, Solid, cuboid, together
from bodyseg_data.packing.things import Numbers
from bodyseg_data.rendering import RasterRenderer
from bodyseg_data.renders import Render
from bodyseg_data.rigs import PlacedCamera, Rig, axes_at
from bodyseg_data.rooms.furnishings import FURNISHINGS, SEATS, bed, clutter, sheet
from bodyseg_data.samples import Split

Floats = NDArray[np.float64]

_PEOPLE: Final = (0, 1, 1, 1, 1, 1, 1, 2, 2, 2, 3)
"""Numbers of people in a room, each as often."""
_NEAREST_M: Final = 0.7
_FARTHEST_M: Final = 5.5
_SIT: Final = "sitting", "on_a_chair"
_LIE: Final = "lying", "on_the_back", "on_the_front", "on_the_side"
_HIPS: Final = ("Rt. PSIS", "Lt. PSIS", "Rt. Trochanterion", "Lt. Trochanterion")
_KNEES: Final = ("Rt. Femoral Lateral Epicn", "Lt. Femoral Lateral Epicn")


@dataclass(frozen=True)
class Person:
    """Somebody who may stand in a room: a body with its labels. pose: in words."""

    mesh: Mesh = field(repr=False)
    parts: Partition = field(repr=False)
    pose: str


@dataclass(frozen=True)
class _Pose:
    """A rotation about the vertical axis, then a move [3], metres."""

    angle_rad: float
    by_m: Floats

    def of(self, solid: Solid) -> Solid:
        moved = solid.turned(self.angle_rad)
        return Solid(moved.vertices + self.by_m, moved.faces)

    def back(self, points: Floats) -> Floats:
        return Solid(points - self.by_m, np.empty((0, 3), np.int32)).turned(-self.angle_rad).vertices


@dataclass(frozen=True)
class _Wall:
    """A wall: points with normal . p = offset; the room is where that is less. along: to the right, seen from inside."""

    normal: Floats
    offset: float

    @property
    def angle_rad(self) -> float:
        """By which a thing with its back towards +z is turned to stand with its back to the wall."""
        return math.atan2(-self.normal[0], self.normal[2])

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
        numbers = self._numbers = self.numbers("room")
        self.height_m = numbers.between(0.4, 2.2)
        low, high = max(-30.0, -45.0 * self.height_m / 2.2), 20.0 - 12.0 * self.height_m
        self.pitch_deg = numbers.between(low, max(high, low + 5))
        self._taken: list[tuple[float, float, float]] = []
        self._half = rig.camera.columns / 2 / rig.camera.focal_px
        self.solids: list[Solid] = []
        self.persons: list[tuple[Person, _Pose]] = []
        self.walls = self._build_walls(numbers)
        some = [people[numbers.whole(0, len(people) - 1)] for _ in range(_PEOPLE[numbers.whole(0, len(_PEOPLE) - 1)])]
        for number, person in enumerate(some):
            self._place_person(person, self.numbers(f"person {number}"))
        for number in range(numbers.whole(2, 12)):
            self._place_thing(self.numbers(f"thing {number}"))

    def numbers(self, purpose: str) -> Numbers:
        """Random numbers of a purpose of this room."""
        return Numbers(self._draws, purpose)

    def _build_walls(self, numbers: Numbers) -> list[_Wall]:
        """Floor, ceiling and three or four walls, with what hangs on them."""
        ceiling = max(numbers.between(2.2, 3.2), self.height_m + 0.2)
        for _ in range(20):
            yaw = numbers.between(-0.7, 0.7)
            far = numbers.between(1.8, 6.5) if numbers.whole(0, 9) else 12.0
            walls = []
            for turn, distance in ((0, far), (0.5, numbers.between(0.7, 3.5)), (-0.5, numbers.between(0.7, 3.5))):
                angle = yaw + turn * math.pi
                walls.append(_Wall(np.array([math.sin(angle), 0.0, -math.cos(angle)]), distance))
            ahead = [min(wall.free(slope) for wall in walls) for slope in (-0.8 * self._half, 0.0, 0.8 * self._half)]
            if ahead[1] > 2.2 and max(ahead) > 3.0 and min(ahead) > 0.9:
                break
        reach = 14.0
        self.solids.append(cuboid((2 * reach, 0.02, 2 * reach), (0, -0.01, 0)))
        if numbers.whole(0, 4):
            self.solids.append(cuboid((2 * reach, 0.02, 2 * reach), (0, ceiling + 0.01, 0)))
        for number, wall in enumerate(walls):
            self._build_wall(wall, ceiling, self.numbers(f"wall {number}"))
        return walls

    def _build_wall(self, wall: _Wall, ceiling: float, numbers: Numbers) -> None:
        """A wall with at most one window or door and up to three things on it."""
        pieces, wide = [], 14.0
        middle = numbers.between(-1.5, 1.5)
        kind = numbers.whole(0, 3)
        if kind == 0:  # a window, through which nothing is measured
            half, low, high = numbers.between(0.4, 1.2), numbers.between(0.5, 1.1), ceiling - numbers.between(0.1, 0.5)
            pieces += [cuboid((wide, low, 0.1), (middle, low / 2, 0.05)), cuboid((wide, ceiling - high, 0.1), (middle, (ceiling + high) / 2, 0.05))]
            pieces += [cuboid((wide / 2, high - low, 0.1), (middle + s * (half + wide / 4), (high + low) / 2, 0.05)) for s in (-1, 1)]
            pieces += [cuboid((0.06, high - low, 0.06), (middle + s * half, (high + low) / 2, 0.02)) for s in (-1, 0, 1)]
        else:
            pieces.append(cuboid((wide, ceiling, 0.1), (0, ceiling / 2, 0.05)))
        if kind == 1:
            pieces.append(cuboid((0.9, 2.0, 0.05), (middle, 1.0, numbers.between(-0.02, 0.02))))
            pieces.append(cuboid((0.12, 0.03, 0.08), (middle + 0.35, 1.02, -0.05)))
        if not numbers.whole(0, 2):  # curtains
            height, low = numbers.between(1.2, ceiling), 0.0
            low = max(0.02, ceiling - height - numbers.between(0.0, 0.2))
            for side in (-1, 1)[: numbers.whole(1, 2)]:
                width, folds = numbers.between(0.3, 1.5), numbers.between(3, 9)
                cloth = sheet(width, ceiling - low - 0.05, numbers.between(0.02, 0.1), folds * width, numbers)
                pieces.append(cloth.moved((middle + side * (0.5 + width / 2), low, -numbers.between(0.05, 0.2))))
        if not numbers.whole(0, 3):  # a radiator
            long, low = numbers.between(0.5, 1.4), numbers.between(0.08, 0.2)
            ribs = [cuboid((0.04, 0.55, 0.08), (middle + n * 0.06 - long / 2, low + 0.28, -0.07)) for n in range(int(long / 0.06))]
            pieces += [*ribs, cuboid((long, 0.04, 0.1), (middle, low + 0.56, -0.07))]
        for _ in range(numbers.whole(0, 3)):  # pictures, boards, boxes and shelves
            size = numbers.between(0.2, 1.2), numbers.between(0.2, 0.9), numbers.between(0.02, 0.3)
            at = numbers.between(-2.5, 2.5), numbers.between(1.0, max(1.1, ceiling - 0.3))
            pieces.append(cuboid(size, (at[0], at[1], -size[2] / 2)))
            if size[2] > 0.15:
                pieces += [each.moved((at[0], 0, -size[2] / 2)) for each in clutter(numbers, size[0], size[2], at[1] + size[1] / 2, 3)]
        pose = _Pose(wall.angle_rad, wall.normal * wall.offset)
        self.solids.append(pose.of(together(pieces)))

    def _spot(self, numbers: Numbers, radius: float, nearest: float = _NEAREST_M) -> tuple[float, float] | None:
        """A free place in the room that the camera sees, or None."""
        for _ in range(12):
            away = numbers.between(nearest + radius * 0.5, _FARTHEST_M)
            x = numbers.between(-1.0, 1.0) * (self._half * away + 0.2)
            inside = all(wall.normal[0] * x - wall.normal[2] * away < wall.offset - 0.3 * radius for wall in self.walls)
            if inside and all(math.hypot(x - a, away - b) > 0.8 * (radius + taken) for a, b, taken in self._taken):
                return x, away
        return None

    def _stand(self, solid: Solid, angle: float, x: float, away: float, low: float = 0.0) -> tuple[_Pose, Solid, float]:
        """Pose of a solid that stands with its middle at a place; the solid there, and its radius."""
        turned = solid.turned(angle)
        least, most = turned.vertices.min(axis=0), turned.vertices.max(axis=0)
        middle = (least + most) / 2
        pose = _Pose(angle, np.array([x - middle[0], low - least[1], -away - middle[2]]))
        return pose, pose.of(solid), 0.45 * math.hypot(most[0] - least[0], most[2] - least[2])

    def _off_walls(self, pose: _Pose, vertices: Floats, gap: float, only: _Wall | None = None) -> _Pose:
        """The pose moved out of all walls, or against one of them, up to a gap."""
        by = pose.by_m.copy()
        for _ in range(2):
            for wall in self.walls:
                out = wall.depth_of(vertices + (by - pose.by_m)) - (wall.offset - gap)
                if out > 0 or wall is only:
                    by -= out * wall.normal
        return _Pose(pose.angle_rad, by)

    def _place_person(self, person: Person, numbers: Numbers) -> None:
        """Somebody stands free, close to a wall, beside another, on a seat or a bed, or behind something."""
        surface = Solid(person.mesh.vertices, person.mesh.faces)
        angle, how = numbers.between(-math.pi, math.pi), numbers.between(0, 1)
        sits, lies = person.pose.startswith(_SIT), person.pose.startswith(_LIE)
        low = 0.0
        if lies and how < 0.6:
            low = numbers.between(0.3, 0.6)
        spot = self._spot(numbers, 0.4)
        if self.persons and how > 0.6:  # close to another
            x, away, radius = self._taken[numbers.whole(0, len(self.persons) - 1)]
            turn, apart = numbers.between(-math.pi, math.pi), radius * numbers.between(0.9, 1.6)
            spot = x + apart * math.sin(turn), max(away + apart * math.cos(turn), _NEAREST_M)
        if spot is None:
            return
        pose, there, radius = self._stand(surface, angle, *spot, low)
        wall = self.walls[numbers.whole(0, 2)] if how < 0.4 and not lies else None
        if wall is not None and wall.offset < _FARTHEST_M:
            pose = self._off_walls(pose, there.vertices, numbers.between(0.0, 0.25), wall)
        else:
            pose = self._off_walls(pose, there.vertices, 0.02)
        there = pose.of(surface)
        middle = (there.vertices.min(axis=0) + there.vertices.max(axis=0)) / 2
        if -middle[2] < 0.5 or np.min(np.linalg.norm(there.vertices - (0.0, self.height_m, 0.0), axis=1)) < 0.35:
            return
        self._taken.append((float(middle[0]), float(-middle[2]), radius))
        self.persons.append((person, pose))
        if sits and numbers.whole(0, 9):
            self._seat_below(person, there, numbers)
        elif lies and low:
            self._bed_below(there, low, numbers)
        elif how > 0.85 and numbers.whole(0, 1):  # behind something
            self._before(middle, there, numbers)

    def _seat_below(self, person: Person, there: Solid, numbers: Numbers) -> None:
        hips, knees = (np.isin(person.parts.labels, [PART_CLASSES.names.index(name) for name in names]) for names in (_HIPS, _KNEES))
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
        angle = math.atan2(way[0], -way[2])
        self.solids.append(_Pose(angle, np.array([middle[0], 0.0, middle[2]])).of(seat))

    def _bed_below(self, there: Solid, low: float, numbers: Numbers) -> None:
        least, most = there.vertices.min(axis=0), there.vertices.max(axis=0)
        flat = there.vertices[:, [0, 2]] - there.vertices[:, [0, 2]].mean(axis=0)
        way = np.linalg.eigh(flat.T @ flat)[1][:, 1]
        made = bed(numbers)
        top = float(np.quantile(made.vertices[:, 1], 0.6))
        made = Solid(made.vertices * (1.0, low / max(top, 0.1), 1.0), made.faces)
        middle = (least + most) / 2
        self.solids.append(_Pose(math.atan2(way[1], way[0]), np.array([middle[0], -0.02, middle[2]])).of(made))

    def _before(self, middle: Floats, there: Solid, numbers: Numbers) -> None:
        """Something between a person and the camera."""
        thing = self._thing(numbers)
        share = numbers.between(0.45, 0.95)
        _, stood, radius = self._stand(thing, numbers.between(-math.pi, math.pi), middle[0] * share, -middle[2] * share)
        gap = -middle[2] * (1 - share)
        if gap > 0.15 and -middle[2] * share - radius > 0.4:
            self.solids.append(stood)

    def _thing(self, numbers: Numbers) -> Solid:
        return FURNISHINGS[self._kinds[numbers.whole(0, len(self._kinds) - 1)]](numbers)

    def _place_thing(self, numbers: Numbers) -> None:
        """A thing stands against a wall, free, or touches somebody."""
        thing, how = self._thing(numbers), numbers.between(0, 1)
        _, _, radius = self._stand(thing, 0.0, 0.0, 2.0)
        if how > 0.85 and self.persons:
            x, away, taken = self._taken[numbers.whole(0, len(self.persons) - 1)]
            turn, apart = numbers.between(-1.3, 1.3), (radius + taken) * numbers.between(0.6, 1.0)
            spot: tuple[float, float] | None = (x + apart * math.sin(turn), away + apart * math.cos(turn))
        else:
            spot = self._spot(numbers, radius, 1.0)
        if spot is None:
            return
        wall = self.walls[numbers.whole(0, 2)]
        against = how < 0.5 and wall.offset < 7
        angle = wall.angle_rad if against else numbers.between(-math.pi, math.pi)
        pose, there, _ = self._stand(thing, angle, *spot)
        pose = self._off_walls(pose, there.vertices, numbers.between(0.0, 0.1), wall if against else None)
        there = pose.of(thing)
        least, most = there.vertices.min(axis=0), there.vertices.max(axis=0)
        if -most[2] < 0.45 and least[0] < 0.6 and most[0] > -0.6:
            return
        self._taken.append((float(least[0] + most[0]) / 2, float(-least[2] - most[2]) / 2, radius))
        self.solids.append(there)

    def render(self, split: Split = "train") -> Render:
        """What the rig's devices see; the plane "person" counts people from 1, 0 elsewhere."""
        bodies = [pose.of(Solid(person.mesh.vertices, person.mesh.faces)) for person, pose in self.persons]
        whole = together([*bodies, *self.solids])
        ends = np.cumsum([0, *(len(body.faces) for body in bodies)])
        camera = PlacedCamera(self.rig.camera, axes_at(0, self.pitch_deg), np.array([0.0, self.height_m, 0.0]))
        renderer, step_m = RasterRenderer(whole), self.rig.range_step_m
        seen = renderer.render(camera)
        farthest = 65535.0 * step_m
        measured = (seen.face >= 0) & (seen.range < farthest)
        labels = np.full(measured.shape, BACKGROUND, np.uint8)
        labels[measured] = UNLABELLED
        people = np.zeros(measured.shape, np.uint8)
        rays, normals = self.rig.camera.pixel_rays(), whole.normals
        points = camera.to_body(rays * seen.range[..., None])
        for number, (person, pose) in enumerate(self.persons):
            own = measured & (seen.face >= ends[number]) & (seen.face < ends[number + 1])
            faces = seen.face[own] - np.int32(ends[number])
            found = person.parts.labels_at(person.mesh, faces, pose.back(points[own]))
            labels[own] = np.where(found == BACKGROUND, UNLABELLED, found)
            people[own] = number + 1
        facing, lit = [], []
        for one in self.rig.by_projector():
            rotation, offset = one.camera_to_projector()
            place = camera.position - camera.axes.T @ (rotation.T @ offset)
            projector = PlacedCamera(one.projector, rotation @ camera.axes, place)
            flat = seen.face[measured]
            away = np.einsum("ij,ij->i", normals[flat], whole.vertices[whole.faces[flat, 0]] - camera.position)
            light = np.einsum("ij,ij->i", normals[flat], whole.vertices[whole.faces[flat, 0]] - projector.position)
            towards = np.zeros(measured.shape, np.bool_)
            towards[measured] = away * light > 0
            facing.append(towards)
            view = renderer.render(projector).range
            lit.append(np.where(view < farthest, view, 0))
        return Render(
            self._key,
            np.where(measured, seen.range, 0).astype(np.float32),
            labels,
            np.concatenate(lit).astype(np.float32),
            np.stack(facing),
            None,
            split,
            {"height_cm": round(100 * self.height_m), "pitch_deg": round(self.pitch_deg), "people": len(self.persons)},
            {"person": people},
        )
