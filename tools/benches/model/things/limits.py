"""`bench limits`: fit the limit between people and things to a network, and measure it on rooms of other things.

`least_confidence_of_people` in the figures is the entry of that name in the network's card. docs/reference/things.md
says how to read the results.
"""

from __future__ import annotations

import math
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from benches.model.chosen import chosen_network
from benches.model.things.rooms import KINDS, LEAST_SEEN_M2, OTHER_KINDS, Rooms
from benches.model.things.shapes import THING
from bodyseg_data.artifacts import PAPER_SENSOR, Augmentation, load_sensor_model, sensor_model_names
from bodyseg_data.bodies import BodyRef, BodySource, open_source
from bodyseg_data.core import BadConfig, ProgressCallback, silent
from bodyseg_data.machine import processors
from bodyseg_data.rigs import load_rig, load_sensor
from bodyseg_data.samples import Split
from bodyseg_model.networks import Trained, load_network
from bodyseg_model.segmentation import PersonScore, Segmenter, shipped_score
from bodyseg_model.segmentation.person_score import CARD_ENTRY, SeenShape


@dataclass(frozen=True)
class Plan:
    """Rooms with people of a source's split and things of some kinds; without kinds, people alone, as if the background
    had been removed. touching: as of `Rooms`.
    """

    source: str
    split: Split
    kinds: tuple[str, ...] = ()
    touching: bool = False


_NEW: Final = ("post", "board", "sofa")  # to the network of shapes, which is less often wrong of what it was fitted to
_UNSEEN: Final = ("curtain", "coats", "cushioned bed")

FIT: Final = (
    Plan("wide", "train", tuple(KINDS)),
    Plan("wide", "train", _NEW),
    Plan("wide", "train"),
    Plan("everyday", "train", _NEW, touching=True),
)
"""Rooms that limits are fitted to."""

TEST: Final = (
    Plan("open", "test", _UNSEEN),
    Plan("hard", "test", _UNSEEN),
    Plan("open", "test"),
    Plan("hard", "test"),
    Plan("open", "test", _UNSEEN, touching=True),
)
"""Rooms to measure on."""

SEEDS: Final = 52, 61
SENSORS: Final = (*sensor_model_names(), PAPER_SENSOR, PAPER_SENSOR)
"""In turn; the paper's has by far the most noise."""

_ROOMS_A_TASK: Final = 20
BODIES: Final = 16
"""Bodies of each source: to build one takes a second."""

DRAWS: Final = 3
"""Frames of a room, each with other artifacts."""

LOST: Final = 0.04
"""Share of the people's surfaces that may be below the cutoff; those count that show at least `LEAST_SEEN_M2`. Rooms to
fit to are harder than most: people touch furniture, and many surfaces are a piece of one.
"""

WAYS: Final = ("shape", "confidence", "both")
"""What a score may count."""

_ALONE: Final = 0.8  # share of a person's pixels on a surface
_STRONG_M: Final = 0.05

Floats = NDArray[np.float64]
Marks = NDArray[np.bool_]


@dataclass(frozen=True)
class Judged:
    """Surfaces of a body's size, float64 [N] each: logarithm of the odds by shape, noise in metres, mean confidence of
    the network, area in square metres, and share of pixels that show a person. sensor: its name, str [N].
    """

    odds: Floats
    noise_m: Floats
    confidence: Floats
    area_m2: Floats
    share: Floats
    sensor: NDArray[np.str_]

    @property
    def person(self) -> Marks:
        """Surfaces that show a person and hardly anything else, and are large enough to count, bool [N]."""
        return (self.share >= _ALONE) & (self.area_m2 >= LEAST_SEEN_M2)

    @property
    def joined(self) -> Marks:
        """Surfaces that show a person and a thing, bool [N]: neither answer is right."""
        return (self.share > THING) & (self.share < _ALONE) & (self.share * self.area_m2 >= LEAST_SEEN_M2)

    @property
    def thing(self) -> Marks:
        """Surfaces that show nobody, bool [N]."""
        return self.share <= THING

    @property
    def seen(self) -> list[tuple[SeenShape, float]]:
        """Arguments of a score for each."""
        shapes = map(SeenShape, self.odds.tolist(), self.noise_m.tolist(), self.area_m2.tolist())
        return list(zip(shapes, self.confidence.tolist(), strict=True))


