"""`bench rooms`: who is found in made rooms of things never trained on and in real frames, how fast, and who is not.

docs/reference/things.md says how to read the results.
"""

from __future__ import annotations

import multiprocessing
import statistics
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from benches.measuring import Figures
from benches.model.rooms.finders import Finder, Found, network_finder, segment_finder
from benches.model.rooms.made import HELD_OUT, SEED, SENSORS, SETS, UNSEEN, make
from benches.model.rooms.parts import mirrored_parts
from benches.model.rooms.real import ROOM, THRESHOLDS, Marks, real, room_frames
from benches.model.rooms.tallies import THRESHOLD, by_kind, by_property, by_set, counted, merged
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.files import read_json
from bodyseg_data.labels import UNLABELLED
from bodyseg_data.machine import processors, torch_threads
from bodyseg_data.rigs import Camera, load_sensor
from bodyseg_data.rooms.room_packing import draw_people
from bodyseg_data.rooms.scenes import RoomPerson
from bodyseg_model.networks import load_network, predict
from bodyseg_model.segmentation.finder import shipped_finder

SHARES: Final = {UNSEEN: 0.5, "all kinds": 0.4, "nobody": 0.1}
"""Of all made rooms, those of each set."""

WAYS: Final = ("finder", "finder, every second pixel", "segment, sure or not", "segment")
DEFAULT: Final = WAYS[-1]
"""The way of which pictures and properties are shown."""

BLOCKS: Final = 2
"""Blocks of people of the test split (`draw_people`): to build one takes a minute."""

SEARCH: Final = Path(__file__).with_name("search.json")
"""What this bench measured of `segment` when planes, surfaces and their shapes told people from rooms."""

UNSEEN_FINDER: Final = Path(__file__).with_name("unseen_finder.safetensors")
"""Weights of a finder that was trained without `HELD_OUT`: the one from which the shipped one was trained further."""

_ROOMS_A_TASK: Final = 20
_SHOWN: Final = 8, 2
"""Pictures of failures, in made rooms and in the real one."""

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Failure:
    """A frame in which much is wrong. wrong_m2: surface wrongly labelled or missed. picture: uint8 [h, w, 3]."""

    name: str
    wrong_m2: float
    picture: Picture = field(repr=False)


def bench_rooms(
    views: int = 480, data: str | None = None, runs: Sequence[Path] = (), progress: ProgressCallback = silent
) -> Figures:
    """Measure all `WAYS` in `views` made rooms, by processes, and in real frames, in this one.

    data: folder of real frames, with the room's; without, made rooms alone. runs: the first is the finder for the
    rooms of unseen kinds, by default `UNSEEN_FINDER`; all others are for the one that ships.
    """
    run = runs[0] if runs else UNSEEN_FINDER
    numbers = [(of, number) for of, part in SHARES.items() for number in range(round(part * views))]
    tasks = [numbers[first : first + _ROOMS_A_TASK] for first in range(0, len(numbers), _ROOMS_A_TASK)]
    total = len(tasks) + len(WAYS)
    found: list[tuple[dict[str, Any], list[Failure]]] = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processors(), context) as pool:
        people = [person for block in pool.map(draw_people, ["test"] * BLOCKS, range(BLOCKS)) for person in block]
    with ProcessPoolExecutor(processors(), context, _meet, (people,)) as pool:
        for each in pool.map(_measured, tasks, [run] * len(tasks)):
            found.append(each)
            progress(len(found), total)
    tallies = {name: merged(each[name] for each, _ in found) for name in WAYS}
    failures = _worst([failure for _, worst in found for failure in worst], _SHOWN[0])
    figures: dict[str, Any] = {name: {"made": by_set(tally)} for name, tally in tallies.items()}
    with torch_threads(1):
        finders = _finders(None)
        if data is not None:
            for done, (name, finder) in enumerate(finders.items()):
                figures[name]["real"] = real(finder, Path(data), THRESHOLDS[:1])
                progress(len(tasks) + done + 1, total)
            failures += _real_failures(finders[DEFAULT], Path(data))
        parts = {} if data is None else {"mirrored": mirrored_parts(Path(data))}
        times = _times(finders, None if data is None else Path(data))
    for name in WAYS:
        figures[name]["ms"] = times[name]
    return Figures(
        {
            "seed": SEED,
            "threshold": THRESHOLD,
            "blocks of people": BLOCKS,
            "sensors": SENSORS,
            "held out": HELD_OUT,
            "default": DEFAULT,
            "compact_ms": times["compact"],
            "ways": figures,
            "before": read_json(SEARCH),
            "kinds": by_kind([thing for thing in tallies[DEFAULT]["things"] if thing["of"] == UNSEEN]),
            "properties": by_property(tallies[DEFAULT]),
            **parts,
        },
        failures,
    )


