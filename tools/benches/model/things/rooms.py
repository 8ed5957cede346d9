"""Made rooms: people among tables, beds, machines and other things before a range sensor, and who is found there.

A room has a floor and walls, up to three people and up to five things, all drawn by its number. People may stand behind
things, touch them, or be cut by the frame.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts import Augmentation, AxialNoise
from bodyseg_data.bodies import BodyRef, BodySource, open_source
from bodyseg_data.core import Draws, ProgressCallback, generator, silent
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.meshes import Mesh, Partition, Solid, cuboid, together, turned_solid
from bodyseg_data.packing import FURNITURE, Numbers
from bodyseg_data.rendering import RasterRenderer
from bodyseg_data.rigs import Camera, PlacedCamera, axes_at, load_sensor
from bodyseg_data.samples import FARTHEST_STEPS, Sample, SampleInfo, Split, metres
from bodyseg_model.networks import Network
from bodyseg_model.segmentation import LabelledBody, PersonScore, Segmenter
from bodyseg_model.segmentation.person_score import SeenShape

MOST_PEOPLE: Final = 3
MOST_THINGS: Final = 5

Kind = Callable[[Numbers], Solid]

KINDS: Final[Mapping[str, Kind]] = {name: kind for name, kind in FURNITURE.items() if name != "plank"}
"""Things that stand on a floor."""


def curtain(numbers: Numbers, width_m: float = 0.0) -> Solid:
    """A hanging curtain: a sheet in folds, which may be drawn together. width_m: 0 for a drawn one."""
    width, high = width_m or numbers.between(0.3, 1.6), numbers.between(1.2, 2.4)
    low, fold = numbers.between(0.0, 0.5), numbers.between(0.1, 0.35)
    deep, slack = numbers.between(0.02, 0.09), numbers.between(-0.3, 0.3)
    x = np.linspace(-width / 2, width / 2, max(12, round(40 * width)))
    phase = 2 * math.pi * (x / fold + slack * np.sin(3 * x / width))
    corners = np.stack([np.tile(x, 4), np.zeros(4 * len(x)), np.tile(deep * np.sin(phase), 4)], axis=1)
    corners = corners.reshape(4, -1, 3)
    corners[1::2, :, 1], corners[::2, :, 1] = high, low
    corners[2:, :, 2] += 0.02
    a, b = np.arange(len(x) - 1), np.arange(len(x) - 1) + 1
    front_low, front_high, back_low, back_high = (side * len(x) for side in range(4))
    faces = [
        [front_low + a, front_high + a, front_high + b],
        [front_low + a, front_high + b, front_low + b],
        [back_low + a, back_high + b, back_high + a],
        [back_low + a, back_low + b, back_high + b],
    ]
    return Solid(corners.reshape(-1, 3), np.concatenate([np.stack(face, axis=1) for face in faces]).astype(np.int32))


def post(numbers: Numbers) -> Solid:
    """A post or a pillar, round or square, or two of them one upon another."""
    height, thick = numbers.between(1.0, 2.4), numbers.between(0.05, 0.25)
    if numbers.whole(0, 1):
        return turned_solid([(thick, 0.0), (thick * numbers.between(0.6, 1.0), height)])
    return cuboid((2 * thick, height, 2 * thick), (0.0, height / 2, 0.0))


def board(numbers: Numbers) -> Solid:
    """A board, a door or a picture that leans back, with a rail or a ledge across it."""
    width, height, lean = numbers.between(0.3, 1.1), numbers.between(0.8, 2.0), numbers.between(0.0, 0.35)
    ledge = cuboid((width, 0.06, 0.1), (0.0, height * numbers.between(0.1, 0.9), -0.05))
    solid = together([cuboid((width, height, 0.03), (0.0, height / 2, 0.0)), ledge])
    axes = np.array([[1.0, 0.0, 0.0], [0.0, math.cos(lean), math.sin(lean)], [0.0, -math.sin(lean), math.cos(lean)]])
    return solid.placed(axes, np.zeros(3))


def sofa(numbers: Numbers) -> Solid:
    """An armchair or a sofa with round cushions."""
    width, depth, seat = numbers.between(0.7, 1.7), numbers.between(0.7, 0.95), numbers.between(0.35, 0.5)
    back, thick = seat + numbers.between(0.3, 0.55), numbers.between(0.12, 0.25)
    pieces = [
        cuboid((width, seat, depth), (0.0, seat / 2, 0.0)),
        cuboid((width, back, thick), (0.0, back / 2, depth / 2)),
        *(cuboid((thick, seat + 0.2, depth), (x * width / 2, (seat + 0.2) / 2, 0.0)) for x in (-1, 1)),
    ]
    for _ in range(numbers.whole(0, 3)):
        middle = numbers.between(-width / 3, width / 3), numbers.between(-0.1, 0.2)
        pieces.append(_ball(numbers.between(0.12, 0.3), numbers.between(0.15, 0.3)).moved((middle[0], seat, middle[1])))
    return together(pieces)


def coats(numbers: Numbers) -> Solid:
    """A stand with coats and a hat, or a lone coat on the wall: folds around a pole."""
    pole = turned_solid([(0.03, 0.0), (0.03, numbers.between(1.5, 1.9))])
    hung = [curtain(numbers, numbers.between(0.25, 0.5)).turned(numbers.between(-math.pi, math.pi)) for _ in range(3)]
    return together([pole, *hung[: numbers.whole(1, 3)], _ball(0.13, 0.2).moved((0.0, numbers.between(1.4, 1.7), 0.0))])


def cushioned_bed(numbers: Numbers) -> Solid:
    """A bed with pillows and a crumpled blanket."""
    bed = FURNITURE["bed"](numbers)
    top = float(np.median(bed.vertices[:, 1]))
    heaps = [
        _ball(numbers.between(0.15, 0.45), numbers.between(0.1, 0.35)).moved(
            (numbers.between(-0.7, 0.7), top - 0.05, numbers.between(-0.3, 0.3))
        )
        for _ in range(numbers.whole(1, 4))
    ]
    return together([bed, *heaps])


def _ball(radius: float, height: float) -> Solid:
    angles = [math.pi * step / 12 for step in range(1, 12)]
    return turned_solid([(radius * math.sin(angle), height * (1 - math.cos(angle)) / 2) for angle in angles])


OTHER_KINDS: Final[Mapping[str, Kind]] = {
    "curtain": curtain,
    "post": post,
    "board": board,
    "sofa": sofa,
    "coats": coats,
    "cushioned bed": cushioned_bed,
}
"""Things that nothing was fitted to."""

_KEPT: Final = 128  # bodies, once they are built
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


@lru_cache(maxsize=_KEPT)
def _built(source: BodySource, body: BodyRef, parts: bool) -> _Person:
    built = source.build(body)
    return _Person(built.mesh, built.partition() if parts else None)


class Rooms:
    """Makes rooms by their numbers, with people drawn from `bodies` of one source.

    kinds: of things; without any, people stand before nothing, as if the background had been removed. sensor: its
    artifacts fall on the clean frame; by default `_measured`.

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
        kinds: Mapping[str, Kind] = KINDS,
        sensor: Augmentation | None = None,
    ) -> None:
        self.camera = camera
        self._source: Any = source
        self._bodies, self._seed, self._parts = bodies, seed, parts
        self._touching, self._kinds, self._sensor = touching, tuple(kinds.values()), sensor
        self._made = lru_cache(maxsize=1)(self._make)

    def __call__(self, number: int, epoch: int = 0) -> Room:
        """Make the room of a number. The same arguments give the same frame; epoch: draws other artifacts."""
        scene = self._made(number)
        if self._sensor is None or scene.sample is None:
            range_m = _measured(scene.nearest, generator(self._seed, epoch, f"room {number}", "noise"))
        else:
            range_m = metres(self._sensor(scene.sample, epoch).range, self._sensor.rig.range_step_m)
        lost, none = range_m == 0, np.int32(-1)
        person, thing = np.where(lost, none, scene.person), np.where(lost, none, scene.thing)
        labels = np.where(lost, np.uint8(BACKGROUND), scene.labels)
        return Room(range_m, person, thing, labels, scene.people, scene.things)

    def _make(self, number: int) -> _Scene:
        key = f"room {number}"
        numbers = Numbers(Draws(self._seed, 0, key), "room")
        height, pitch = numbers.between(0.8, 2.0), numbers.between(-25.0, 5.0)
        camera = PlacedCamera(self.camera, axes_at(0, pitch), np.array([0.0, height, 0.0]))
        people, things = numbers.whole(0, MOST_PEOPLE), numbers.whole(0, MOST_THINGS)
        floor = _Floor(self.camera)
        layers = [_walls(numbers)] if self._kinds else [together([])]
        bodies = []
        for _ in range(people):
            body = _built(self._source, self._bodies[numbers.whole(0, len(self._bodies) - 1)], self._parts)
            pose = floor.find_pose(Solid(body.mesh.vertices, body.mesh.faces), numbers)
            if pose is not None:
                bodies.append((body, pose))
        for _ in range(things if self._kinds else 0):
            thing = self._kinds[numbers.whole(0, len(self._kinds) - 1)](numbers)
            at_people = self._touching and bodies
            pose = floor.find_touching(thing, len(bodies), numbers) if at_people else floor.find_pose(thing, numbers)
            if pose is not None:
                layers.append(pose.of(thing))
        return self._seen(key, camera, layers, bodies)

    def _seen(self, key: str, camera: PlacedCamera, layers: list[Solid], bodies: list[tuple[_Person, _Pose]]) -> _Scene:
        shape = camera.camera.rows, camera.camera.columns
        nearest = np.full(shape, np.inf, np.float32)
        person, thing = np.full(shape, -1, np.int32), np.full(shape, -1, np.int32)
        labels = np.full(shape, BACKGROUND, np.uint8)
        lit, shadow = np.zeros(shape, np.bool_), _Shadow(self._sensor, camera)
        rays = camera.camera.pixel_rays()
        for number, solid in enumerate(layers):  # the first is the room itself
            seen = RasterRenderer(solid).render(camera)
            before = (seen.face >= 0) & (seen.range < nearest)
            nearest[before], thing[before] = seen.range[before], number - 1
            lit[before] = shadow.faced(solid, seen.face[before])
        for number, (body, pose) in enumerate(bodies):
            solid = pose.of(Solid(body.mesh.vertices, body.mesh.faces))
            seen = RasterRenderer(solid).render(camera)
            before = (seen.face >= 0) & (seen.range < nearest)
            nearest[before], thing[before], person[before] = seen.range[before], -1, number
            lit[before] = shadow.faced(solid, seen.face[before])
            if body.parts is not None:
                points = camera.to_body(rays[before] * seen.range[before][:, None])
                labels[before] = body.parts.labels_at(body.mesh, seen.face[before], pose.back(points))
        nearest[~np.isfinite(nearest)] = 0
        sample = shadow.sample(key, nearest, lit)
        return _Scene(nearest, sample, person, thing, labels, len(bodies), len(layers) - 1)


