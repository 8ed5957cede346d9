"""A score that tells people from things, by the shape of a surface and by a network's answer to it.

A small network looks at the shape of every surface first. What it takes for a thing with certainty no other network
labels. Of the rest a logistic regression decides, on the small network's score and features of the labels; for networks
that do not label the 33 parts the shape decides alone. The weights in `person_score.json` were fitted on made rooms by
`tools/bench things`, those of the small network by `tools/bench shapes` (docs/things.md); the files name their sources.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import resources
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.labels.label_map import PARTS33, LabelMap
from bodyseg_data.core.rig import Camera
from bodyseg_model.segmentation.people.part_features import PART_FEATURES, part_features
from bodyseg_model.segmentation.people.shape_network import ShapeNetwork, shipped_shape_network
from bodyseg_model.segmentation.people.surface_shape import SurfaceShape, surface_shape

FORMAT: Final = "bodyseg person score 2"
FILE: Final = "person_score.json"

FEATURES: Final = ("shape", *PART_FEATURES)
"""What the logistic regression reads, in its order: the logarithm of the odds by the shape, and the answer."""

ByShape = Callable[[SurfaceShape], float]
"""Gives the logarithm of the odds that a surface of this shape is a person."""


@dataclass(frozen=True)
class PersonScore:
    """Probability that a surface is a person: 1 / (1 + exp(-(bias + weights . features))).

    by_shape: judges shapes. thing_below: a surface of less, by its shape alone, is a thing whatever a network answers.
    cutoff: least probability of a person. Both are 0 to 1. weights: float64 [F], one for each of `FEATURES`; None if
    the shape alone decides, by `cutoff`. Raises BadConfig for another number of weights, or for numbers out of range.
    """

    by_shape: ByShape = field(repr=False)
    thing_below: float
    cutoff: float
    weights: NDArray[np.float64] | None = field(default=None, repr=False)
    bias: float = 0.0

    def __post_init__(self) -> None:
        weights = np.zeros(len(FEATURES)) if self.weights is None else self.weights
        if len(weights) != len(FEATURES):
            raise BadConfig(f"a score of people has {len(FEATURES)} weights, found {len(weights)}")
        if not (np.isfinite(weights).all() and math.isfinite(self.bias) and 0 <= self.cutoff <= 1):
            raise BadConfig(f"a score needs finite weights and a cutoff from 0 to 1, found cutoff {self.cutoff:g}")
        if not 0 <= self.thing_below <= self.cutoff:
            raise BadConfig(f"'thing_below' must be 0 to the cutoff, {self.cutoff:g}, found {self.thing_below:g}")

    @property
    def model(self) -> Literal["parts", "shape"]:
        """`parts` if a network's answer in the 33 parts decides, `shape` if the shape alone does."""
        return "shape" if self.weights is None else "parts"

    def __call__(
        self,
        pixels: NDArray[np.intp],
        range_m: NDArray[np.float32],
        camera: Camera,
        labels: NDArray[np.uint8],
        confidence: NDArray[np.float32],
    ) -> float:
        """Score one surface, 0 to 1. Arguments as of `surface_shape` and `part_features`."""
        shape = self.of_shape(pixels, range_m, camera)
        told = self.of_thing(shape)
        return self.of_answer(shape, pixels, range_m, camera, labels, confidence) if told is None else told

    def of_shape(self, pixels: NDArray[np.intp], range_m: NDArray[np.float32], camera: Camera) -> float:
        """Judge a surface by its shape alone: logarithm of the odds of a person. Arguments as of `surface_shape`."""
        return self.by_shape(surface_shape(pixels, range_m, camera))

    def of_thing(self, shape: float) -> float | None:
        """Score of a surface whose shape alone tells that it is a thing, below `cutoff`; None if a network is to label
        it. shape: of `of_shape`.
        """
        found = _probability(shape)
        return found if found < self.thing_below else None

    def of_answer(
        self,
        shape: float,
        pixels: NDArray[np.intp],
        range_m: NDArray[np.float32],
        camera: Camera,
        labels: NDArray[np.uint8],
        confidence: NDArray[np.float32],
    ) -> float:
        """Score of a surface by its shape, of `of_shape`, and by a network's answer, as for `part_features`."""
        if self.weights is None:
            return _probability(shape)
        answer = part_features(pixels, labels, confidence, range_m, camera)
        return _probability(self.bias + float(self.weights @ np.concatenate([[shape], answer])))

    def to_json(self) -> dict[str, Any]:
        """The logistic regression and its cutoff as plain JSON, weights by the names of their features."""
        own: dict[str, Any] = {"cutoff": round(self.cutoff, 4)}
        if self.weights is None:
            return own
        named = dict(zip(FEATURES, (round(weight, 6) for weight in self.weights.tolist()), strict=True))
        return {**own, "bias": round(self.bias, 6), "weights": named}


def _probability(odds: float) -> float:
    return 1 / (1 + math.exp(-min(max(odds, -700.0), 700.0)))


def score_with(
    shapes: ShapeNetwork, cutoff: float, weights: NDArray[np.float64] | None = None, bias: float = 0.0
) -> PersonScore:
    """The score that judges shapes by a network, whose `thing_below` it takes, but none above its cutoff. Without
    weights the shape alone decides. Raises BadConfig as `PersonScore`.
    """
    thing_below = cutoff if weights is None else min(shapes.thing_below, cutoff)
    return PersonScore(shapes, thing_below, cutoff, weights, bias)


def score_from_json(tree: Mapping[str, Any], shapes: ShapeNetwork) -> PersonScore:
    """Rebuild a score from what `PersonScore.to_json` gave. Raises BadConfig for other features."""
    cutoff = float(tree["cutoff"])
    if "weights" not in tree:
        return score_with(shapes, cutoff)
    if tuple(tree["weights"]) != FEATURES:
        raise BadConfig(f"the score has other features than this version computes, in {FILE}")
    return score_with(shapes, cutoff, np.array(list(tree["weights"].values()), np.float64), float(tree["bias"]))


def score_for(label_map: LabelMap) -> PersonScore:
    """The shipped score for a network of these labels: of other classes than the 33 parts, by the shape alone.

    Raises BadConfig for a file of another format.
    """
    tree = json.loads((resources.files(__package__) / FILE).read_text())
    if tree["format"] != FORMAT:
        raise BadConfig(f"{FILE}: 'format' must be {FORMAT!r}, found {tree['format']!r}")
    name = "parts" if label_map == PARTS33 else "shape"
    return score_from_json(tree["models"][name], shipped_shape_network())


def shipped_score() -> PersonScore:
    """The score that ships with the package, for networks that label the 33 parts. Raises as `score_for`."""
    return score_for(PARTS33)
