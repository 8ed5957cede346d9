"""`bench failures`: where a network fails: a cause for every wrong pixel, the worst images, postures by name.

docs/results/failures.md says how to read the results.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benches.measuring import Figures
from benches.model.chosen import chosen_network
from benches.model.failures.causes import CAUSES
from benches.model.failures.poses import KnownPoses, body_of, kind_of_pose, made_bodies
from benches.model.failures.study import FailureCounts, Picture
from bodyseg_data.bodies import BodyRef
from bodyseg_data.bodies.skeleton import Pose
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.loading import RangeImages
from bodyseg_model.evaluation import evaluate, open_images

Tree = dict[str, Any]


def bench_failures(
    data: str,
    runs: Sequence[Path] = (),
    images: int = 1000,
    hard: str | None = None,
    progress: ProgressCallback = silent,
) -> Figures:
    """Causes, worst images, and accuracy by posture, on variant `all` of the test images.

    data: the set; its training split is what the network is taken to have been trained on. runs: the network is in the
    first of them; without, it is the one that ships. images: how many test images, the first ones of the permutation,
    as in `evaluate`. hard: a second set, all of whose test images are looked at. Raises BadConfig for no network;
    otherwise as `RangeImages`.
    """
    network_name, trained = chosen_network(runs)
    sets = {"test": (open_images(data), images)}
    if hard is not None:
        harder = open_images(hard)
        sets["hard"] = harder, len(harder)
    trained_on = _training_bodies(sets["test"][0])
    known = KnownPoses((body.pose, pose()) for body, pose in trained_on)
    names = [body.pose for body, _ in trained_on]
    total, before = sum(min(count, len(chosen)) for chosen, count in sets.values()), 0
    results: Tree = {}
    pictures: dict[str, list[Picture]] = {}
    for name, (chosen, count) in sets.items():
        counts = FailureCounts(chosen, known)

        def show(done: int, _: int, before: int = before) -> None:
            progress(before + done, total)

        evaluate(trained.network, chosen, count, confidences=False, progress=show, watch=counts.watch)
        before += counts.images
        results[name] = counts.results(names)
        pictures[name] = [failure.picture for failure in counts.worst]
    return Figures(
        {
            "network": network_name,
            "variant": "all",
            "training_bodies": len(trained_on) or None,
            "training_pose_kinds": dict(Counter(kind_of_pose(name) for name in names).most_common()),
            "rules": [asdict(cause) for cause in CAUSES],
            "sets": results,
        },
        pictures,
    )


def _training_bodies(images: RangeImages) -> list[tuple[BodyRef, Callable[[], Pose]]]:
    """Every training body of a set, as far as poses are known."""
    shards = images.manifest.shards
    bodies = dict.fromkeys(body_of(key) for shard in shards if shard.split == "train" for key in shard.keys)
    made = made_bodies(images.clean(0).info.source)
    return [made[body] for body in bodies if body in made]