@dataclass(frozen=True)
class _Scene:
    """A room before it is measured, as of `Room`. nearest: float32 [H, W], metres. sample: for a sensor's artifacts."""

    nearest: NDArray[np.float32]
    sample: Sample | None
    person: NDArray[np.int32]
    thing: NDArray[np.int32]
    labels: NDArray[np.uint8]
    people: int
    things: int


class _Shadow:
    """What the projector of a sensor sees of a room, if artifacts need it; the sensor may be None."""

    def __init__(self, sensor: Augmentation | None, camera: PlacedCamera) -> None:
        self._sensor, self._solids = sensor, list[Solid]()
        if sensor is not None:
            rig = sensor.rig
            axes = rig.camera.axes.T @ camera.axes
            origin = camera.position - np.asarray(rig.camera.position_m) @ axes
            at = np.asarray(rig.projector.position_m) @ axes + origin
            self._projector = PlacedCamera(rig.projector, rig.projector.axes @ axes, at)

    def faced(self, solid: Solid, faces: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Mark `faces` [N] of a solid of the room that turn to the projector, bool [N]."""
        if self._sensor is None or not len(solid.faces):
            return np.ones(len(faces), np.bool_)
        self._solids.append(solid)
        offsets = self._projector.position - solid.vertices[solid.faces[:, 0]]
        return np.asarray(np.einsum("ij,ij->i", solid.normals, offsets) > 0)[faces]

    def sample(self, key: str, nearest: NDArray[np.float32], lit: NDArray[np.bool_]) -> Sample | None:
        """A sample of the scene, without labels. nearest: metres, 0 = nothing."""
        if self._sensor is None:
            return None
        step_m, occluders = self._sensor.rig.range_step_m, None
        if self._sensor.needs_projector:
            first = np.full(self._sensor.rig.projector_shape, np.inf, np.float32)
            for solid in self._solids:
                seen = RasterRenderer(solid).render(self._projector)
                np.copyto(first, seen.range, where=(seen.face >= 0) & (seen.range < first))
            occluders = _whole_steps(first, step_m)
        labels = np.where(nearest > 0, 0, BACKGROUND).astype(np.uint8)
        return Sample(key, _whole_steps(nearest, step_m), occluders, labels, lit & (nearest > 0), SampleInfo("train"))


def _whole_steps(range_m: NDArray[np.float32], step_m: float) -> NDArray[np.uint16]:
    counted = np.rint(range_m / step_m)
    return np.where(counted <= float(FARTHEST_STEPS), counted, 0).astype(np.uint16)


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
    nearest = np.where(np.isfinite(nearest), nearest, 0.0)
    sigma = _NOISE.sigma_m(nearest.ravel(), np.zeros(nearest.size, np.float32)).reshape(nearest.shape)
    noisy = nearest + draws.normal(0.0, 1.0, nearest.shape) * sigma
    lost = (nearest == 0) | (draws.random(nearest.shape) < 0.02)
    lost[:, 1:] |= np.abs(np.diff(nearest, axis=1)) > 0.25
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

    Returns plain JSON: `Counts.to_json` "before" and "after" the score, the surfaces that the network need not label,
    and the score's processor time, milliseconds a frame.
    """
    before, after, seconds, spared = Counts(), Counts(), 0.0, 0
    for done, (segmenter, room) in enumerate(_frames(network, count)):
        result = segmenter(room.range_m)
        start = time.thread_time()
        shapes = [score.seen(body.pixels, room.range_m, segmenter.camera) for body in result.bodies]
        people = people_of(score, result.bodies, shapes)
        seconds += time.thread_time() - start
        spared += sum(map(score.rules_out, shapes))
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
        "not_labelled": spared,
        "score_ms": round(1000 * seconds / count, 3),
    }


def people_of(score: PersonScore, bodies: Sequence[LabelledBody], shapes: Sequence[SeenShape]) -> list[LabelledBody]:
    """The bodies that are people by their shapes and confidences."""
    judged = zip(bodies, shapes, strict=True)
    return [
        body
        for body, shape in judged
        if not score.rules_out(shape) and score(shape, float(body.confidence.mean())) >= score.cutoff
    ]


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
