"""People among things: who is found in made rooms and what is labelled, with and without the score of persons."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.sources import open_source
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.core.rig import load_sensor
from bodyseg_data.core.splits import Split
from bodyseg_data.core.system.progress import ProgressCallback, silent
from bodyseg_model.networks.network import Network
from bodyseg_model.segmentation.person_score import PersonScore
from bodyseg_model.segmentation.segmenter import LabelledBody, Segmenter
from bodyseg_model.stability.rooms import Room, Rooms

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
