"""The 15 joints of a person from the parts that are seen: centroids of parts and of borders between two of them.

Each of these features, moved a fitted length away from the camera along its ray, since a joint lies behind the skin,
is a guess of the joint. Of features that are seen, the weights of least variance that sum to 1 are used (best linear
unbiased estimate; in geostatistics ordinary kriging, Matheron, 1963), from the second moments of all guesses' errors:
w = G⁻¹1 / 1ᵀG⁻¹1, of variance 1 / 1ᵀG⁻¹1. So any part may be hidden, and whoever is far from what is seen is not
guessed. Lengths and moments are fitted by `bench joints`; docs/how-to/robot.md has the errors.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_data.labels import LANDMARKS, PART_COUNT, PARTS33
from bodyseg_model.segmentation.persons import NUMBERS, Records, SurfacePixels

JOINTS: Final = (
    "head",
    "neck",
    *(f"{side}_{name}" for name in ("shoulder", "elbow", "wrist") for side in ("right", "left")),
    "torso",
    *(f"{side}_{name}" for name in ("hip", "knee", "ankle") for side in ("right", "left")),
)
"""Names of the joints, in the order of those of ITOP; sides are the person's own."""

JOINT: Final = np.dtype(
    [("person", "u2"), ("joint", "u1"), ("seen", "u1"), ("position_m", "f4", 3), ("error_m", "f4")], align=True
)
"""A joint of a person. person: from 1. joint: its place in `JOINTS`. seen: how many of its features are. error_m: root
mean square error that the fit expects from these, infinite for none. position_m: in the camera's frame, metres; NaN
where more than `MOST_ERROR_M` is expected, as what tells of the joint is hidden.
"""

MOST_ERROR_M: Final = 0.15

FILE: Final = "joints.json"
FORMAT: Final = "bodyseg joints 1"

LEAST_PIXELS: Final = 8
"""Pixels of a part that make it a feature."""

LEAST_PAIRS: Final = 4
"""Pairs of neighbours across a border that make it one."""

_SAME_M: Final = 0.05  # range between neighbours on one surface
_UNSEEN: Final = 1e6  # variance, square metres

Floats = NDArray[np.float64]


def code_of(part: int, other: int | None = None) -> int:
    """Number of a feature, of a part or of the border between two: 256 x the lower label + the other or the same."""
    low, high = sorted((part, part if other is None else other))
    return low * NUMBERS + high


def feature_points(answer: Any, codes: NDArray[np.int64]) -> Floats:
    """Centroids of people's features, float64 [people, F, 3], metres, camera's frame; NaN where too few pixels show.

    answer: a `Segmentation`. codes: int64 [F], of `code_of`, each once.
    """
    seen, columns = SurfacePixels(answer), answer.labels.shape[1]
    number = np.full(NUMBERS * NUMBERS, -1, np.int64)
    number[codes] = np.arange(len(codes))
    found = np.full((len(answer.bodies), len(codes), 3), np.nan)
    parts = seen.parts()
    place = number[parts["part"].astype(np.int64) * (NUMBERS + 1)]
    known = (place >= 0) & (parts["pixels"] >= LEAST_PIXELS)
    found[parts["person"][known].astype(np.int64) - 1, place[known]] = parts["centroid_m"][known]

    # Neighbours of one person with two labels: to the right, where a run ends; and below, anywhere in the list.
    first = seen.begin[1:] - 1
    first = first[(seen.pixels[first] + 1 == seen.pixels[first + 1]) & (seen.column[first + 1] > 0)]
    first = first[seen.person[first] == seen.person[first + 1]]
    image = np.zeros(answer.labels.size + columns, np.uint32)
    image[seen.pixels] = seen.keys
    below = image.take(seen.pixels + columns)
    upper = np.flatnonzero((below != seen.keys) & (below ^ seen.keys < NUMBERS))
    other = np.concatenate([seen.label[first + 1], (below[upper] % NUMBERS).astype(np.uint8)]).astype(np.int64)
    z = np.concatenate([seen.z[first + 1], answer.range_m.ravel()[seen.pixels[upper] + columns]])
    x = z * seen.across[np.concatenate([seen.column[first] + 1, seen.column[upper]])]
    y = z * seen.down[np.concatenate([seen.row[first], seen.row[upper] + 1])]
    first = np.concatenate([first, upper])
    label = seen.label[first].astype(np.int64)
    border = number[np.minimum(label, other) * NUMBERS + np.maximum(label, other)]
    near = (border >= 0) & (np.abs(z - seen.z[first]) < _SAME_M)
    place = ((seen.person[first].astype(np.int64) - 1) * len(codes) + border)[near]
    count = np.bincount(place, minlength=len(answer.bodies) * len(codes))
    ends = ((seen.x[first], x), (seen.y[first], y), (seen.z[first], z))
    sums = np.stack([np.bincount(place, ((a + b) / 2)[near], len(count)) for a, b in ends], axis=1)
    enough = count >= LEAST_PAIRS
    found.reshape(-1, 3)[enough] = sums[enough] / count[enough, None]
    return found


