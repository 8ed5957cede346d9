"""`bench segment`: times of every stage of `bodyseg segment`, beside the people it finds and the labels it gets right.

The command runs as its users call it, on recordings of made rooms with known labels: in both precisions,
beside a busy program, with a label on every surface, without pictures, and with the network on
OpenVINO. `live` gives the age of a live sensor's frames, which come as arrays, when their labels are there.
docs/results/segment.md has the results.
"""

from __future__ import annotations

import contextlib
import io
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from benches.measuring import counter, medians
from benches.model.rooms.made import SEED, SETS, Made, make
from benches.model.rooms.tallies import LEAST_SEEN_M2
from benches.model.segment.live import live
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.labels import BACKGROUND, UNLABELLED
from bodyseg_data.machine import computes_bfloat16, hardware
from bodyseg_data.rigs import Camera, load_sensor
from bodyseg_data.rooms.room_packing import draw_people
from bodyseg_model.commands import segment
from bodyseg_model.networks import load_network
from bodyseg_model.runtimes import BackendName, Precision
from bodyseg_model.segmentation import FrameLabeller
from bodyseg_model.segmentation.pictures import encode_picture

_SQUARE: Final = 1024
_SQUARE_FOCAL_PX: Final = 840.0
"""Of the larger camera: it sees 63 degrees, up and across, and so about as much of a person as a Kinect v1."""

STAGES: Final = ("read", "find", "resample", "network", "back", "write")


@dataclass(frozen=True)
class Way:
    """One way to call the command. options: of the command, besides its frames. busy:
    another program computes all the time, in one thread.
    """

    options: dict[str, Any] = field(default_factory=dict)
    busy: bool = False


_FLOAT32: Final = {"precision": "float32"}
_BFLOAT16: Final = {"precision": "bfloat16"}
_OPENVINO: Final = {"backend": "openvino", **_BFLOAT16}

WAYS: Final = {
    "bfloat16": Way(options=_BFLOAT16),
    "float32": Way(options=_FLOAT32),
    "beside a busy program": Way(options=_FLOAT32, busy=True),
    "beside it, one thread": Way(options={**_FLOAT32, "threads": 1}, busy=True),
    "one thread": Way(options={**_FLOAT32, "threads": 1}),
    "things labelled, too": Way(options={**_FLOAT32, "keep_things": True}),
    "no pictures": Way(options={**_FLOAT32, "no_overlay": True}),
    "flip average": Way(options={**_FLOAT32, "flip_average": True}),
    "bfloat16, flip average": Way(options={**_BFLOAT16, "flip_average": True}),
    "OpenVINO": Way(options={"backend": "openvino", **_FLOAT32}),
    "OpenVINO, bfloat16": Way(options=_OPENVINO),
    "OpenVINO, bfloat16, one thread": Way(options={**_OPENVINO, "threads": 1}),
}
"""Name -> way; in float32 where no name says another precision."""

ROUNDS: Final = 3

LIVE: Final[dict[str, tuple[BackendName | None, Precision | None]]] = {
    "bfloat16": (None, "bfloat16"),
    "float32": (None, "float32"),
    "OpenVINO, bfloat16": ("openvino", "bfloat16"),
}
"""Ways to label a live sensor's frames: backend and precision of each."""


