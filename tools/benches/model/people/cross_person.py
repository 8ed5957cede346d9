"""`bench cross_person`: networks whose labels one person's annotations placed, scored on the other people.

`placed_by_N.json` in this folder are the open body's landmarks, placed by the annotations of person N alone
(`landmarks.placed`); `bodyseg shard --landmarks` packs labels by them.

How far annotations wander is measured without any fit: landmarks on one bone keep their distance in all poses.
"""

from __future__ import annotations

import math
import statistics
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.model.people.bench import POSES
from benches.model.people.bodies import Annotated, annotated_bodies
from benches.model.people.intervals import interval, summed
from benches.model.people.scores import Counted, accuracy, counted, gross_errors, packed_views
from bodyseg_data.core import BadConfig, ProgressCallback, silent
from bodyseg_data.labels import LANDMARKS
from bodyseg_model.networks import load_network

BONES: Final = {
    "skull": ("Sellion", "Nuchale"),
    "pelvis, front": ("Rt. ASIS", "Lt. ASIS"),
    "pelvis, back": ("Rt. PSIS", "Lt. PSIS"),
    "breastbone": ("Suprasternale", "Substernale"),
    "right forearm": ("Rt. Olecranon", "Rt. Radial Styloid"),
    "left forearm": ("Lt. Olecranon", "Lt. Radial Styloid"),
    "right thigh": ("Rt. Trochanterion", "Rt. Femoral Lateral Epicn"),
    "left thigh": ("Lt. Trochanterion", "Lt. Femoral Lateral Epicn"),
}
"""Landmarks at both ends of a bone."""


def bench_cross_person(
    data: str, runs: Sequence[Path], views: int = 6, poses: int = POSES, progress: ProgressCallback = silent
) -> dict[str, Any]:
    """Score each network in `all` on the people whose annotations did not place its labels, and on the one whose did.

    data, views, poses: as of `bench_people`, whose images these are. runs: a network for each person, in the people's
    order. Raises BadConfig for another number of networks, or of one person alone; otherwise as `bench_people`.
    """
    bodies = annotated_bodies(Path(data), poses)
    people = list(dict.fromkeys(body.person for body in bodies))
    if len(people) < 2 or len(runs) != len(people):
        raise BadConfig(
            "bench cross_person needs two people or more and --runs, a network trained on the landmarks of each, "
            f"found {len(people)} and {len(runs)}"
        )
    networks = [load_network(run) for run in runs]
    results: dict[str, Any] = {
        "networks": {
            who: {"run": run.name, "images": _images(trained.card.get("recipe", {}))}
            for who, run, trained in zip(people, runs, networks, strict=True)
        },
        "bodies": len(bodies),
        "people": len(people),
        "views": views,
        "bones": wander_mm(bodies),
    }
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        keys = packed_views(bodies, views, home)
        found: dict[str, Counted] = {}
        for done, (who, trained) in enumerate(zip(people, networks, strict=True)):

            def show(images: int, total: int, before: int = done) -> None:
                progress(before * total + images, len(people) * total)

            found[who] = counted(trained.network, home, keys, "all", show)
    others = {who: one.of({*people} - {who}) for who, one in found.items()}
    own = {who: one.of({who}) for who, one in found.items()}
    return results | {
        "cross_person": both_ways(others),
        "in_sample": both_ways(own),
        "in_sample_gain": in_sample_gain(own, others),
    }


def _images(recipe: Mapping[str, Any]) -> int:
    """Images that a training has shown to its network, by its recipe."""
    return math.prod(recipe.get(name, 0) for name in ("steps", "batch_size", "accumulate"))


def wander_mm(bodies: Sequence[Annotated]) -> dict[str, dict[str, float]]:
    """Bone -> person -> standard deviation of the distance between its landmarks over that person's poses, mm.

    Landmarks that wander by as much each, independently, do so by 0.7 of that along the bone, and the border halfway
    between them by 0.5 of it. People with one pose are left out.
    """
    found: dict[str, dict[str, float]] = {}
    for bone, ends in BONES.items():
        at = [LANDMARKS.index(name) for name in ends]
        lengths: dict[str, list[float]] = {}
        for body in bodies:
            lengths.setdefault(body.person, []).append(float(np.linalg.norm(np.subtract(*body.points[at]))))
        found[bone] = {who: round(1000 * statistics.stdev(own), 1) for who, own in lengths.items() if len(own) > 1}
    return found


def both_ways(ways: Mapping[str, Counted]) -> dict[str, Any]:
    """The mean of average per-class accuracies, with an interval that draws poses, gross errors, and each way alone.

    ways: whose annotations placed the labels -> answers of the network that learned them.
    """
    groups = _by_pose(ways)
    return {
        "images": sum(len(one.counts) for one in ways.values()),
        "accuracy": round(_mean(np.sum(groups, axis=0)), 4),
        "interval": interval(groups, _mean),
        "gross_errors": gross_errors(ways.values()),
        "placed_by": {who: one.to_json() for who, one in ways.items()},
    }


def in_sample_gain(own: Mapping[str, Counted], others: Mapping[str, Counted]) -> dict[str, Any]:
    """Mean accuracy on those who placed the labels, less that on the others, with an interval that draws poses.

    How good networks are, and how hard people, is the same in both means.
    """
    groups = [np.stack(both) for both in zip(_by_pose(own), _by_pose(others), strict=True)]

    def gain(counts: NDArray[Any]) -> float:
        return _mean(counts[0]) - _mean(counts[1])

    return {"points": round(gain(np.sum(groups, axis=0)), 4), "interval": interval(groups, gain)}


def _by_pose(ways: Mapping[str, Counted]) -> list[NDArray[np.int64]]:
    """Counts of each pose, by name, int64 [ways, 33, 33]."""
    by_pose = [summed(one.counts, _pose) for one in ways.values()]
    nothing = np.zeros((33, 33), np.int64)
    poses = sorted({pose for one in by_pose for pose in one})
    return [np.stack([one.get(pose, nothing) for one in by_pose]) for pose in poses]


def _mean(counts: NDArray[Any]) -> float:
    """Mean accuracy of counts [ways, 33, 33]."""
    return float(np.mean([accuracy(one) for one in counts]))


def _pose(key: tuple[str, str, str]) -> str:
    return key[1]