def bench_limits(
    views: int = 200, runs: Sequence[Path] = (), data: str | None = None, progress: ProgressCallback = silent
) -> dict[str, Any]:
    """Fit limits to the network of the first run, or the one that ships, on `views` made rooms, and measure them on as
    many others. data: folder of real frames with masks, NNN_depth.png and NNN_person.png, to measure on as well.
    """
    name, trained = chosen_network(runs)
    network = runs[0] if runs else None
    fit, test = (
        judged(network, plans, views, seed, partial(_later, progress, half * views, 2 * views))
        for half, (plans, seed) in enumerate(zip((FIT, TEST), SEEDS, strict=True))
    )
    limits = {way: fitted(fit, way) for way in WAYS}
    both = limits["both"]
    return {
        "network": name,
        "rooms": views,
        "fitted to": {"people": int(fit.person.sum()), "things": int(fit.thing.sum())},
        "lost at most": LOST,
        "ways": {way: {"cutoff": limit.cutoff, **quality(limit, test)} for way, limit in limits.items()},
        "sensors": {sensor: quality(both, test, test.sensor == sensor) for sensor in sorted(set(test.sensor.tolist()))},
        "noise of 50 mm and more": quality(both, test, test.noise_m >= _STRONG_M),
        "curves": {way: curve(way, test) for way in WAYS},
        "real": None if data is None else real(trained, both.cutoff, Path(data)),
        "fit": quality(both, fit),
        CARD_ENTRY: both.cutoff,
    }


def _later(progress: ProgressCallback, before: int, total: int, done: int, _: int) -> None:
    progress(before + done, total)


def judged(network: Path | None, plans: Sequence[Plan], count: int, seed: int, progress: ProgressCallback) -> Judged:
    """Surfaces of `count` rooms, in turn by plan and sensor, each seen `DRAWS` times through `all` of the sensor.

    network: of a run's folder, or the one that ships. A process for each processor makes and labels the rooms.
    """
    tasks = [
        (network, plans, range(first, min(first + _ROOMS_A_TASK, count)), seed)
        for first in range(0, count, _ROOMS_A_TASK)
    ]
    rows: list[tuple[Any, ...]] = []
    with ProcessPoolExecutor(processors(), multiprocessing.get_context("spawn")) as pool:
        for (_, _, rooms, _), found in zip(tasks, pool.map(_judged, *zip(*tasks, strict=True)), strict=True):
            rows += found
            progress(rooms.stop, count)
    return Judged(*(np.array(column) for column in zip(*rows, strict=True)))


