"""`bench mining`: candidates for a training that the network labels worst, and whether they are worth more than others.

docs/results/failures.md says how to read the results.
"""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from benches.model.failures.poses import POSE_KINDS, KnownPoses, kind_of_pose
from benches.model.failures.study import ARMS, accuracy, rounded
from bodyseg_data import Mixture
from bodyseg_data.artifacts import Losses, load_sensor_model, sensor_for
from bodyseg_data.bodies import BodyRef
from bodyseg_data.bodies.contact_poses import DEEPEST_M
from bodyseg_data.bodies.sources.hard import HardBodies
from bodyseg_data.bodies.sources.open_bodies import CandidateBodies, WideBodies
from bodyseg_data.commands import provenance
from bodyseg_data.core import BadConfig, Draws, ProgressCallback, silent
from bodyseg_data.files import last_name
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.loading import RangeImages
from bodyseg_data.samples import split_key
from bodyseg_model.evaluation import ConfusionMatrix, count_pairs, evaluate, pairs_of
from bodyseg_model.evaluation.evaluation import PredictedImage
from bodyseg_model.networks import SHIPPED, Network, load_network
from bodyseg_model.training import Recipe, RunFolder, RunOptions, recipe_for, train

ARMS_OF_TRAINING: Final = ("mined", "uniform")
BINS_DEG: Final = (30.0, 40.0)
"""Borders between bins of novelty."""
SCORED_VIEWS: Final = 3
STEPS: Final = 80
_LOSSES: Final = Losses(0.3)  # as the network that ships was trained
_HANDS: Final = [number for number, part in enumerate(LANDMARKS) if part[4:] == ARMS["hand"]]
_CROSSED: Final = next(iter(POSE_KINDS))

Counts = NDArray[np.int64]


class Candidate(NamedTuple):
    """One body. accuracy: of its scored views, average per class. degrees: to the nearest training pose. deepest_m: of
    its skin in its skin.
    """

    name: str
    accuracy: float
    degrees: float
    deepest_m: float


def bench_mining(
    data: str,
    runs: Sequence[Path],
    ordinary: str,
    hard: str | None = None,
    seeds: int = 1,
    steps: int = STEPS,
    images: int = 400,
    progress: ProgressCallback = silent,
) -> dict[str, Any]:
    """Choose candidates, train the network that ships further on them, and score it on poses that were never chosen.

    data: set of the source `candidates`; a third of its training bodies is chosen, for "mined" the worst of each bin of
    novelty, for "uniform" any. runs: its first folder gets a training of each choice and seed, where it is missing,
    with as many images of the training split of `ordinary`; "mean": with the weights that ship, half and half. hard:
    set of the source `hard`. seeds: trainings of each choice. steps: of each training. images: test images of each set,
    the first of the permutation. Novelty is measured to the training poses of `wide`, those of `open` among them.
    Raises BadConfig for a set of another source, or without bodies that can be chosen; otherwise as `RangeImages` and
    training.
    """
    poses = Poses()
    candidates = scored(data, poses, progress)
    lists = chosen(candidates)
    networks: dict[str, Network] = {"shipped": load_network(SHIPPED).network}
    for seed, arm in itertools.product(range(seeds), ARMS_OF_TRAINING):
        folder = runs[0] / f"{arm}-{seed}"
        if not RunFolder(folder).network.exists():
            trained_further(data, ordinary, lists[arm], folder, steps, seed)
        networks[folder.name] = load_network(folder).network
        networks[f"mean of shipped and {folder.name}"] = mean_of(networks["shipped"], load_network(folder).network)
    sets = {"candidates": data, "ordinary": ordinary} | ({} if hard is None else {"hard": hard})
    return {
        "candidates": len(candidates),
        "refused": sum(each.deepest_m > DEEPEST_M for each in candidates),
        "bins": [told(candidates, lists, number) for number in range(len(BINS_DEG) + 1)],
        "chosen": {arm: sorted(names) for arm, names in lists.items()},
        "recipe": recipe(steps).to_json(),
        "networks": {
            name: {
                of: tested(network, RangeImages(address, "all", "test"), poses, images) for of, address in sets.items()
            }
            for name, network in networks.items()
        },
    }


