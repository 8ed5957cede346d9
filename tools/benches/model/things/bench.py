"""`bench things`: fit the score that tells people from things on made rooms, and measure it on others.

`score` in the figures is the content of `bodyseg_model/segmentation/people/person_score.json`. docs/things.md says how
to read the results.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.system.progress import ProgressCallback, silent
from bodyseg_model.networks.checkpoints import SHIPPED, load_network
from bodyseg_model.networks.network import Network
from bodyseg_model.segmentation.people.features import SHAPE_FEATURES, part_features, shape_features
from bodyseg_model.segmentation.people.person_score import FORMAT, Model, PersonScore
from bodyseg_model.segmentation.segmenter import Segmenter
from bodyseg_model.stability.people_and_things import LEAST_SEEN_M2, SENSORS, people_and_things, rooms_of

FIT_SEED: Final = 1
FIT_SOURCE: Final = "wide"

LOST: Final = 0.02
"""Share of the people's surfaces in rooms to fit to that the cutoff may lose, when other rooms' weights score them."""

SAFE: Final = 0.5
"""The cutoff of the shape before the network, as a share of the least score by shape of any person, in
cross-validation. Surfaces of people count if they show at least `LEAST_SEEN_M2` and the score keeps them.
"""

RIDGE: Final = 3.0
"""Penalty of squared weights of standardised features."""

_FOLDS: Final = 5
_PERSON, _THING = 0.5, 0.1  # shares of a surface's pixels that show a person; those between are left out
_TEST_SHARE: Final = 0.2  # of the rooms fitted to: as many are measured

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Surfaces:
    """Surfaces of a body's size. features: model -> float64 [N, F]. person: bool [N]. room: int [N], their rooms."""

    features: dict[Model, Floats]
    person: NDArray[np.bool_]
    room: NDArray[np.intp]


def bench_things(views: int = 300, runs: Sequence[Path] = (), progress: ProgressCallback = silent) -> dict[str, Any]:
    """Fit both models of the score, and measure the one with parts.

    views: made rooms to fit to; a fifth as many others are measured. runs: the network is in the first of them;
    without, it is the one that ships. Bodies to fit to are of the source `wide`, training split.
    """
    network = load_network(runs[0] if runs else SHIPPED).network
    tested = max(1, round(_TEST_SHARE * views))
    surfaces = seen_surfaces(network, views, lambda done, _: progress(done, views + tested))
    models: dict[Model, PersonScore] = {}
    quality: dict[str, Any] = {}
    scores = {name: cross_scores(of, surfaces.person, surfaces.room) for name, of in surfaces.features.items()}
    for model, features in surfaces.features.items():
        cutoff = float(np.quantile(scores[model][surfaces.person], LOST))
        weights, bias = logistic_fit(features, surfaces.person)
        models[model] = PersonScore(model, weights, bias, cutoff)
        kept = scores[model] >= cutoff
        quality[model] = {
            "people_lost": round(float(np.mean(~kept[surfaces.person])), 4),
            "things_kept": round(float(np.mean(kept[~surfaces.person])), 4),
        }
    parts, shape = models["parts"], models["shape"]
    large = surfaces.features["shape"][:, SHAPE_FEATURES.index("log area")] >= np.log(LEAST_SEEN_M2)
    counted = surfaces.person & large & (scores["parts"] >= parts.cutoff)
    first_cutoff = min(SAFE * float(scores["shape"][counted].min()), parts.cutoff)
    models["parts"] = replace(parts, first=replace(shape, cutoff=first_cutoff))
    told = scores["shape"] < first_cutoff
    quality["told by shape"] = {
        "people": int(told[surfaces.person].sum()),
        "things": round(float(np.mean(told[~surfaces.person])), 4),
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
        "cutoff": f"{LOST:.0%} of the people's surfaces lost in {_FOLDS}-fold cross-validation by room",
        "first": f"{SAFE:g} of the least score by shape, in cross-validation, of people who show {LEAST_SEEN_M2} m²",
    }
    test = people_and_things(network, models["parts"], tested, lambda done, _: progress(views + done, views + tested))
    score = {"format": FORMAT, "source": source, "models": {name: fit.to_json() for name, fit in models.items()}}
    return {"cross_validation": quality, "test": test, "score": score}


def seen_surfaces(network: Network, count: int, progress: ProgressCallback) -> Surfaces:
    """The surfaces of a body's size in `count` rooms to fit to, but those that show person and thing."""
    makers = rooms_of(FIT_SOURCE, "train", FIT_SEED, parts=False)
    segmenters = [Segmenter(network, rooms.camera) for rooms in makers]
    shapes, answers, shares, numbers = [], [], [], []
    for number in range(count):
        maker, segmenter = makers[number % len(makers)], segmenters[number % len(makers)]
        room = maker(number)
        result = segmenter(room.range_m)
        for body in result.bodies:
            labels = result.labels.ravel()[body.pixels]
            shapes.append(shape_features(body.pixels, room.range_m, maker.camera))
            answers.append(part_features(body.pixels, labels, body.confidence, room.range_m, maker.camera))
            shares.append(float((room.person.ravel()[body.pixels] >= 0).mean()))
            numbers.append(number)
        progress(number + 1, count)
    share = np.array(shares)
    clear = (share >= _PERSON) | (share <= _THING)
    shape = np.array(shapes)[clear]
    features: dict[Model, Floats] = {"parts": np.concatenate([shape, np.array(answers)[clear]], axis=1), "shape": shape}
    return Surfaces(features, (share >= _PERSON)[clear], np.array(numbers)[clear])


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