def bench_segment(views: int = 24, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Run the command in every one of `WAYS` on recordings of `views` made rooms, of 640 x 480 and of 1024 x 1024.

    In `ROUNDS` rounds, each way in turn: every figure is the median of all rounds.
    """
    chosen = cameras()
    advance = counter(progress, len(chosen) * (views + ROUNDS * len(WAYS)))
    sizes: dict[str, Any] = {}
    for name, camera in chosen.items():
        with TemporaryDirectory() as folder:
            frames = Path(folder) / "frames"
            frames.mkdir()
            rooms = []
            for number, room in enumerate(made_rooms(camera, views)):
                millimetres = np.rint(1000 * room.range_m).astype(np.uint16)
                (frames / f"{number}.png").write_bytes(encode_picture(millimetres))
                rooms.append(room)
                advance()
            rounds: dict[str, list[dict[str, Any]]] = {way: [] for way in WAYS}
            for _ in range(ROUNDS):
                for way, facts in WAYS.items():
                    rounds[way].append(_measured(facts, frames, Path(folder) / way, camera, rooms))
                    advance()
            ways = {way: _of_all(of_way) for way, of_way in rounds.items()}
        live_ages = {
            way: live(
                FrameLabeller(load_network(), backend=runtime, precision=bits, device="cpu"),
                camera,
                [room.range_m for room in rooms],
            )
            for way, (runtime, bits) in LIVE.items()
        }
        sizes[name] = {"focal_px": camera.focal_px, "live": live_ages, "ways": ways}
    return {
        "default": "bfloat16" if computes_bfloat16() else "float32",
        "rooms": views,
        "seed": SEED,
        "threads": torch.get_num_threads(),
        "hardware": hardware(),
        "sizes": sizes,
    }


def cameras() -> dict[str, Camera]:
    """Size -> camera: a Kinect v1, and a larger one."""
    known, middle = load_sensor("kinect_v1").camera, _SQUARE / 2
    square = replace(known, rows=_SQUARE, columns=_SQUARE, focal_px=_SQUARE_FOCAL_PX, centre_px=(middle, middle))
    return {"640 x 480": known, "1024 x 1024": square}


def made_rooms(camera: Camera, count: int) -> Iterator[Made]:
    """Make rooms as a Kinect v1 with such a camera sees them, with people that no network was trained on."""
    people = draw_people("test", 0)
    for number in range(count):
        yield make("all kinds", number, people, SETS["all kinds"], "kinect_v1", camera)


def _of_all(rounds: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The medians of all rounds; `rounds` has the frames a second of each."""
    return {**medians(rounds), "rounds": [one["frames_per_second"] for one in rounds]}


def _measured(way: Way, frames: Path, out: Path, camera: Camera, rooms: Sequence[Made]) -> dict[str, Any]:
    """Times of every stage, frames a second, and accuracy of one call of the command."""
    options = segment.Options((frames,), out, focal=camera.focal_px, centre=camera.centre_px, **way.options)
    threads = torch.get_num_threads()
    beside = _busy_program() if way.busy else contextlib.nullcontext()
    with beside, contextlib.redirect_stderr(io.StringIO()):
        segment.run(options)
    torch.set_num_threads(threads)
    summary = json.loads((out / "summary.json").read_text())
    labels = []
    for number in range(len(rooms)):
        with Image.open(out / "labels" / f"{number}.png") as picture:
            labels.append(np.asarray(picture).copy())
    times = summary["ms"]
    return {
        "ms": {stage: times[stage] for stage in (*STAGES, "frame")},
        "ms_by_people": by_people(summary["each"]),
        "frames_per_second": summary["frames_per_second"],
        **accuracy(rooms, labels, 1 / camera.focal_px),
    }


def by_people(each: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Mean milliseconds from the file to the labels, by the number of people that got labels.

    each: of the summary. The first frame does not count, as in the summary's own times.
    """
    times: dict[int, list[float]] = {}
    for frame in each[1:]:
        times.setdefault(frame["people"], []).append(sum(ms for stage, ms in frame["ms"].items() if stage != "write"))
    return {str(people): {"mean": round(float(np.mean(ms)), 2)} for people, ms in sorted(times.items())}


@contextlib.contextmanager
def _busy_program() -> Iterator[None]:
    with subprocess.Popen([sys.executable, "-S", "-c", "while True: pass"]) as other:
        try:
            yield
        finally:
            other.kill()


def accuracy(rooms: Sequence[Made], labels: Sequence[NDArray[np.uint8]], pixel_m: float) -> dict[str, Any]:
    """Compare label images uint8 [H, W] with rooms.

    pixel_m: side of a pixel at 1 m, metres. people: that show at least `LEAST_SEEN_M2`; found: of them, half of the
    pixels have a label. right: share of all pixels of people with the right label. thing_pixels: labelled pixels that
    show no person.
    """
    people = found = pixels = right = thing_pixels = 0
    for room, image in zip(rooms, labels, strict=True):
        named, person = image != BACKGROUND, (room.person > 0) & (room.labels < UNLABELLED)
        for number in range(1, len(room.people) + 1):
            seen = person & (room.person == number)
            if ((pixel_m * room.range_m[seen]) ** 2).sum() >= LEAST_SEEN_M2:
                people += 1
                found += bool(named[seen].mean() >= 0.5)
        pixels += int(person.sum())
        right += int((person & named & (image == room.labels)).sum())
        thing_pixels += int((named & ~person).sum())
    share = round(right / pixels, 4) if pixels else None
    return {"people": people, "found": found, "person_pixels": pixels, "right": share, "thing_pixels": thing_pixels}