class Poses:
    """Novelty of the bodies of `candidates` and `hard`, whose poses are drawn when they are asked for."""

    def __init__(self) -> None:
        wide = WideBodies()
        self.known = KnownPoses((ref.pose, wide.figure(ref).pose) for ref in wide.bodies() if ref.split == "train")
        self.candidates, self._hard = CandidateBodies(), HardBodies()
        self._refs = {ref.mesh: ref for source in (self.candidates, self._hard) for ref in source.bodies()}
        self._found: dict[str, float] = {}

    def degrees(self, mesh: str) -> float:
        """Degrees to the nearest training pose, NaN for a body of another source."""
        if mesh not in self._found:
            ref = self._refs.get(mesh)
            self._found[mesh] = math.nan if ref is None else self.known.nearest(self._pose(ref)).degrees
        return self._found[mesh]

    def _pose(self, ref: BodyRef) -> Any:
        return self.candidates.drawn(ref).pose if ref.subset == "candidates" else self._hard.figure(ref).pose


def scored(data: str, poses: Poses, progress: ProgressCallback = silent) -> list[Candidate]:
    """Score every training body of a set of candidates by the network that ships, on a few views from all sides."""
    images = RangeImages(data, "all", "train")
    views = list(dict.fromkeys(split_key(key)[1] for key in images.keys))
    few = [f"*-{views[(2 * index + 1) * len(views) // (2 * SCORED_VIEWS)]}" for index in range(SCORED_VIEWS)]
    counts = counted(load_network(SHIPPED).network, RangeImages(data, "all", "train", only=few), None, progress)
    refs = {ref.mesh: ref for ref in poses.candidates.bodies()}
    unknown = sorted(mesh for mesh, _ in counts if mesh not in refs)
    if unknown:
        raise BadConfig(f"bench mining chooses among bodies of the source 'candidates', found {unknown[0]} in {data}")
    return [
        Candidate(mesh, accuracy(each), poses.degrees(mesh), poses.candidates.drawn(refs[mesh]).deepest_m)
        for (mesh, _), each in counts.items()
    ]


def chosen(candidates: Sequence[Candidate]) -> dict[str, list[str]]:
    """Choose a third of the candidates whose skin is not too deep in itself, for either arm of the comparison.

    "mined": the worst third of each bin of novelty; "uniform": any. Raises BadConfig if there are none.
    """
    fit = sorted((each for each in candidates if each.deepest_m <= DEEPEST_M), key=lambda each: each.accuracy)
    count = len(fit) // 3
    if not count:
        raise BadConfig(f"bench mining chooses a third of the bodies without deep skin in skin, found {len(fit)}")
    by_bin: dict[int, list[Candidate]] = defaultdict(list)
    for each in fit:
        by_bin[bin_of(each.degrees)].append(each)
    ranks = {each.name: (rank + 0.5) / len(within) for within in by_bin.values() for rank, each in enumerate(within)}
    mined = sorted(ranks, key=lambda name: ranks[name])
    draws = Draws(0, 0, "mining").generator("uniform").permutation(len(fit))[:count]
    return {"mined": mined[:count], "uniform": [fit[index].name for index in draws]}


def bin_of(degrees: float) -> int:
    """Number of the bin of a novelty."""
    return int(np.searchsorted(BINS_DEG, degrees, side="right"))


def bin_name(number: int) -> str:
    """A bin in words."""
    low, high = (0.0, *BINS_DEG)[number], (*BINS_DEG, math.inf)[number]
    return f"above {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"


