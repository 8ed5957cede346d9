"""`bench shapes`: fit the small network that tells people from things by the shape of a surface, on made rooms.

`network` in the figures is the content of `bodyseg_model/weights/shape_network.json`. docs/reference/things.md
says how to read the results.
"""

from __future__ import annotations

import base64
import math
import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Final

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812  its name everywhere
from numpy.typing import NDArray
from torch import nn

from benches.model.things.rooms import LEAST_SEEN_M2, SENSORS, Rooms, rooms_of
from bodyseg_data.core import BadConfig, ProgressCallback, silent
from bodyseg_data.machine import processors
from bodyseg_data.samples import Split
from bodyseg_model.segmentation import Background, find_bodies
from bodyseg_model.segmentation.person_score import (
    FORMAT,
    MEASURES,
    SHAPES,
    SIDE,
    ShapeNetwork,
    SurfaceShape,
    shape_image,
    surface_shape,
    with_curvature,
)


@dataclass(frozen=True)
class Plan:
    """Made rooms: with people of a source's split, by a seed. touching: as of `Rooms`. share: of all rooms."""

    source: str
    split: Split
    seed: int
    touching: bool
    share: float

    def __str__(self) -> str:
        return f"{self.source}, {self.split} split, seed {self.seed}{', touching' if self.touching else ''}"


PLANS: Final = (
    Plan("wide", "train", 11, False, 6 / 11),
    Plan("everyday", "train", 13, True, 1 / 11),
    Plan("wide", "train", 12, True, 4 / 11),
)
"""Rooms to fit to, one in `HELD_OUT` left out."""

TESTS: Final = {
    "open": Plan("open", "test", 31, False, 0.06),
    "hard": Plan("hard", "test", 32, False, 0.06),
    "touching": Plan("open", "test", 33, True, 0.06),
}
"""Rooms to measure on, beside those held out."""

PERSON: Final = 0.5
"""A surface shows a person if this share of its pixels does, or `LEAST_SEEN_M2` of the person."""

THING: Final = 0.1
"""Greatest share for a thing; surfaces that are neither are left out."""

HELD_OUT: Final = 5
"""One room in so many is not fitted to, but measured."""

LOST: Final = 0.01
"""Share of the people's surfaces in the rooms held out that may be below the cutoff. They count if they show at least
`LEAST_SEEN_M2`.
"""

_ROOMS_A_TASK: Final = 20
_EPOCHS: Final = 25
_BATCH: Final = 64
_RATE: Final = 3e-3
_DECAY: Final = 1e-2
_DROPPED: Final = 0.2  # of the features before the hidden layer
_SHIFT: Final = 3  # cells, either way
_ERASED: Final = 0.35  # share of the images
_NOISE: Final = 0.01, 0.05  # of ranges, in units of the image; of measures, in standard deviations
_LOST: Final = (0, 1, 2, 5, 10)

Floats = NDArray[np.float64]
Image = NDArray[np.float32]


@dataclass(frozen=True)
class Shapes:
    """Surfaces of a body's size. images: float32 [N, 2, 48, 48] of `shape_image`. measures: float64 [N, 16]. person:
    bool [N]. room: int [N], their rooms, of all sources.
    """

    images: Image
    measures: Floats
    person: NDArray[np.bool_]
    room: NDArray[np.intp]

    @property
    def large(self) -> NDArray[np.bool_]:
        """Surfaces of at least `LEAST_SEEN_M2`, bool [N]."""
        return self.measures[:, MEASURES.index("log area")] >= math.log(LEAST_SEEN_M2)

    def at(self, chosen: NDArray[np.bool_]) -> Shapes:
        """Return some of them. chosen: bool [N]."""
        return Shapes(self.images[chosen], self.measures[chosen], self.person[chosen], self.room[chosen])


