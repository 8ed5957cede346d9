"""`bench things`: fit the score that tells people from things on made rooms, and measure it on others.

`score` in the figures is the content of `bodyseg_model/segmentation/people/person_score.json`. docs/things.md says how
to read the results.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.model.things.shapes import PERSON, THING
from bodyseg_data.core.system.progress import ProgressCallback, silent
from bodyseg_model.networks.checkpoints import SHIPPED, load_network
from bodyseg_model.networks.network import Network
from bodyseg_model.segmentation.people.part_features import part_features
from bodyseg_model.segmentation.people.person_score import FEATURES, FORMAT, score_with
from bodyseg_model.segmentation.people.shape_network import shipped_shape_network
from bodyseg_model.segmentation.people.surface_shape import surface_shape
from bodyseg_model.segmentation.segmenter import Segmenter
from bodyseg_model.stability.people_and_things import SENSORS, people_and_things, rooms_of

FIT_SEED: Final = 1
FIT_SOURCE: Final = "wide"

LOST: Final = 0.005
"""Share of the people's surfaces in rooms to fit to that the cutoff may lose, when other rooms' weights score them."""

RIDGE: Final = 3.0
"""Penalty of squared weights of standardised features."""

_FOLDS: Final = 5
_TEST_SHARE: Final = 0.8  # of the rooms fitted to: as many are measured

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Surfaces:
    """Surfaces of a body's size. features: `FEATURES`, float64 [N, F]. person: bool [N]. room: int [N], their rooms."""

    features: Floats
    person: NDArray[np.bool_]
    room: NDArray[np.intp]


def bench_things(views: int = 300, runs: Sequence[Path] = (), progress: ProgressCallback = silent) -> dict[str, Any]:
    """Fit the score, and measure it.

    views: made rooms to fit to; four fifths as many others are measured. runs: the network is in the first of them;
    without, it is the one that ships. Bodies to fit to are of the source `wide`, training split.
    """
    network, shapes = load_network(runs[0] if runs else SHIPPED).network, shipped_shape_network()
    tested = max(1, round(_TEST_SHARE * views))
    surfaces = seen_surfaces(network, views, lambda done, _: progress(done, views + tested))
    by_shape = 1 / (1 + np.exp(-surfaces.features[:, FEATURES.index("shape")]))
    by_parts = cross_scores(surfaces.features, surfaces.person, surfaces.room)
    cutoffs = [float(np.quantile(scores[surfaces.person], LOST)) for scores in (by_parts, by_shape)]
    weights, bias = logistic_fit(surfaces.features, surfaces.person)
    parts, shape = score_with(shapes, cutoffs[0], weights, bias), score_with(shapes, cutoffs[1])
    told = by_shape < parts.thing_below
    quality = {
        "parts": _quality(by_parts < cutoffs[0], surfaces.person),
        "shape": _quality(by_shape < cutoffs[1], surfaces.person),
        "told before the network": _quality(told, surfaces.person),
    }
    source = {
        "command": "tools/bench things",
        "network": runs[0].name if runs else "shipped",
        "bodies": f"{FIT_SOURCE}, training split",
        "sensors": list(SENSORS),
        "seed": FIT_SEED,
        "rooms": views,
        "people": int(surfaces.person.sum()),
        "things": int((~surfaces.person).sum()),
        "ridge": RIDGE,
        "cutoff": f"{LOST:.1%} of the people's surfaces lost in {_FOLDS}-fold cross-validation by room",
    }
    test = people_and_things(network, parts, tested, lambda done, _: progress(views + done, views + tested))
    score = {"format": FORMAT, "source": source, "models": {"parts": parts.to_json(), "shape": shape.to_json()}}
    return {"cross_validation": quality, "test": test, "score": score}


def _quality(dropped: NDArray[np.bool_], person: NDArray[np.bool_]) -> dict[str, float]:
    return {
        "people_lost": round(float(np.mean(dropped[person])), 4),
        "things_kept": round(float(np.mean(~dropped[~person])), 4),
    }


def seen_surfaces(network: Network, count: int, progress: ProgressCallback) -> Surfaces:
    """The surfaces of a body's size in `count` rooms to fit to, but those that show person and thing."""
    makers = rooms_of(FIT_SOURCE, "train", FIT_SEED, parts=False)
    segmenters = [Segmenter(network, rooms.camera) for rooms in makers]
    by_shape = shipped_shape_network()
    features, shares, numbers = [], [], []
    for number in range(count):
        maker, segmenter = makers[number % len(makers)], segmenters[number % len(makers)]
        room = maker(number)
        result = segmenter(room.range_m)
        for body in result.bodies:
            labels = result.labels.ravel()[body.pixels]
            shape = by_shape(surface_shape(body.pixels, room.range_m, maker.camera))
            answer = part_features(body.pixels, labels, body.confidence, room.range_m, maker.camera)
            features.append(np.concatenate([[shape], answer]))
            shares.append(float((room.person.ravel()[body.pixels] >= 0).mean()))
            numbers.append(number)
        progress(number + 1, count)
    share = np.array(shares)
    clear = (share >= PERSON) | (share <= THING)
    return Surfaces(np.array(features)[clear], (share >= PERSON)[clear], np.array(numbers)[clear])


def cross_scores(features: Floats, person: NDArray[np.bool_], room: NDArray[np.intp]) -> Floats:
    """Probabilities of a person [N], each by weights that were fitted without the surface's room and its fold."""
    found = np.empty(len(person))
    for fold in range(_FOLDS):
        held = room % _FOLDS == fold
        weights, bias = logistic_fit(features[~held], person[~held])
        found[held] = 1 / (1 + np.exp(-np.clip(features[held] @ weights + bias, -700, 700)))
    return found


def logistic_fit(features: Floats, person: NDArray[np.bool_]) -> tuple[Floats, float]:
    """Weights [F] and bias of a logistic regression with a ridge penalty, by Newton's method.

    features: float64 [N, F]; they are standardised for the penalty, and the weights are for those given.
    """
    mean, spread = features.mean(axis=0), features.std(axis=0)
    spread[spread == 0] = 1
    known = np.column_stack([(features - mean) / spread, np.ones(len(features))])
    penalty = np.full(known.shape[1], RIDGE)
    penalty[-1] = 0
    weights = np.zeros(known.shape[1])
    for _ in range(100):
        likely = 1 / (1 + np.exp(-np.clip(known @ weights, -30, 30)))
        slope = known.T @ (person - likely) - penalty * weights
        curvature = (known * (likely * (1 - likely))[:, None]).T @ known + np.diag(penalty)
        step = np.linalg.solve(curvature + 1e-9 * np.eye(len(weights)), slope)
        weights += step
        if np.abs(step).max() < 1e-8:
            break
    scaled = weights[:-1] / spread
    return scaled, float(weights[-1] - scaled @ mean)