def told(candidates: Sequence[Candidate], lists: Mapping[str, Sequence[str]], number: int) -> dict[str, Any]:
    """Mean accuracy of the candidates of a bin, and of those that were chosen."""
    within = [each for each in candidates if bin_of(each.degrees) == number]
    groups = {"all": within} | {arm: [one for one in within if one.name in lists[arm]] for arm in lists}
    means = {name: round(float(np.mean([one.accuracy for one in group])), 4) for name, group in groups.items() if group}
    return {"degrees": bin_name(number), "bodies": {name: len(of) for name, of in groups.items()}, "accuracy": means}


def recipe(steps: int) -> Recipe:
    """The recipe of both trainings: that of `compact` at a low learning rate."""
    low = recipe_for("compact", steps=steps, batch_size=32, learning_rate=3e-4, bf16=False)
    return replace(low, geometric_augmentation=replace(low.geometric_augmentation, bust=0.25))


def trained_further(data: str, ordinary: str, names: Iterable[str], folder: Path, steps: int, seed: int = 0) -> None:
    """Train the network that ships on chosen candidates and as many ordinary images; carries on where it stopped."""
    sensor = sensor_for("all", load_sensor_model("paper"), [_LOSSES])
    patterns = [f"*-{name}-*" for name in sorted(names)]
    parts = [
        RangeImages(data, "all", "train", seed, sensor=sensor, only=patterns),
        RangeImages(ordinary, "all", "train", seed, sensor=sensor),
    ]
    images = Mixture([(part, 1.0) for part in parts], steps * recipe(steps).batch_size, seed)
    options = RunOptions(log_every=10, checkpoint_every=20, num_workers=0)
    facts = provenance(f"tools/bench mining --data {last_name(data)} --ordinary {last_name(ordinary)}")
    network = load_network(SHIPPED).network
    train(images, folder, network, recipe(steps), seed=seed, resume=True, run_options=options, facts=facts)


def mean_of(one: Network, other: Network) -> Network:
    """`other` with the mean of both networks' weights; counters, which are integers, stay."""
    ours, theirs = one.state_dict(), other.state_dict()
    means = {name: torch.lerp(ours[name], each, 0.5) for name, each in theirs.items() if each.is_floating_point()}
    other.load_state_dict(theirs | means)
    return other


def counted(
    network: Network, images: RangeImages, count: int | None, progress: ProgressCallback = silent
) -> dict[tuple[str, str], Counts]:
    """Count a network's answers, int64 [33, 33] of each body and pose."""
    found: dict[tuple[str, str], Counts] = defaultdict(lambda: ConfusionMatrix().counts)
    index = {key: number for number, key in enumerate(images.keys)}

    def watch(seen: PredictedImage, _: float) -> None:
        info = images.clean(index[seen.key]).info
        found[info.mesh, info.pose] += count_pairs(pairs_of(seen.labels, seen.predicted))

    evaluate(network, images, count, confidences=False, progress=progress, watch=watch)
    return found


def tested(network: Network, images: RangeImages, poses: Poses, count: int) -> dict[str, Any]:
    """Average per-class accuracy of test images: all, by bin of novelty, kind of pose, pose; hands of crossed arms."""
    counts = counted(network, images, count)

    def groups(name: Callable[[str, str], str]) -> dict[str, float | None]:
        sums: dict[str, Counts] = defaultdict(lambda: ConfusionMatrix().counts)
        for (mesh, pose), each in counts.items():
            sums[name(mesh, pose)] += each
        return {group: rounded(accuracy(total)) for group, total in sorted(sums.items())}

    def novelty(mesh: str, _: str) -> str:
        degrees = poses.degrees(mesh)
        return "unknown" if math.isnan(degrees) else bin_name(bin_of(degrees))

    crossed = [each for (_, pose), each in counts.items() if kind_of_pose(pose) == _CROSSED or "crossed_arms" in pose]
    return {
        "images": min(count, len(images)),
        "accuracy": groups(lambda *_: "all")["all"],
        "bins": groups(novelty),
        "kinds": groups(lambda _, pose: kind_of_pose(pose)),
        "poses": groups(lambda _, pose: pose),
        "hands_of_crossed_arms": rounded(accuracy(np.sum(crossed, axis=0), _HANDS)) if crossed else None,
    }
