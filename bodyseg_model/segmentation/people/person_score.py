"""A score that tells people from things: logistic regression on features of a surface and of a network's answer to it.

The weights in `person_score.json` were fitted on made rooms by `tools/bench things` (docs/things.md); the file names
its source. There are two models: "parts" for networks that label the 33 parts, "shape" for all others. Many things are
told by their shape before a network labels them: "parts" holds the model "shape" with a low cutoff for these.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.labels.label_map import PARTS33, LabelMap
from bodyseg_data.core.rig import Camera
from bodyseg_model.segmentation.people.features import PART_FEATURES, SHAPE_FEATURES, part_features, shape_features

FORMAT: Final = "bodyseg person score 1"
FILE: Final = "person_score.json"

Model = Literal["parts", "shape"]

FEATURES: Final[dict[Model, tuple[str, ...]]] = {
    "parts": (*SHAPE_FEATURES, *PART_FEATURES),
    "shape": SHAPE_FEATURES,
}
"""Model -> names of its features, in their order."""


@dataclass(frozen=True)
class PersonScore:
    """Probability that a surface is a person: 1 / (1 + exp(-(bias + weights . features))).

    weights: float64 [F], one for each of `FEATURES[model]`. cutoff: least probability of a person, 0 to 1. first: of
    the model "shape"; a surface below its cutoff is a thing whatever a network answers. Raises BadConfig for another
    number of weights, numbers out of range, or a `first` of another model or with a greater cutoff.
    """

    model: Model
    weights: NDArray[np.float64] = field(repr=False)
    bias: float
    cutoff: float
    first: PersonScore | None = None

    def __post_init__(self) -> None:
        if len(self.weights) != len(FEATURES[self.model]):
            raise BadConfig(
                f"the score {self.model!r} has {len(FEATURES[self.model])} weights, found {len(self.weights)}"
            )
        if not (np.isfinite(self.weights).all() and math.isfinite(self.bias) and 0 <= self.cutoff <= 1):
            raise BadConfig(f"a score needs finite weights and a cutoff from 0 to 1, found cutoff {self.cutoff:g}")
        if self.first is not None and not (self.first.model == "shape" and self.first.cutoff <= self.cutoff):
            raise BadConfig(
                f"a first score needs the model 'shape' and a cutoff of at most {self.cutoff:g}, found "
                f"{self.first.model!r} and {self.first.cutoff:g}"
            )

    def __call__(
        self,
        pixels: NDArray[np.intp],
        range_m: NDArray[np.float32],
        camera: Camera,
        labels: NDArray[np.uint8],
        confidence: NDArray[np.float32],
    ) -> float:
        """Score one surface, 0 to 1. Arguments as of `shape_features` and `part_features`."""
        shape = shape_features(pixels, range_m, camera)
        told = self.of_thing(shape)
        return self.of_answer(shape, pixels, range_m, camera, labels, confidence) if told is None else told

    def of_thing(self, shape: NDArray[np.float64]) -> float | None:
        """Score of a surface whose shape alone tells that it is a thing, below `cutoff`; None if a network is to label
        it.

        shape: `shape_features`, float64 [16].
        """
        by_shape = self if self.model == "shape" else self.first
        if by_shape is None:
            return None
        found = by_shape.probability(shape)
        return found if found < by_shape.cutoff else None

    def of_answer(
        self,
        shape: NDArray[np.float64],
        pixels: NDArray[np.intp],
        range_m: NDArray[np.float32],
        camera: Camera,
        labels: NDArray[np.uint8],
        confidence: NDArray[np.float32],
    ) -> float:
        """Score of a surface by its shape, `shape_features`, and by a network's answer, as for `part_features`."""
        if self.model == "shape":
            return self.probability(shape)
        return self.probability(np.concatenate([shape, part_features(pixels, labels, confidence, range_m, camera)]))

    def probability(self, features: NDArray[np.float64]) -> float:
        """Score a surface of given features [F], 0 to 1."""
        return 1 / (1 + math.exp(-min(max(self.bias + float(self.weights @ features), -700.0), 700.0)))

    def to_json(self) -> dict[str, Any]:
        """The model as plain JSON, weights by the names of their features."""
        named = dict(zip(FEATURES[self.model], (round(weight, 6) for weight in self.weights.tolist()), strict=True))
        own = {"bias": round(self.bias, 6), "cutoff": round(self.cutoff, 4), "weights": named}
        return own if self.first is None else {**own, "first": self.first.to_json()}


def score_from_json(model: Model, tree: Mapping[str, Any]) -> PersonScore:
    """Rebuild a score from what `PersonScore.to_json` gave. Raises BadConfig for other features."""
    weights = tree["weights"]
    if tuple(weights) != FEATURES[model]:
        raise BadConfig(f"the score {model!r} has other features than this version computes, in {FILE}")
    values = np.array(list(weights.values()), np.float64)
    first = score_from_json("shape", tree["first"]) if "first" in tree else None
    return PersonScore(model, values, float(tree["bias"]), float(tree["cutoff"]), first)


def score_for(label_map: LabelMap) -> PersonScore:
    """The shipped score for a network of these labels: of other classes than the 33 parts, by the shape alone."""
    return shipped_score("parts" if label_map == PARTS33 else "shape")


def shipped_score(model: Model = "parts") -> PersonScore:
    """The score that ships with the package. Raises BadConfig for a file of another format."""
    tree = json.loads((resources.files(__package__) / FILE).read_text())
    if tree["format"] != FORMAT:
        raise BadConfig(f"{FILE}: 'format' must be {FORMAT!r}, found {tree['format']!r}")
    return score_from_json(model, tree["models"][model])