_people: Final[list[RoomPerson]] = []
"""Of all rooms, in a process that makes them."""


def _meet(people: Sequence[RoomPerson]) -> None:
    """Keep the people in this process; a list's own method would be copied with its list."""
    _people[:] = people


@cache
def _finders(run: Path | None) -> dict[str, Finder]:
    trained = load_network(run) if run else shipped_finder()
    network = trained.network
    found = (
        network_finder(network),
        network_finder(network, 2),
        segment_finder(trained, True),
        segment_finder(trained),
    )
    return dict(zip(WAYS, found, strict=True))


def _measured(rooms: Sequence[tuple[str, int]], run: Path) -> tuple[dict[str, Any], list[Failure]]:
    """Counts of rooms for each way, and the worst failures of the default one. run: as of `bench_rooms`."""
    torch.set_num_threads(1)
    tallies: dict[str, Any] = {name: [] for name in WAYS}
    failures = []
    for of, number in rooms:
        kinds = SETS[of] if of != UNSEEN else (HELD_OUT[number % len(HELD_OUT)],)
        room = make(of, number, () if of == "nobody" else _people, kinds)
        for name, finder in _finders(run if of == UNSEEN else None).items():
            answer = finder(room.range_m, room.camera)
            tallies[name].append(counted(room, answer))
            if name == DEFAULT:
                body = (room.person > 0) & (room.labels < UNLABELLED)
                failures.append(_failure(room.sensor, room.range_m, room.camera, body, body, answer))
    return {name: merged(each) for name, each in tallies.items()}, _worst(failures, _SHOWN[0])


def _times(finders: dict[str, Finder], data: Path | None) -> dict[str, float]:
    """Processor time of each way, milliseconds a frame of 640 x 480, median of some, in turns; and of the network that
    labels, on an image of that size, by which runs of two machines compare.
    """
    camera = load_sensor("kinect_v1").camera
    frames = (
        [np.full((480, 640), 2.5, np.float32)] if data is None else [f.range_m for f in room_frames(data / ROOM)[::4]]
    )
    network, whole = load_network().network, torch.full((1, 1, 480, 640), 2.5)
    seconds: dict[str, list[float]] = {name: [] for name in (*finders, "compact")}
    for range_m in [frames[0], *frames]:
        for name, finder in finders.items():
            start = time.process_time()
            finder(range_m, camera)
            seconds[name].append(time.process_time() - start)
        start = time.process_time()
        predict(network, whole)
        seconds["compact"].append(time.process_time() - start)
    return {name: round(1000 * statistics.median(each[1:]), 2) for name, each in seconds.items()}


def _real_failures(finder: Finder, data: Path) -> list[Failure]:
    frames = room_frames(data / ROOM)
    failures = [
        _failure(f"real room, {frame.name}", frame.range_m, frame.camera, frame.person, frame.near, answer)
        for frame in frames
        for answer in [finder(frame.range_m, frame.camera)]
    ]
    return _worst(failures, _SHOWN[1])


def _failure(
    name: str, range_m: NDArray[np.float32], camera: Camera, body: Marks, near: Marks, found: Found
) -> Failure:
    """Mistakes in a frame. near: where labelled pixels count as right."""
    labelled = found.person >= THRESHOLD
    area = np.square(range_m.astype(np.float64)) / camera.focal_px**2
    wrong, missed = labelled & ~near, body & ~labelled
    colours = {(90, 200, 90): labelled & near, (230, 60, 50): wrong, (60, 110, 250): missed}
    picture = _shaded(range_m, camera)
    for colour, marks in colours.items():
        picture[marks] = 0.45 * picture[marks] + 0.55 * np.array(colour)
    return Failure(name, float(area[wrong | missed].sum()), picture[::2, ::2].astype(np.uint8))


def _shaded(range_m: NDArray[np.float32], camera: Camera) -> NDArray[np.float64]:
    """A range image lit from the upper left, [H, W, 3], 0 to 255; black where nothing was measured."""
    from scipy.ndimage import median_filter

    smooth = median_filter(range_m, 5)
    down, across = np.gradient(np.where(smooth > 0, smooth, np.nan))
    slope = camera.focal_px / np.maximum(smooth, 0.1)
    light = (0.75 - slope * (0.4 * across + 0.5 * down)) / np.sqrt(1 + slope**2 * (across**2 + down**2))
    grey = np.where(range_m > 0, 60 + 170 * np.nan_to_num(light.clip(0, 1)), 0)
    return np.repeat(grey[..., None], 3, axis=2)


def _worst(failures: Sequence[Failure], count: int) -> list[Failure]:
    return sorted(failures, key=lambda failure: -failure.wrong_m2)[:count]
