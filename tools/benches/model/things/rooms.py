"""Made rooms: people among tables, beds, machines and other things before a range sensor, and who is found there.

A room has a floor and walls, up to three people and up to five things, all drawn by its number. People may stand behind
things, touch them, or be cut by the frame.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts import AxialNoise
from bodyseg_data.bodies import BodyRef, BodySource, open_source
from bodyseg_data.core import Draws, ProgressCallback, generator, silent
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.meshes import Mesh, Partition, Solid, cuboid, together
from bodyseg_data.packing import FURNITURE, Numbers
from bodyseg_data.rendering import RasterRenderer
from bodyseg_data.rigs import Camera, PlacedCamera, axes_at, load_sensor
from bodyseg_data.samples import Split
from bodyseg_model.networks import Network
from bodyseg_model.segmentation import LabelledBody, PersonScore, Segmenter

MOST_PEOPLE: Final = 3
MOST_THINGS: Final = 5

KINDS: Final = tuple(name for name in FURNITURE if name != "plank")
"""Things that stand on a floor."""

_KEPT: Final = 32  # bodies, once they are built
_ATTEMPTS: Final = 12
_NEAREST_M: Final = 0.7  # on the floor, where a camera sees the upper half of a person
_FARTHEST_M: Final = 4.4
_TOUCHING: Final = 0.4, 0.9  # distance of a thing from who it touches, as a share of both radii
_NOISE: Final = AxialNoise(grazing_mm=0.0, grazing_power=0.0)
"""Of a Kinect v1, on surfaces that face it."""


@dataclass(frozen=True)
class Room:
    """A frame and its truth. range_m: float32 [H, W], metres, with noise, 0 where nothing was measured.

    person, thing: int32 [H, W], the number of the person or thing that a pixel sees, -1 elsewhere. labels: uint8
    [H, W], the parts of people, 255 elsewhere. people, things: how many stand in the room, seen or not.
    """

    range_m: NDArray[np.float32] = field(repr=False)
    person: NDArray[np.int32] = field(repr=False)
    thing: NDArray[np.int32] = field(repr=False)
    labels: NDArray[np.uint8] = field(repr=False)
    people: int
    things: int


@dataclass(frozen=True)
class _Person:
    mesh: Mesh
    parts: Partition | None


class Rooms:
    """Makes rooms by their numbers, with people drawn from `bodies` of one source.

    parts: label them, too. touching: things stand against people, where there are any, or reach into them, as chairs do
    into who sits on them; otherwise people and things keep apart.
    """

    def __init__(
        self,
        source: BodySource,
        bodies: Sequence[BodyRef],
        camera: Camera,
        seed: int,
        parts: bool = True,
        touching: bool = False,
    ) -> None:
        self.camera = camera
        self._source, self._bodies, self._seed, self._parts = source, bodies, seed, parts
        self._touching = touching
        self._built = lru_cache(maxsize=_KEPT)(self._build)

    def __call__(self, number: int) -> Room:
        """Make the room of a number. The same arguments give the same frame."""
        key = f"room {number}"
        numbers = Numbers(Draws(self._seed, 0, key), "room")
        height, pitch = numbers.between(0.8, 2.0), numbers.between(-25.0, 5.0)
        camera = PlacedCamera(self.camera, axes_at(0, pitch), np.array([0.0, height, 0.0]))
        people, things = numbers.whole(0, MOST_PEOPLE), numbers.whole(0, MOST_THINGS)
        floor = _Floor(self.camera)
        layers = [_walls(numbers)]
        bodies = []
        for _ in range(people):
            body = self._built(numbers.whole(0, len(self._bodies) - 1))
            pose = floor.find_pose(Solid(body.mesh.vertices, body.mesh.faces), numbers)
            if pose is not None:
                bodies.append((body, pose))
        for _ in range(things):
            thing = FURNITURE[KINDS[numbers.whole(0, len(KINDS) - 1)]](numbers)
            at_people = self._touching and bodies
            pose = floor.find_touching(thing, len(bodies), numbers) if at_people else floor.find_pose(thing, numbers)
            if pose is not None:
                layers.append(pose.of(thing))
        return self._seen(key, camera, layers, bodies)

    def _build(self, index: int) -> _Person:
        built = self._source.build(self._bodies[index])
        return _Person(built.mesh, built.partition() if self._parts else None)

    def _seen(self, key: str, camera: PlacedCamera, layers: list[Solid], bodies: list[tuple[_Person, _Pose]]) -> Room:
        shape = camera.camera.rows, camera.camera.columns
        nearest = np.full(shape, np.inf, np.float32)
        person, thing = np.full(shape, -1, np.int32), np.full(shape, -1, np.int32)
        labels = np.full(shape, BACKGROUND, np.uint8)
        rays = camera.camera.pixel_rays()
        for number, solid in enumerate(layers):  # the first is the room itself
            seen = RasterRenderer(solid).render(camera)
            before = (seen.face >= 0) & (seen.range < nearest)
            nearest[before], thing[before] = seen.range[before], number - 1
        for number, (body, pose) in enumerate(bodies):
            seen = RasterRenderer(pose.of(Solid(body.mesh.vertices, body.mesh.faces))).render(camera)
            before = (seen.face >= 0) & (seen.range < nearest)
            nearest[before], thing[before], person[before] = seen.range[before], -1, number
            if body.parts is not None:
                points = camera.to_body(rays[before] * seen.range[before][:, None])
                labels[before] = body.parts.labels_at(body.mesh, seen.face[before], pose.back(points))
        range_m = _measured(nearest, generator(self._seed, 0, key, "noise"))
        for image, empty in ((person, -1), (thing, -1), (labels, BACKGROUND)):
            image[range_m == 0] = empty
        return Room(range_m, person, thing, labels, len(bodies), len(layers) - 1)


@dataclass(frozen=True)
class _Pose:
    """A rotation about the vertical axis, then a move [3], metres."""

    angle_rad: float
    by_m: tuple[float, float, float]

    def of(self, solid: Solid) -> Solid:
        return solid.turned(self.angle_rad).moved(self.by_m)

    def back(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points [N, 3] of the room in the frame of the solid that stands here."""
        none = np.empty((0, 3), np.int32)
        return Solid(points - np.asarray(self.by_m), none).turned(-self.angle_rad).vertices


