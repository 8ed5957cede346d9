"""`bench architectures`: networks of several families, trained the same way, compared with each other.

All are evaluated on the same test images of `all` and timed in turns on the same frames, a random forest of depth
differences among them. docs/results/architectures.md says how to read the results.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import torch
from numpy.typing import NDArray

from benches.measuring import counter
from benches.model.chosen import parameters
from benches.model.networks.architectures_forest import SHOTTONS_IMAGES, DepthForest, ForestScale, fit_forest
from benches.model.networks.architectures_runs import SHARED, Run, groups_in, is_shipped
from benches.model.networks.network import FILLED, TYPICAL
from benches.model.networks.network_frames import stretched, typical_frames
from benches.model.networks.network_times import Cell, Task, operations, timed
from benches.model.variants.scores import TABLE, Evaluator
from bodyseg_data.core import BadConfig, NotedProgress, silent
from bodyseg_data.loading import RangeImages
from bodyseg_data.machine import processors
from bodyseg_model.evaluation import evaluate, over_seeds, report
from bodyseg_model.networks import find_device

FOREST: Final = "forest"
TITLES: Final = {
    "compact": "compact",
    "fcn_alexnet": "FCN-AlexNet",
    "segformer": "SegFormer",
    "deeplab": "DeepLabV3+ on MobileNetV2",
    FOREST: "forest of depth differences",
}
"""Family -> its title in charts."""

_TASKS: Final[tuple[Task, ...]] = ("scores", "labels")
_HEADLINES: Final = {
    "cpu_ms": ("scores", FILLED, "cpu"),
    "labels_ms": ("labels", TYPICAL, "cpu"),
    "gpu_ms": ("scores", FILLED, "cuda"),
}

Tree = dict[str, Any]


def bench_architectures(
    data: str,
    runs: tuple[Path, ...],
    images: int = 200,
    views: int = 12,
    forest: int = ForestScale.images,
    progress: NotedProgress = silent,
) -> Tree:
    """Size, milliseconds a frame and accuracy of every network in the folders `runs`, each trained as NAME-SEED.

    images: how many test images of `all` of the set `data`. views: typical frames to time with. forest: how many
    training images of `data` a forest is grown on to compare with; 0: none. Scores are kept in each run's
    cached_results.json.

    cpu_ms, gpu_ms: of `forward` on one frame of 640 x 329 pixels that a body fills, float32, all threads; labels_ms: of
    `predict` on typical frames, on the processor. Raises BadConfig as `groups_in`, MissingLibrary without Anny,
    what a network needs or, for a forest, scikit-learn and numba.
    """
    groups = groups_in(runs)
    evaluator = Evaluator(data, images)
    test_images = evaluator.images(TABLE["all"])
    scale = _forest_scale(data, forest, next(iter(groups.values()))[0])
    cells = _cells()
    total = len(cells) + sum(map(len, groups.values())) + (2 if scale else 0)
    advance = counter(progress, total)
    typical = typical_frames(views)
    largest = max(typical, key=lambda frame: int((frame > 0).sum()))
    frames = {FILLED: [stretched(largest, *largest.shape)], TYPICAL: typical}
    facts = {name: _facts(group, frames[FILLED][0]) for name, group in groups.items()}
    networks = {name: group[0].network for name, group in groups.items()}
    reference = next((name for name, row in facts.items() if row["default"]), next(iter(facts)))
    if scale is not None:
        networks[FOREST] = grown = fit_forest(RangeImages(data, "all", "train"), scale)
        facts[FOREST] = _facts_of_forest(grown, scale)
        advance(1, f"grew a forest on {scale.images} images")
    times = []
    for cell in cells:
        asked = {name: one for name, one in networks.items() if cell.device == "cpu" or name != FOREST}
        times.append(timed(cell, asked, frames[cell.frame], reference))
        advance(1, f"timed {cell.task} of {cell.frame} frames on {cell.device}")
    scores: dict[str, list[Tree]] = {name: [] for name in networks}
    device = find_device()
    for name, group in groups.items():
        for run in group:
            scores[name].append(evaluator.scores(run.path, run.network.to(device), TABLE["all"], extras=False))
            advance(1, f"evaluated {run.path.name}")
    if scale is not None:
        answer = evaluate(networks[FOREST], test_images, images, confidences=False, batch_size=1)
        scores[FOREST].append(report(answer))
        advance(1, "evaluated the forest")
    recipe = next(iter(groups.values()))[0].recipe
    camera = test_images.manifest.rig.camera
    return {
        "networks": {
            name: {**facts[name], **_headlines(times, name), **_accuracies(scores[name])} for name in networks
        },
        "scale": {
            **{name: recipe[name] for name in SHARED},
            "train_images": test_images.manifest.samples("train"),
            "test_images": min(images, len(test_images)),
            "test_images_of": len(test_images),
            "image": [camera.rows, camera.columns],
            "forest_images": scale.images if scale else None,
            "shottons_forest_images": SHOTTONS_IMAGES,
        },
        "reference": reference,
        "frames": {"rows": largest.shape[0], "columns": largest.shape[1], FILLED: 1, TYPICAL: views},
        "times": times,
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "torch": torch.__version__,
    }


def _facts(group: Sequence[Run], frame: NDArray[Any]) -> Tree:
    first, network = group[0], group[0].network
    cards = {run.path.name: run.trained.card for run in group}
    settings = network.settings
    return {
        "family": first.family,
        "label": _label(first, settings),
        "default": is_shipped(first),
        "parameters": parameters(network),
        "giga_operations": operations(network, frame),
        "settings": settings,
        "recipe": first.recipe,
        "commands": {run: card.get("command") for run, card in cards.items()},
        "commits": {run: card.get("commit") for run, card in cards.items()},
    }


def _label(run: Run, settings: Tree) -> str:
    """Label of a network in charts: its family, then its share of the width or of the image, or else its own name."""
    shares = {"width": Fraction(settings.get("width", 1)), "image": Fraction(1, settings.get("shrink", 1))}
    words = [f"{what} {share.limit_denominator(99)}" for what, share in shares.items() if share < 1]
    words = words or [run.name.removeprefix(run.family).strip("_-").replace("_", " ")]
    return ", ".join([TITLES.get(run.family, run.family), *filter(None, words)])


def _facts_of_forest(forest: DepthForest, scale: ForestScale) -> Tree:
    return {
        "family": FOREST,
        "label": TITLES[FOREST],
        "default": False,
        "parameters": forest.learned,
        "giga_operations": None,  # it compares, and hardly computes
        "settings": asdict(scale),
        "recipe": None,
        "commands": {},
        "commits": {},
    }


def _forest_scale(data: str, images: int, run: Run) -> ForestScale | None:
    """None for no images. Raises BadConfig unless `data` is what the networks were trained on."""
    if images == 0:
        return None
    theirs, ours = run.trained.card["data"].get("set"), RangeImages(data, "all", "train").identity()["set"]
    if theirs != ours:
        raise BadConfig(
            f"a forest learns from what the networks learned from: {run.path} is of the set {theirs}, {data} is {ours}"
        )
    return ForestScale(images=images)


def _cells() -> list[Cell]:
    """All cells that are timed."""
    cells = [Cell(frame, task, "cpu", processors(), "float32") for frame in (FILLED, TYPICAL) for task in _TASKS]
    if torch.cuda.is_available():
        cells.append(Cell(FILLED, "scores", "cuda", processors(), "float32"))
    return cells


def _headlines(times: Sequence[Tree], name: str) -> Tree:
    rows = {(row["task"], row["frame"], row["device"]): row["networks"] for row in times}
    return {key: rows.get(way, {}).get(name, {}).get("ms") for key, way in _HEADLINES.items()}


def _accuracies(scores: Sequence[Tree]) -> Tree:
    """Over the seeds: of all images, and of every subset; null for a subset too small."""
    subsets = {}
    for name in scores[0]["subsets"]:
        values = [each["subsets"][name]["average_per_class_accuracy"] for each in scores]
        subsets[name] = None if None in values else over_seeds(values)
    return {"accuracy_all": over_seeds([each["average_per_class_accuracy"] for each in scores]), "subsets": subsets}
