"""Accuracy of every network under every condition."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from bodyseg_data.core.system.progress import NotedProgress, silent
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
    progress: NotedProgress = silent,
) -> Accuracies:
    """Measure the accuracy of every network under every condition.

    progress: called with images done, images in all, and the condition's name. Raises BadConfig, before any is
    measured, for a condition that the scenes cannot show.
    """
    for condition in conditions:
        scenes.check(condition)
    found: Accuracies = {run.name: {} for run in runs}
    done, total = 0, len(runs) * len(conditions) * len(scenes)
    for condition in conditions:  # the outer loop, so that images are made once
        images = scenes.labelled_images(condition)
        for run in runs:
            found[run.name][condition] = accuracy(run.trained.network, images)
            done += len(scenes)
            progress(done, total, condition.name)
    return found
