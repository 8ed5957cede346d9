"""Accuracy of every network under every condition, cached so that an interrupted run carries on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from bodyseg_data.core.system.progress import NotedProgress, silent
from bodyseg_model.evaluation.result_cache import ResultCache, network_identity
from bodyseg_model.evaluation.scores import ConfusionMatrix, count_pairs, pairs_of
from bodyseg_model.networks.network import Network
from bodyseg_model.networks.registry import device_of, predict
from bodyseg_model.stability.groups import Run
from bodyseg_model.stability.scenes import LabelledImage, Scenes
from bodyseg_model.stability.sweeps import Condition

Accuracies = dict[str, dict[Condition, float]]
"""Run's name -> condition -> average per-class accuracy."""


def accuracy(network: Network, images: Sequence[LabelledImage]) -> float:
    """Average per-class accuracy of a network in evaluation mode, from one confusion matrix over all images.

    Images are predicted one by one, as a sensor gives them: the window that a batch is cropped to depends on all its
    bodies. NaN if nothing was measured in any image.
    """
    matrix = ConfusionMatrix()
    device = device_of(network)
    for image in images:
        prediction = predict(network, torch.from_numpy(image.range_m)[None, None].to(device))
        predicted = prediction.labels[0].cpu().numpy().ravel()[image.pixels]
        matrix.counts += count_pairs(pairs_of(image.truth, predicted))
    return matrix.average_per_class_accuracy()


def evaluate_conditions(
    runs: Sequence[Run],
    conditions: Sequence[Condition],
    scenes: Scenes,
    folder: Path,
    progress: NotedProgress = silent,
) -> Accuracies:
    """Measure the accuracy of every network under every condition.

    folder: receives one `ResultCache` a network, so that nothing is measured twice. progress: called with images done,
    images in all, and the condition's name. Raises BadConfig for a condition that the scenes cannot show, or as
    `ResultCache`.
    """
    for condition in conditions:
        scenes.check(condition)
    caches = {run.name: _cache(folder, run) for run in runs}
    found: Accuracies = {run.name: {} for run in runs}
    done, total = 0, len(runs) * len(conditions) * len(scenes)
    for condition in conditions:  # the outer loop, so that images are made once
        queries = {run.name: _query(scenes, condition, run) for run in runs}
        for run in runs:
            cached = caches[run.name].get(queries[run.name])
            if cached is not None:
                found[run.name][condition] = math.nan if cached["accuracy"] is None else cached["accuracy"]
        missing = [run for run in runs if condition not in found[run.name]]
        done += (len(runs) - len(missing)) * len(scenes)
        images = scenes.labelled_images(condition) if missing else []
        for run in missing:
            value = accuracy(run.trained.network, images)
            caches[run.name].put(queries[run.name], {"accuracy": None if math.isnan(value) else value})
            found[run.name][condition] = value
            done += len(scenes)
            progress(done, total, condition.name)
    return found


def _cache(folder: Path, run: Run) -> ResultCache:
    return ResultCache(folder / f"{run.name.replace('/', '+')}.json", network_identity(run.path), __name__)


def _query(scenes: Scenes, condition: Condition, run: Run) -> dict[str, Any]:
    """Everything that an accuracy depends on besides network and code."""
    return {
        "sweep": condition.sweep,
        "strength": condition.strength,
        "images": scenes.images.identity(),
        "hard": scenes.hard.identity() if condition.sweep == "hard" and scenes.hard is not None else None,
        "count": len(scenes),
        "device": device_of(run.trained.network).type,
    }
