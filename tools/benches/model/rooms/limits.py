"""`bench limits`: fit the confidence of labels that tells people from things to a network, and measure it on others.

`least_confidence_of_people` in the figures is the entry of that name in the network's card. docs/reference/things.md
says how to read the results.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from benches.measuring import counter
from benches.model.chosen import chosen_network
from benches.model.rooms.made import HELD_OUT, make
from bodyseg_data.core import BadConfig, ProgressCallback, silent
from bodyseg_data.machine import processors
from bodyseg_data.rooms.furnishings import FURNISHINGS
from bodyseg_data.rooms.room_packing import draw_people
from bodyseg_data.rooms.scenes import RoomPerson
from bodyseg_data.samples import Split
from bodyseg_model.networks import load_network
from bodyseg_model.segmentation import FrameLabeller
from bodyseg_model.segmentation.segmenter import LEAST_CONFIDENCE

LOST: Final = 0.02
"""Share of the people found, in rooms that the limit is fitted to, that may be below it."""

PERSON: Final = 0.5
"""A body is somebody if this share of its pixels is; else it is a thing."""

_ROOMS: Final[dict[Split, tuple[str, ...]]] = {
    "train": tuple(kind for kind in FURNISHINGS if kind not in HELD_OUT),
    "test": HELD_OUT,
}
"""Split of the people -> kinds of things around them."""

_ROOMS_A_TASK: Final = 20
_CURVE: Final = (0.002, 0.005, 0.01, 0.02, 0.05)

Bodies = NDArray[np.float64]
"""Of bodies [N, 2]: what is compared with the limit, and share of pixels that show somebody."""


def bench_limits(views: int = 200, runs: Sequence[Path] = (), progress: ProgressCallback = silent) -> dict[str, Any]:
    """Fit the limit to the network of the first run, or the one that ships, on what the finder finds in `views` made
    rooms, and measure it in as many others. Raises BadConfig for rooms in which nobody is found.
    """
    name, run = chosen_network(runs)[0], runs[0] if runs else None
    advance, found = counter(progress, 2 * -(-views // _ROOMS_A_TASK)), {}
    for split in _ROOMS:
        parts = []
        with ProcessPoolExecutor(processors(), multiprocessing.get_context("spawn")) as pool:
            tasks = [range(first, min(first + _ROOMS_A_TASK, views)) for first in range(0, views, _ROOMS_A_TASK)]
            for part in pool.map(partial(_bodies, split, run), tasks):
                parts.append(part)
                advance()
        found[split] = np.concatenate(parts)
    least = fitted(found["train"], LOST)
    return {
        "network": name,
        "rooms": views,
        "lost at most": LOST,
        "fit": quality(found["train"], least),
        "test": quality(found["test"], least),
        "curve": [quality(found["test"], fitted(found["train"], lost)) | {"lost at most": lost} for lost in _CURVE],
        LEAST_CONFIDENCE: least,
    }


@cache
def _people(split: Split) -> list[RoomPerson]:
    return draw_people(split, 0)


def _bodies(split: Split, run: Path | None, rooms: range) -> Bodies:
    """The bodies that are found in rooms, however unsure both networks are of them."""
    torch.set_num_threads(1)
    labeller = FrameLabeller(load_network(run), keep_things=True, device="cpu")
    made = (make(f"limits {split}", number, _people(split), _ROOMS[split]) for number in rooms)
    rows = [
        (body.person * body.confidence.mean(), (room.person.ravel()[body.pixels] > 0).mean())
        for room in made
        for body in labeller(room.range_m, room.camera).bodies
    ]
    return np.array(rows, np.float64).reshape(-1, 2)


def fitted(bodies: Bodies, lost: float) -> float:
    """The limit that loses that share of the people, in three decimals. Raises BadConfig without any."""
    people = np.sort(bodies[bodies[:, 1] >= PERSON, 0])
    if not len(people):
        raise BadConfig("nobody is found in the rooms to fit to: give bench limits more --views")
    return float(np.floor(1000 * people[int(lost * len(people))]) / 1000)


def quality(bodies: Bodies, least: float) -> dict[str, Any]:
    """People and things among bodies; of them, people lost and things kept by a limit."""
    person, kept = bodies[:, 1] >= PERSON, bodies[:, 0] >= least
    return {
        "least": least,
        "people": int(person.sum()),
        "people_lost": int((person & ~kept).sum()),
        "things": int((~person).sum()),
        "things_kept": int((~person & kept).sum()),
    }
