"""Validation: scores on images that a training does not train on, at fixed steps, and what follows from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from bodyseg_data.core.errors import BadConfig, check_int
from bodyseg_data.loading.range_images import RangeImages
from bodyseg_data.loading.workers import DEFAULT_WORKER_METHOD, WorkerMethod
from bodyseg_model.evaluation.evaluation import Evaluation, Scores, evaluate
from bodyseg_model.networks.checkpoints import CheckpointName
from bodyseg_model.networks.network import Network

DEFAULT_EVERY: Final = 500
"""Steps between two validations."""


@dataclass(frozen=True)
class Validation:
    """Images on which a training is validated, when, and what follows from it.

    images: one set or several. count: images of each, as in `evaluate`: the first in the permutation of its seed and
    epoch; None for all. So every validation sees the same images with the same draws, and `evaluate` gives its scores.
    every: steps between two validations; one more follows the last step.

    patience: number of validations in a row without a higher accuracy, after which the training ends; None for no such
    end. keep: whether the network of the run has the weights of the best validation, the first of highest average
    per-class accuracy, or those of the last step.

    Raises BadConfig for a value out of range, or no images.
    """

    images: Sequence[RangeImages]
    every: int = DEFAULT_EVERY
    count: int | None = None
    patience: int | None = None
    keep: CheckpointName = "best"

    def __post_init__(self) -> None:
        object.__setattr__(self, "images", tuple(self.images))
        if not self.images:
            raise BadConfig("a validation needs at least one set of images")
        check_int("val_every", self.every, 1)
        for name, value in (("val_images", self.count), ("patience", self.patience)):
            if value is not None:
                check_int(name, value, 1)
        if self.keep not in ("best", "last"):
            raise BadConfig(f"keep must be best or last, found {self.keep!r}")

    def plan(self) -> dict[str, Any]:
        """Facts that the scores depend on beside the network, as plain JSON."""
        return {"data": [images.identity() for images in self.images], "every": self.every, "images": self.count}

    def due(self, step: int, steps: int) -> bool:
        """Return whether a training of `steps` steps is validated after `step` steps."""
        return step % self.every == 0 or step == steps

    def exhausted(self, step: int, best_step: int) -> bool:
        """Return True if a training ends after `step` steps, the best validation being that after `best_step`."""
        return self.patience is not None and step // self.every - best_step // self.every >= self.patience

    def scores(
        self, network: Network, num_workers: int = 0, worker_method: WorkerMethod = DEFAULT_WORKER_METHOD
    ) -> Scores:
        """Score a network, in evaluation mode, on the images; the scores are whole-image, as `evaluate` counts them.

        num_workers, worker_method: see `loader`. Raises BadConfig, and as `loader`.
        """
        found = Evaluation(frozenset(), label_map=self.images[0].label_map)
        for images in self.images:
            found.merge(
                evaluate(network, images, self.count, extras=(), num_workers=num_workers, worker_method=worker_method)
            )
        return found.total()
