"""Made rooms as a sensor sees them, with what is known of every person and thing in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts import Augmentation, load_sensor_model
from bodyseg_data.labels import BACKGROUND, UNLABELLED
from bodyseg_data.meshes import Solid
from bodyseg_data.rigs import Camera, load_rig, rig_names
from bodyseg_data.rooms.furnishings import FURNISHINGS
from bodyseg_data.rooms.scenes import Room, RoomPerson
from bodyseg_data.samples import HELD, Sample, SampleInfo, metres, steps

HELD_OUT: Final = ("sofa", "bicycle", "wheelchair", "coat_stand", "animal")
"""Kinds of things that the finder beside this file was not trained on; the one that ships was."""

UNSEEN: Final = "unseen kinds"
SETS: Final = {UNSEEN: HELD_OUT, "all kinds": tuple(FURNISHINGS), "nobody": tuple(FURNISHINGS)}
"""Name -> kinds of things in its rooms; of unseen kinds, each room has one."""

SENSORS: Final = rig_names()
SEED: Final = 2
_TOUCH_M: Final = 0.05
_TOUCH_PIXELS: Final = 5
_MOVED_PX: Final = 4
_POSTURES: Final = {"sitting": ("sitting", "on_a_chair"), "lying": ("lying", "on_the_")}

Labels = NDArray[np.uint8]


@dataclass(frozen=True)
class Who:
    """Somebody in a room. posture: standing, sitting or lying. gap_m: to the nearest wall, None without walls. touches:
    another person, or a thing that is not held. holds: a thing.
    """

    posture: str
    gap_m: float | None
    touches: str
    holds: bool


@dataclass(frozen=True)
class Made:
    """A made room. range_m: float32 [H, W], metres, 0 = nothing measured. person, thing: uint8 [H, W], from 1, 0
    elsewhere. labels: uint8 [H, W], parts of people, 254 on other surfaces, 255 where nothing is measured. people: by
    their numbers less one. kinds: of things, the same way.
    """

    of: str
    number: int
    sensor: str
    camera: Camera = field(repr=False)
    range_m: NDArray[np.float32] = field(repr=False)
    person: Labels = field(repr=False)
    thing: Labels = field(repr=False)
    labels: Labels = field(repr=False)
    people: tuple[Who, ...]
    kinds: tuple[str, ...]
    height_m: float
    pitch_deg: float


def make(
    of: str,
    number: int,
    people: Sequence[RoomPerson],
    kinds: Sequence[str],
    sensor: str = "",
    camera: Camera | None = None,
) -> Made:
    """Make the room of a number, with all artifacts of a sensor, by default one of `SENSORS`, in turn. camera: of other
    frames than its own.
    """
    sensor = sensor or SENSORS[number % len(SENSORS)]
    rig = load_rig(sensor) if camera is None else replace(load_rig(sensor), camera=camera)
    room = Room(f"{of.replace(' ', '-')}-{number}", rig, people, kinds, SEED)
    seen = room.render(with_things=True)
    near, lit = (
        steps(np.asarray(each, np.float32), rig.range_step_m, seen.key)
        for each in (seen.range_m, seen.projector_range_m)
    )
    facing = [*np.asarray(seen.facing).reshape(-1, *near.shape), None]
    sample = Sample(seen.key, near, lit, seen.labels, facing[0], SampleInfo("test"), facing[1])
    image = Augmentation(rig, "all", SEED, load_sensor_model(sensor))(sample)
    measured = image.range > 0
    labels = np.where(measured & (image.labels == BACKGROUND), UNLABELLED, image.labels).astype(np.uint8)
    body = labels < UNLABELLED
    # Artifacts that move borders move labels alone: who has moved is found nearby.
    person = (
        np.where(body & (seen.planes["person"] == 0), _widened(seen.planes["person"]), seen.planes["person"]) * body
    )
    thing = seen.planes["thing"] * (measured & ~body)
    names = tuple(room.things.values())
    return Made(
        of,
        number,
        sensor,
        rig.camera,
        metres(image.range, rig.range_step_m),
        person,
        thing,
        labels,
        tuple(_who(room, number, seen.range_m, seen.planes, names) for number in range(len(room.persons))),
        names,
        room.height_m,
        room.pitch_deg,
    )


def _widened(numbers: Labels) -> Labels:
    """The largest number within `_MOVED_PX`."""
    from scipy.ndimage import maximum_filter

    found: Labels = maximum_filter(numbers, 2 * _MOVED_PX + 1)
    return found


def _who(room: Room, number: int, range_m: NDArray[Any], planes: Any, names: tuple[str, ...]) -> Who:
    person, pose, _ = room.persons[number]
    vertices = pose.of(Solid(person.mesh.vertices, person.mesh.faces)).vertices
    gaps = [wall.offset - float((vertices @ wall.normal).max()) for wall in room.walls]
    own, held = planes["person"] == number + 1, np.array([False, *(name == HELD for name in names)])
    others = {
        "somebody": (planes["person"] > 0) & ~own,
        "a thing": (planes["thing"] > 0) & ~held[planes["thing"]],
        HELD: held[planes["thing"]],
    }
    met = [name for name, other in others.items() if _touch(own, other, range_m)]
    posture = next((name for name, words in _POSTURES.items() if person.pose.startswith(words)), "standing")
    touched = next((name for name in met if name != HELD), "nothing")
    return Who(posture, max(min(gaps), 0.0) if gaps else None, touched, HELD in met)


def _touch(one: NDArray[np.bool_], other: NDArray[np.bool_], range_m: NDArray[Any]) -> bool:
    """True if neighbouring pixels of the two have about the same range."""
    count = 0
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        near = np.abs(range_m[a] - range_m[b]) < _TOUCH_M
        count += int((near & ((one[a] & other[b]) | (other[a] & one[b]))).sum())
    return count >= _TOUCH_PIXELS