def behind(points: Floats, by_m: Floats) -> Floats:
    """Points [..., 3] moved away from the camera along their rays, by metres [...]."""
    moved: Floats = points * (1 + by_m / np.linalg.norm(points, axis=-1))[..., None]
    return moved


@dataclass(frozen=True)
class JointMap:
    """The fitted map. codes: int64 [F], its features. features: int64 [15, K], places in `codes` of each joint's.

    behind_m: float64 [15, K], how far behind each of them the joint lies. moments_m2: float64 [15, K, K], means of
    the scalar products of two guesses' errors.
    """

    codes: NDArray[np.int64]
    features: NDArray[np.int64]
    behind_m: Floats
    moments_m2: Floats

    def __call__(self, points: Floats) -> tuple[Floats, Floats, NDArray[np.int64]]:
        """Joints of P people, float64 [P, 15, 3], their expected errors, float64 [P, 15], metres, and how many of their
        features are seen, int64 [P, 15].

        points: of the features, float64 [P, F, 3], metres, NaN where unseen.
        """
        guesses = behind(points[:, self.features], self.behind_m)
        seen = ~np.isnan(guesses[..., 0])
        both = seen[..., :, None] & seen[..., None, :]
        moments = np.where(both, self.moments_m2, 0) + _UNSEEN * np.eye(seen.shape[-1]) * ~seen[..., None, :]
        weights = np.linalg.solve(moments, seen[..., None].astype(np.float64))[..., 0] * seen
        total = weights.sum(axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            errors = 1 / np.sqrt(total)
            places = (weights[..., None] * np.nan_to_num(guesses)).sum(axis=-2) / total[..., None]
        places[~(errors <= MOST_ERROR_M)] = np.nan
        return places, errors, seen.sum(axis=-1)


def joint_map_from_json(tree: Mapping[str, Any]) -> JointMap:
    """Rebuild the map from JSON: of joints features by names of parts, lengths in mm, halves of moments in mm²."""
    names = [[tuple(each) for each in joint["features"]] for joint in tree["joints"]]
    codes = [[code_of(*map(LANDMARKS.index, each)) for each in joint] for joint in names]
    features, places = np.unique(np.array(codes), return_inverse=True)
    shape = places.reshape(len(codes), -1).shape
    moments = np.zeros((*shape, shape[1]))
    rows, columns = np.triu_indices(shape[1])
    moments[:, rows, columns] = [joint["moments_mm2"] for joint in tree["joints"]]
    moments[:, columns, rows] = moments[:, rows, columns]
    lengths = np.array([joint["behind_mm"] for joint in tree["joints"]], np.float64)
    return JointMap(features, places.reshape(shape), lengths / 1e3, moments / 1e6)


@cache
def shipped_joint_map() -> JointMap:
    """The map that ships with the package."""
    return joint_map_from_json(json.loads((resources.files("bodyseg_model") / "weights" / FILE).read_text()))


def found_joints(answer: Any) -> Records:
    """The joints of all people of a `Segmentation`, `JOINT` [people, 15]. Raises BadConfig for a network of other
    classes than the 33 parts: their borders are not where joints are.
    """
    if answer.label_map != PARTS33:
        found = "others" if answer.label_map is None else f"labels {answer.label_map.name!r}"
        raise BadConfig(f"joints are found from the {PART_COUNT} parts alone, found {found}")
    joints = np.zeros((len(answer.bodies), len(JOINTS)), JOINT)
    places, errors, seen = shipped_joint_map()(feature_points(answer, shipped_joint_map().codes))
    joints["person"], joints["joint"] = np.arange(1, len(joints) + 1)[:, None], np.arange(len(JOINTS))
    joints["position_m"], joints["error_m"], joints["seen"] = places, errors, seen
    return joints