@dataclass(frozen=True)
class _Footprint:
    """Place of a solid that is turned by `angle_rad`: its middle on the floor, its lowest point, and radius, metres."""

    angle_rad: float
    middle: tuple[float, float]
    low: float
    radius: float

    @classmethod
    def of(cls, solid: Solid, angle_rad: float) -> _Footprint:
        turned = solid.turned(angle_rad)
        low, high = turned.vertices.min(axis=0), turned.vertices.max(axis=0)
        centre = (low + high) / 2
        radius = 0.45 * math.hypot(high[0] - low[0], high[2] - low[2])
        return cls(angle_rad, (float(centre[0]), float(centre[2])), float(low[1]), radius)

    def at(self, across: float, away: float) -> _Pose:
        return _Pose(self.angle_rad, (across - self.middle[0], -self.low, -away - self.middle[1]))


class _Floor:
    """Places on the floor before a camera that are still free, as discs."""

    def __init__(self, camera: Camera) -> None:
        self._taken: list[tuple[float, float, float]] = []
        self._slope = camera.columns / 2 / camera.focal_px

    def find_pose(self, solid: Solid, numbers: Numbers) -> _Pose | None:
        """Find a pose in which a solid stands on a free place, turned in any way; None if none is found."""
        footprint = _Footprint.of(solid, numbers.between(-math.pi, math.pi))
        for _ in range(_ATTEMPTS):
            away = numbers.between(_NEAREST_M, _FARTHEST_M)
            across = numbers.between(-1.0, 1.0) * self._slope * away
            if all(math.hypot(across - x, away - z) > footprint.radius + taken for x, z, taken in self._taken):
                self._taken.append((across, away, footprint.radius))
                return footprint.at(across, away)
        return None

    def find_touching(self, solid: Solid, people: int, numbers: Numbers) -> _Pose | None:
        """Find a pose in which a solid touches one of the first `people` that stand here, or reaches into them; None if
        none is found.
        """
        footprint = _Footprint.of(solid, numbers.between(-math.pi, math.pi))
        for _ in range(_ATTEMPTS):
            x, z, taken = self._taken[numbers.whole(0, people - 1)]
            direction, apart = numbers.between(-math.pi, math.pi), numbers.between(*_TOUCHING)
            apart *= footprint.radius + taken
            across, away = x + apart * math.sin(direction), z + apart * math.cos(direction)
            if _NEAREST_M < away < _FARTHEST_M:
                return footprint.at(across, away)
        return None


def _walls(numbers: Numbers) -> Solid:
    """A floor, a wall at the back, and one at a side or none."""
    back, side = numbers.between(3.5, 6.0), numbers.between(1.4, 2.5)
    walls = [cuboid((12.0, 0.1, 14.0), (0.0, -0.05, -5.0)), cuboid((12.0, 3.0, 0.1), (0.0, 1.5, -back - 0.05))]
    where = numbers.whole(-1, 1)
    if where:
        walls.append(cuboid((0.1, 3.0, 14.0), (where * (side + 0.05), 1.5, -5.0)))
    return together(walls)


def _measured(nearest: NDArray[np.float32], draws: np.random.Generator) -> NDArray[np.float32]:
    """Ranges with a Kinect's noise, in whole millimetres; two pixels in a hundred are lost, and steep edges are."""
    seen = np.where(np.isfinite(nearest), nearest, 0.0)
    sigma = _NOISE.sigma_m(seen.ravel(), np.zeros(seen.size, np.float32)).reshape(seen.shape)
    noisy = seen + draws.normal(0.0, 1.0, seen.shape) * sigma
    lost = (seen == 0) | (draws.random(seen.shape) < 0.02)
    lost[:, 1:] |= np.abs(np.diff(seen, axis=1)) > 0.25
    return np.where(lost, 0.0, np.maximum(np.rint(1000 * noisy), 0) / 1000).astype(np.float32)


