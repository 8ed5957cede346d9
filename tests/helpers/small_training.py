"""Trainings of a tiny network for a few steps, and a validation whose scores are given."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import torch

from bodyseg_data import RangeImages
from bodyseg_data.loading import ImageSet
from bodyseg_model.evaluation import Scores
from bodyseg_model.networks import build
from bodyseg_model.training import GeometricAugmentation, Metrics, Recipe, RunFolder, RunOptions, Training, Validation
from bodyseg_model.training.distributed import ProcessGroup
from bodyseg_model.training.turns import Weighted

ONE: Final = ProcessGroup(0, 1, torch.device("cpu"))
TINY: Final = {"patch": 16, "widths": [8], "blocks": [1]}
RECIPE: Final = Recipe(
    steps=4,
    batch_size=2,
    accumulate=1,
    optimiser="adamw",
    learning_rate=1e-2,
    layer_decay=1.0,
    momentum=0.9,
    weight_decay=0.02,
    warmup=0.0,
    cosine=True,
    clip=1.0,
    mirror=True,
    balance=0.5,
    bf16=False,
    loss_stride=4,
    geometric_augmentation=GeometricAugmentation(roll_deg=20),
)


@dataclasses.dataclass(frozen=True)
class GivenScores(Validation):
    """A validation after every step, whose accuracies are given: step 1's first."""

    accuracies: Sequence[float] = ()
    calls: list[int] = dataclasses.field(default_factory=list)

    def scores(self, *arguments: Any) -> Scores:
        found = Scores(confidences=False)
        if (accuracy := self.accuracies[len(self.calls)]) == accuracy:
            right = round(1000 * accuracy)
            found.confusion.counts[3, 3:5] = right, 1000 - right
        self.calls.append(len(self.calls))
        return found


def train(
    data: Path,
    out: Path,
    *,
    resume: bool = False,
    report: Callable[[Metrics], None] | None = None,
    validation: Validation | None = None,
    options: RunOptions | None = None,
    settings: dict[str, Any] | None = None,
    seed: int = 0,
    images: ImageSet | Sequence[Weighted] | None = None,
    **changes: Any,
) -> list[Metrics]:
    """Train on the train split; changes: of the recipe. Returns the metrics reported."""
    said: list[Metrics] = []

    def both(metrics: Metrics) -> None:
        said.append(metrics)
        if report is not None:
            report(metrics)

    Training(
        build("compact", settings or TINY, seed),
        "compact",
        images or RangeImages(data, "all", "train", seed),
        dataclasses.replace(RECIPE, **changes),
        RunFolder(out),
        ONE,
        seed,
        options or RunOptions(1, 1, 0),
        validation,
    ).run(resume, both, {"commit": "none"})
    return said


class CutError(Exception):
    """Ends a training where a test wants it to."""


def cut_at(step: int) -> Callable[[Metrics], None]:
    """A report that ends the training after `step`'s line of the log, before its checkpoint."""

    def cut(metrics: Metrics) -> None:
        if metrics.step == step:
            raise CutError

    return cut


def log(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]


def written(out: Path) -> dict[str, bytes]:
    """Bytes of the weights and cards in a folder."""
    return {path.name: path.read_bytes() for path in out.iterdir() if path.name.startswith(("network.", "best."))}
