"""Every network before the images of every setting; answers are kept, so that what was cut short carries on."""

from __future__ import annotations

import hashlib
import inspect
import json
from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import numpy as np
import torch

from bodyseg_data.artifacts import losses
from bodyseg_data.core.errors import BadConfig
from bodyseg_model.evaluation import scores
from bodyseg_model.evaluation.scores import ConfusionMatrix, count_pairs, pairs_of
from bodyseg_model.networks import batch_transforms as crops
from bodyseg_model.networks import range_input
from bodyseg_model.networks import registry as networks
from bodyseg_model.networks.checkpoints import NETWORK, read_bytes, read_json, write_json
from bodyseg_model.networks.network import Network
from bodyseg_model.networks.registry import device_of, predict
from bodyseg_model.segmentation import resampling
from bodyseg_model.stability import scenes as scenes_module
from bodyseg_model.stability import severities
from bodyseg_model.stability.groups import Run
from bodyseg_model.stability.scenes import Picture, Scenes
from bodyseg_model.stability.severities import Setting

FORMAT: Final = "bodyseg stability answers 1"

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

    folder: keeps answers, one JSON file a network; what it knows of the same weights, images and code is not asked
    again. progress: called with images looked at, images in all, and the setting. Raises BadConfig for a damaged file
    or a setting that cannot be shown.
    """
    for setting in settings:
        scenes.check(setting)
    kept = {run.name: _Kept(folder, run) for run in runs}
    keys = {setting: _key(scenes, setting) for setting in settings}
    done, total = 0, len(runs) * len(settings) * len(scenes)
    for setting in settings:  # the outer loop, so that images are made once
        missing = [run for run in runs if keys[setting] not in kept[run.name].answers]
        done += (len(runs) - len(missing)) * len(scenes)
        pictures = scenes.pictures(setting) if missing else []
        for run in missing:
            kept[run.name].add(keys[setting], setting, accuracy(run.trained.network, pictures))
            done += len(scenes)
            progress(done, total, setting.name)
    return {
        run.name: {setting: float(kept[run.name].answers[keys[setting]]["accuracy"]) for setting in settings}
        for run in runs
    }


class _Kept:
    """The answers of one network as it is now, by the code as it is now."""

    def __init__(self, folder: Path, run: Run) -> None:
        file = run.path / NETWORK if run.path.is_dir() else run.path
        weights = hashlib.sha256(read_bytes(file)).hexdigest()
        code = _code(import_module(type(run.trained.network).__module__))
        self._of = {"weights": weights, "settings": run.trained.card.get("settings"), "code": code}
        self._file = folder / f"{run.name.replace('/', '+')}.json"
        self.answers: dict[str, dict[str, Any]] = {}
        if self._file.exists():
            content = read_json(self._file)
            if content.get("format") != FORMAT or not isinstance(content.get("answers"), dict):
                raise BadConfig(f"{self._file} holds no answers of the format {FORMAT!r}: move it away")
            if content.get("of") == self._of:
                self.answers = content["answers"]

    def add(self, key: str, setting: Setting, value: float) -> None:
        self.answers[key] = {"setting": setting.name, "accuracy": None if np.isnan(value) else value}
        write_json(self._file, {"format": FORMAT, "of": self._of, "answers": self.answers})


def _key(scenes: Scenes, setting: Setting) -> str:
    """Of all that shapes the images of a setting."""
    of_hard = scenes.hard is not None and setting.sweep == "hard"
    sets = [scenes.images.identity(), scenes.hard.identity() if of_hard and scenes.hard is not None else None]
    return _digest([setting.sweep, setting.strength, len(scenes), sets])


@cache
def _code(network: ModuleType) -> str:
    """Of the source of a network's module and of all else that shapes an answer."""
    others = crops, networks, range_input, resampling, scores, losses, severities, scenes_module
    return _digest([inspect.getsource(module) for module in (network, *others)])


def _digest(facts: Any) -> str:
    return hashlib.blake2b(json.dumps(facts, sort_keys=True).encode(), digest_size=16).hexdigest()