def bench_shapes(views: int = 20000, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Fit the network to four fifths of `views` made rooms, and measure it on the others, and on people of the test
    split.
    """
    counts = {name: max(1, round(plan.share * views)) for name, plan in TESTS.items()}
    rooms = views + sum(counts.values())
    seen = seen_shapes(PLANS, views, partial(_later, progress, 0, rooms))
    held = seen.room % HELD_OUT == 0
    fit, validation = seen.at(~held), seen.at(held)
    counted = validation.person & validation.large
    if not counted.any():
        raise BadConfig(f"no person shows {LEAST_SEEN_M2} m² in the rooms held out: give bench shapes more --views")
    network = fitted(fit)
    people = np.sort(logits(network, validation)[counted])
    network = replace(network, cutoff=1 / (1 + math.exp(-people[int(LOST * len(people))])))
    measured = {"held out": quality(network, validation)}
    before = views
    for name, count in counts.items():
        shapes = seen_shapes([replace(TESTS[name], share=1.0)], count, partial(_later, progress, before, rooms))
        measured[name] = quality(network, shapes)
        before += count
    source = {
        "command": f"tools/bench shapes --views {views}",
        "rooms": [f"{plan.share:.0%} {plan}" for plan in PLANS],
        "sensors": list(SENSORS),
        "fitted to": {"people": int(fit.person.sum()), "things": int((~fit.person).sum())},
        "cutoff": f"{LOST:.1%} of the people of {LEAST_SEEN_M2} m² lost in rooms not fitted to, one in {HELD_OUT}",
    }
    return {"measured": measured, "network": {"format": FORMAT, "source": source, **network_to_json(network)}}


def network_to_json(network: ShapeNetwork) -> dict[str, Any]:
    """A network as plain JSON that `network_from_json` reads: weights by name in base64 of float32, little-endian."""
    weights = {
        name: base64.b64encode(np.asarray(weight, "<f4").tobytes()).decode() for name, weight in network.weights.items()
    }
    return {"cutoff": round(network.cutoff, 4), "weights": weights}


def _later(progress: ProgressCallback, before: int, total: int, done: int, _: int) -> None:
    progress(before + done, total)


def seen_shapes(plans: Sequence[Plan], count: int, progress: ProgressCallback) -> Shapes:
    """The surfaces of a body's size in `count` made rooms, but those that are neither person nor thing.

    A process for each processor makes the rooms.
    """
    tasks = [
        (plan, range(first, min(first + _ROOMS_A_TASK, whole)))
        for plan in plans
        for whole in [round(plan.share * count)]
        for first in range(0, whole, _ROOMS_A_TASK)
    ]
    shapes: list[SurfaceShape] = []
    person, numbers = [], []
    done = 0
    with ProcessPoolExecutor(processors(), multiprocessing.get_context("spawn")) as pool:
        for (_, rooms), found in zip(tasks, pool.map(_seen, *zip(*tasks, strict=True)), strict=True):
            for number, shape, share in found:
                seen_m2 = share * math.exp(shape.measures[MEASURES.index("log area")])
                is_person = share >= PERSON or (share > THING and seen_m2 >= LEAST_SEEN_M2)
                if is_person or share <= THING:
                    shapes.append(shape)
                    person.append(is_person)
                    numbers.append(done + number - rooms[0])
            done += len(rooms)
            progress(done, count)
    images = np.stack([shape_image(shape.cells) for shape in shapes])
    return Shapes(images, np.stack([shape.measures for shape in shapes]), np.array(person), np.array(numbers))


def _seen(plan: Plan, rooms: range) -> list[tuple[int, SurfaceShape, float]]:
    """Surfaces of rooms: the room's number, the shape, and the share of pixels that show a person."""
    makers = _makers(plan)
    return [
        (number, shape, share) for number in rooms for shape, share in surfaces_of(makers[number % len(makers)], number)
    ]


@cache
def _makers(plan: Plan) -> list[Rooms]:
    return rooms_of(plan.source, plan.split, plan.seed, parts=False, touching=plan.touching)


def surfaces_of(maker: Rooms, number: int) -> Iterator[tuple[SurfaceShape, float]]:
    """Shape of every surface of a body's size in a room, and the share of its pixels that show a person."""
    room, camera = maker(number), maker.camera
    for pixels in find_bodies(room.range_m, camera, Background()):
        yield surface_shape(pixels, room.range_m, camera), float((room.person.ravel()[pixels] >= 0).mean())


class _Fit(nn.Module):
    """`ShapeNetwork` as PyTorch fits it. mean, spread: of the measures, which it standardises."""

    def __init__(self, mean: torch.Tensor, spread: torch.Tensor) -> None:
        super().__init__()
        for name in ("layer1", "layer2", "layer3"):
            out, into, side, _ = SHAPES[f"{name}.weight"]
            self.add_module(name, nn.Conv2d(into, out, side, stride=2, padding=1))
        for name in ("hidden", "out"):
            out, into = SHAPES[f"{name}.weight"]
            self.add_module(name, nn.Linear(into, out))
        self.mean, self.spread = mean, spread

    def forward(self, images: torch.Tensor, measures: torch.Tensor) -> torch.Tensor:
        """Logits [N]. images: [N, 3, 48, 48]. measures: [N, 16]."""
        for name in ("layer1", "layer2", "layer3"):
            images = F.relu(self.get_submodule(name)(images))
        standard = (measures - self.mean) / self.spread
        seen = torch.cat([images.mean((2, 3)), images.amax((2, 3)), standard], dim=1)
        seen = F.dropout(seen, _DROPPED, self.training)
        found: torch.Tensor = self.get_submodule("out")(F.relu(self.get_submodule("hidden")(seen)))
        return found[:, 0]

    def network(self) -> ShapeNetwork:
        """The same for measures as they are."""
        weights = {name: weight.detach().numpy().copy() for name, weight in self.state_dict().items()}
        own = weights["hidden.weight"][:, -len(MEASURES) :]
        own /= self.spread.numpy()
        weights["hidden.bias"] -= own @ self.mean.numpy()
        return ShapeNetwork({name: weights[name] for name in SHAPES}, cutoff=0.0)


def fitted(shapes: Shapes, seed: int = 0) -> ShapeNetwork:
    """Fit by the cross-entropy of mirrored, shifted, partly erased and noisy surfaces."""
    measures = torch.from_numpy(shapes.measures).float()
    mean, spread = measures.mean(0), measures.std(0) + 1e-6
    target = torch.from_numpy(shapes.person).float()
    draws, order = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        fit = _Fit(mean, spread)
        steps = _EPOCHS * (len(target) // _BATCH)
        adam = torch.optim.AdamW(fit.parameters(), _RATE, weight_decay=_DECAY)
        rate = torch.optim.lr_scheduler.OneCycleLR(adam, _RATE, total_steps=steps)
        for _ in range(_EPOCHS):
            mixed = torch.randperm(len(target), generator=order)
            for chosen in mixed[: len(target) // _BATCH * _BATCH].reshape(-1, _BATCH):
                images = torch.from_numpy(with_curvature(_augmented(shapes.images[chosen.numpy()], draws)))
                noise = _NOISE[1] * spread * torch.randn(_BATCH, len(MEASURES), generator=order)
                loss = F.binary_cross_entropy_with_logits(fit(images, measures[chosen] + noise), target[chosen])
                adam.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                adam.step()
                rate.step()
    return fit.network()


def _augmented(images: Image, draws: np.random.Generator) -> Image:
    """Mirror half of the images [N, 2, 48, 48], shift all, and erase a bar or a square of some, as occluders do."""
    images = np.roll(images, draws.integers(-_SHIFT, _SHIFT + 1, 2), axis=(2, 3))  # a copy
    for image in images:
        if draws.random() < 0.5:
            image[:] = image[..., ::-1].copy()
        if draws.random() < _ERASED:
            row, column, wide = draws.integers((4, 4, 1), (SIDE - 4, SIDE - 4, 8))
            across, down = ((2 * wide, 2 * wide), (SIDE, wide), (wide, SIDE))[draws.integers(3)]
            row, column = (0 if down == SIDE else row), (0 if across == SIDE else column)
            image[:, row : row + down, column : column + across] = 0
    images[:, 0] += _NOISE[0] * draws.normal(size=images[:, 0].shape).astype(np.float32) * images[:, 1]
    return images


def logits(network: ShapeNetwork, shapes: Shapes) -> Floats:
    """Logarithm of the odds of a person, [N]."""
    return np.array([network.logit(*each) for each in zip(shapes.images, shapes.measures, strict=True)])


def quality(network: ShapeNetwork, shapes: Shapes) -> dict[str, Any]:
    """Surfaces of people lost and share of the things dropped by its cutoff; and the share of the things that a cutoff
    would drop which loses 0, 1, 2 ... of the people. Only large surfaces of people count. Shares are null
    without any things.
    """
    found = logits(network, shapes)
    people, things = np.sort(found[shapes.person & shapes.large]), found[~shapes.person]
    cutoff = math.log(network.cutoff / (1 - network.cutoff))
    return {
        "people": len(people),
        "things": len(things),
        "people_lost": int((people < cutoff).sum()),
        "things_dropped": _share_below(things, cutoff),
        "things_dropped_where_people_lost": {
            str(lost): _share_below(things, people[lost]) for lost in _LOST if lost < len(people)
        },
        "lowest_people": [round(float(logit), 3) for logit in people[:5]],
    }


def _share_below(values: Floats, limit: float) -> float | None:
    return round(float(np.mean(values < limit)), 4) if len(values) else None