def _judged(network: Path | None, plans: Sequence[Plan], numbers: range, seed: int) -> list[tuple[Any, ...]]:
    """Fields of `Judged` of the surfaces in rooms."""
    torch.set_num_threads(1)
    trained, rows = _trained(network), []
    score = shipped_score(trained.card)
    for number in numbers:
        plan, sensor = plans[number % len(plans)], SENSORS[(number // len(plans) + number) % len(SENSORS)]
        rooms = _rooms(plan, sensor, seed)
        segmenter = Segmenter(trained.network, rooms.camera, rig=trained.rig)
        for draw in range(DRAWS):
            room = rooms(number, draw)
            for body in segmenter(room.range_m).bodies:
                shape = score.seen(body.pixels, room.range_m, rooms.camera)
                ranges = room.range_m.ravel()[body.pixels].astype(np.float64)
                area = float(np.square(ranges).sum()) / rooms.camera.focal_px**2
                share = float((room.person.ravel()[body.pixels] >= 0).mean())
                rows.append((shape.odds, shape.noise_m, float(body.confidence.mean()), area, share, sensor))
    return rows


_trained = cache(load_network)


@cache
def _rooms(plan: Plan, sensor: str, seed: int) -> Rooms:
    opened, bodies = _bodies(plan.source, plan.split)
    rig, kinds = load_rig(sensor), {name: {**KINDS, **OTHER_KINDS}[name] for name in plan.kinds}
    all_of_it = Augmentation(rig, "all", seed, load_sensor_model(sensor))
    return Rooms(opened, bodies, rig.camera, seed, False, plan.touching, kinds, all_of_it)


@cache
def _bodies(source: str, split: Split) -> tuple[BodySource, list[BodyRef]]:
    opened = open_source(source)
    bodies = [body for body in opened.bodies() if body.split == split]
    return opened, bodies[:: max(1, len(bodies) // BODIES)][:BODIES]


def fitted(surfaces: Judged, way: str = "both") -> Limit:
    """Choose the cutoff that loses `LOST` of the people. Raises BadConfig without any."""
    if not surfaces.person.any():
        raise BadConfig("the rooms to fit to show nobody: give bench limits more --views")
    people = np.sort(scores(way, surfaces)[surfaces.person])
    return Limit(way, math.floor(1e3 * people[int(LOST * len(people))]) / 1e3)


class Limit(NamedTuple):
    """What a score counts, of `WAYS`, and its cutoff."""

    way: str
    cutoff: float


def scores(way: str, surfaces: Judged) -> Floats:
    """Score of a person, [N]."""
    if way == "confidence":
        return surfaces.confidence
    score = PersonScore(shipped_score().by_shape, 0.5, way == "both")
    out = [score.by_confidence and score.rules_out(shape) for shape, _ in surfaces.seen]
    found: Floats = np.array([score(*each) for each in surfaces.seen]) * ~np.array(out)
    return found


def quality(limit: Limit, surfaces: Judged, chosen: Marks | None = None) -> dict[str, Any]:
    """People, things and what shows both among some surfaces; of them, people lost, and things and both kept."""
    kept = scores(limit.way, surfaces) >= limit.cutoff
    some = np.ones(len(kept), np.bool_) if chosen is None else chosen
    person, thing = surfaces.person & some, surfaces.thing & some
    return {
        "people": int(person.sum()),
        "people_lost": int((person & ~kept).sum()),
        "things": int(thing.sum()),
        "things_kept": int((thing & kept).sum()),
        "joined": int((surfaces.joined & some).sum()),
        "joined_kept": int((surfaces.joined & some & kept).sum()),
    }


def curve(way: str, surfaces: Judged, points: int = 60) -> dict[str, list[float]]:
    """Precision and recall of surfaces at cutoffs between all people and none."""
    found, person = scores(way, surfaces), surfaces.person
    order = np.sort(found[person])
    steps = order[np.linspace(0, len(order) - 1, min(points, len(order))).astype(int)]
    people = np.array([(found[person] >= step).sum() for step in steps])
    things = np.array([(found[surfaces.thing] >= step).sum() for step in steps])
    return {
        "precision": (people / (people + things)).round(4).tolist(),
        "recall": (people / person.sum()).round(4).tolist(),
    }


# Real frames with masks of people.


_WITHIN_PX: Final = 15
_BELOW_PX: Final = 60
"""A labelled pixel within so many pixels of a mask, or so many below that, is the person's: masks err at borders, and
lack lower legs."""


def real(trained: Trained, cutoff: float, folder: Path) -> dict[str, Any]:
    """Of labelled pixels the share that is a person's, and of the masks the share that is labelled, for each way to
    tell people from things; camera: a Kinect v1.
    """
    camera = load_sensor("kinect_v1").camera
    alone = shipped_score({})
    score = PersonScore(alone.by_shape, cutoff, True)
    segmenter = Segmenter(trained.network, camera, rig=trained.rig)
    counts = {way: np.zeros(4, np.int64) for way in ("every surface", "shape", "both")}
    for range_m, mask in _frames(folder):
        own = _near(mask)
        for body in segmenter(range_m).bodies:
            shape = score.seen(body.pixels, range_m, camera)
            kept = {
                "every surface": True,
                "shape": not alone.rules_out(shape),
                "both": not score.rules_out(shape) and score(shape, float(body.confidence.mean())) >= cutoff,
            }
            for way, keep in kept.items():
                if keep:
                    at = own.ravel()[body.pixels]
                    counts[way] += (1, len(at), at.sum(), mask.ravel()[body.pixels].sum())
    frames = sum(1 for _ in folder.glob("*_person.png"))
    masked = sum(int(mask.sum()) for _, mask in _frames(folder))
    return {
        "frames": frames,
        **{
            way: {
                "surfaces": int(surfaces),
                "precision": round(float(own / labelled), 4) if labelled else None,
                "recall": round(float(seen / masked), 4),
            }
            for way, (surfaces, labelled, own, seen) in counts.items()
        },
    }


def _frames(folder: Path) -> Iterator[tuple[NDArray[np.float32], Marks]]:
    for file in sorted(folder.glob("*_person.png")):
        with Image.open(file) as mask, Image.open(file.with_name(file.name.replace("person", "depth"))) as depth:
            yield (np.asarray(depth) / 1000).astype(np.float32), np.asarray(mask) > 0


def _near(mask: Marks) -> Marks:
    """True within `_WITHIN_PX` of a mask, and down to `_BELOW_PX` below that."""
    from scipy.ndimage import distance_transform_edt

    near = distance_transform_edt(~mask) <= _WITHIN_PX if mask.any() else mask
    below: Marks = near.copy()
    for step in range(1, _BELOW_PX + 1):
        below[step:] |= near[:-step]
    return below