SENSORS: Final = ("kinect_v1", "kinect_v2")
TEST_SEED: Final = 2
TEST_SOURCES: Final = ("open", "hard")

LEAST_SEEN_M2: Final = 0.1
"""Least visible surface of a person that counts, square metres, as if it faced the camera."""

_BODIES: Final = 12  # of each source: to label one takes a second


@dataclass
class Counts:
    """Sums over frames. people: that show at least `LEAST_SEEN_M2`; people_found: of them, half of the pixels are in
    bodies. surfaces: that were labelled; things: of them, those that show no person to a half. person_pixels, labelled,
    right: pixels of people, with a label, with the right one. thing_pixels: labelled pixels that show no person.
    """

    people: int = 0
    people_found: int = 0
    surfaces: int = 0
    things: int = 0
    person_pixels: int = 0
    labelled: int = 0
    right: int = 0
    thing_pixels: int = 0

    def add(self, room: Room, bodies: Sequence[LabelledBody], labels: NDArray[np.uint8], pixel_m: float) -> None:
        """Count one frame. labels: uint8 [H, W], of the network. pixel_m: side of a pixel at 1 m, metres."""
        in_body = np.zeros(room.person.shape, np.bool_)
        for body in bodies:
            in_body.ravel()[body.pixels] = True
            self.surfaces += 1
            self.things += bool((room.person.ravel()[body.pixels] >= 0).mean() < 0.5)
        for number in range(room.people):
            seen = room.person == number
            if ((pixel_m * room.range_m[seen]) ** 2).sum() >= LEAST_SEEN_M2:
                self.people += 1
                self.people_found += bool(in_body[seen].mean() >= 0.5)
        person = room.person >= 0
        named = in_body & (labels != BACKGROUND)
        self.person_pixels += int(person.sum())
        self.labelled += int((named & person).sum())
        self.right += int((named & person & (labels == room.labels)).sum())
        self.thing_pixels += int((named & ~person).sum())

    def to_json(self) -> dict[str, Any]:
        """The sums, and the shares that follow: accuracy of the labelled pixels of people, null without any."""
        shares = {
            "found": self.people_found / self.people if self.people else None,
            "accuracy": self.right / self.labelled if self.labelled else None,
            "right_of_all": self.right / self.person_pixels if self.person_pixels else None,
        }
        rounded = {name: None if share is None else round(share, 4) for name, share in shares.items()}
        return asdict(self) | rounded


def people_and_things(
    network: Network, score: PersonScore, count: int, progress: ProgressCallback = silent
) -> dict[str, Any]:
    """Measure a network on `count` made rooms, with labels on every surface of a body's size, and on people alone.

    Returns plain JSON: `Counts.to_json` "before" and "after" the score, and its processor time, milliseconds a frame.
    """
    before, after, seconds = Counts(), Counts(), 0.0
    for done, (segmenter, room) in enumerate(_frames(network, count)):
        result = segmenter(room.range_m)
        start = time.thread_time()
        people = [body for body in result.bodies if score(body.pixels, room.range_m, segmenter.camera) >= score.cutoff]
        seconds += time.thread_time() - start
        before.add(room, result.bodies, result.labels, 1 / segmenter.camera.focal_px)
        after.add(room, people, result.labels, 1 / segmenter.camera.focal_px)
        progress(done + 1, count)
    return {
        "rooms": count,
        "sensors": list(SENSORS),
        "sources": list(TEST_SOURCES),
        "seed": TEST_SEED,
        "before": before.to_json(),
        "after": after.to_json(),
        "score_ms": round(1000 * seconds / count, 3),
    }


def rooms_of(
    source: str, split: Split, seed: int, parts: bool = True, most: int | None = None, touching: bool = False
) -> list[Rooms]:
    """Makers of rooms for each of `SENSORS`, with bodies of a source's split, `most` of them, evenly spaced."""
    opened = open_source(source)
    bodies = [body for body in opened.bodies() if body.split == split]
    chosen = bodies if most is None else bodies[:: max(1, len(bodies) // most)][:most]
    return [Rooms(opened, chosen, load_sensor(name).camera, seed, parts, touching) for name in SENSORS]


def _frames(network: Network, count: int) -> Iterator[tuple[Segmenter, Room]]:
    """Rooms with bodies that no network and no score was fitted to, in turn by source and sensor."""
    makers = [rooms for source in TEST_SOURCES for rooms in rooms_of(source, "test", TEST_SEED, most=_BODIES)]
    segmenters = [Segmenter(network, rooms.camera) for rooms in makers]
    for number in range(count):
        turn = number % len(makers)
        yield segmenters[turn], makers[turn](number)
