"""Accuracy of every network on the images of every setting, kept so that what was cut short carries on."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from bodyseg_model.evaluation.result_cache import ResultCache, network_identity
from bodyseg_model.evaluation.scores import ConfusionMatrix, count_pairs, pairs_of
from bodyseg_model.networks.network import Network
from bodyseg_model.networks.registry import device_of, predict
from bodyseg_model.stability.groups import Run
from bodyseg_model.stability.scenes import Picture, Scenes
from bodyseg_model.stability.severities import Setting

Accuracies = dict[str, dict[Setting, float]]
"""Run's name -> setting -> average per-class accuracy."""


def accuracy(network: Network, pictures: Sequence[Picture]) -> float:
    """Average per-class accuracy of a network, in evaluation mode, of one confusion matrix over all pictures.

    They are shown one by one, as a sensor gives them: what is cut out of a batch depends on all its bodies. NaN if
    nothing was measured in any.
    """
    matrix = ConfusionMatrix()
    device = device_of(network)
    for picture in pictures:
        answer = predict(network, torch.from_numpy(picture.range_m)[None, None].to(device))
        predicted = answer.labels[0].cpu().numpy().ravel()[picture.places]
        matrix.counts += count_pairs(pairs_of(picture.truth, predicted))
    return matrix.average_per_class_accuracy()


def evaluate_conditions(
    runs: Sequence[Run],
    settings: Sequence[Setting],
    scenes: Scenes,
    folder: Path,
    progress: Callable[..., None] = lambda done, total, note="": None,
) -> Accuracies:
    """The accuracy of every network in every setting.

    folder: of a `ResultCache` a network, so that nothing is measured twice. progress: called with images looked at,
    images in all, and the setting. Raises BadConfig for a setting that cannot be shown, or as `ResultCache`.
    """
    for setting in settings:
        scenes.check(setting)
    caches = {run.name: _cache(folder, run) for run in runs}
    found: Accuracies = {run.name: {} for run in runs}
    done, total = 0, len(runs) * len(settings) * len(scenes)
    for setting in settings:  # the outer loop, so that images are made once
        questions = {run.name: _question(scenes, setting, run) for run in runs}
        for run in runs:
            known = caches[run.name].get(questions[run.name])
            if known is not None:
                found[run.name][setting] = math.nan if known["accuracy"] is None else known["accuracy"]
        missing = [run for run in runs if setting not in found[run.name]]
        done += (len(runs) - len(missing)) * len(scenes)
        pictures = scenes.pictures(setting) if missing else []
        for run in missing:
            value = accuracy(run.trained.network, pictures)
            caches[run.name].put(questions[run.name], {"accuracy": None if math.isnan(value) else value})
            found[run.name][setting] = value
            done += len(scenes)
            progress(done, total, setting.name)
    return found


def _cache(folder: Path, run: Run) -> ResultCache:
    return ResultCache(folder / f"{run.name.replace('/', '+')}.json", network_identity(run.path), __name__)


def _question(scenes: Scenes, setting: Setting, run: Run) -> dict[str, Any]:
    """All that shapes an accuracy beside network and code."""
    return {
        "sweep": setting.sweep,
        "strength": setting.strength,
        "images": scenes.images.identity(),
        "hard": scenes.hard.identity() if setting.sweep == "hard" and scenes.hard is not None else None,
        "count": len(scenes),
        "device": device_of(run.trained.network).type,
    }
