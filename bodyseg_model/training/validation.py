"""Validation, scores at fixed steps on images that a training does not train on, and metrics of the steps between."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import torch

from bodyseg_data.core import BadConfig, Stopwatch, bounded, check_fields
from bodyseg_data.loading import DEFAULT_WORKER_METHOD, RangeImages, WorkerMethod
from bodyseg_model.evaluation import ConfusionMatrix, Evaluation, Scores, evaluate
from bodyseg_model.networks import CheckpointName, Network
from bodyseg_model.training.distributed import ProcessGroup

DEFAULT_EVERY: Final = 500
"""Steps between two validations."""


@dataclass(frozen=True)
class Metrics:
    """Metrics of the steps since the last line of the log, on the images trained on.

    step: number of steps done. loss: mean over the steps. accuracy: average per class; pixel_accuracy: share of the
    selected pixels that are right. learning_rate: of the last layer, in the last step. images_per_second: over all
    processes. data_wait: share of the time spent waiting for data; waited_for: the stage of loading that took longest
    meanwhile (`Loader.stats`), None below 1 %. off_mm: mean distance of predicted places on the template from the true
    ones, mm; None for a network without places.

    val_accuracy, val_pixel_accuracy: average per class, and share of all pixels that are right, on the images held out
    for validation; val_best_step: step of the highest val_accuracy so far. None in steps without a validation.
    """

    step: int
    loss: float
    accuracy: float
    pixel_accuracy: float
    learning_rate: float
    images_per_second: float
    data_wait: float
    waited_for: str | None = None
    off_mm: float | None = None
    val_accuracy: float | None = None
    val_pixel_accuracy: float | None = None
    val_best_step: int | None = None

    def to_json(self) -> dict[str, Any]:
        """The metrics as a JSON object, without those that are None, or NaN where no pixel counts."""
        return {name: value for name, value in asdict(self).items() if value is not None and value == value}


WAITING_ADVICE: Final = {
    **dict.fromkeys(("decode", "artifacts", "transform", "deliver"), "--num-workers, up to the number of processors"),
    "store": "--shuffle blocks, a cache with room for the set, or a nearer store",
}
"""Stage of loading -> what helps a training that waits for it."""

Report = Callable[[Metrics], None]
"""Function that is called with the metrics of each line of the log."""


class MetricsWindow:
    """Sums over the steps between two lines of the log; classes: number of classes that the network tells apart.

    watch: its stage "data" is waiting for data.
    """

    def __init__(self, processes: ProcessGroup, classes: int) -> None:
        self._processes, self._classes = processes, classes
        self._loss = torch.zeros((), device=processes.device)
        self._counts = torch.zeros(classes, classes, dtype=torch.int64, device=processes.device)
        self._off_mm: torch.Tensor | None = None
        self._turns = self._images = 0
        self.watch = Stopwatch(("data",))
        self._start = time.perf_counter()

    def add(self, loss: torch.Tensor, counts: torch.Tensor, images: int, off_mm: torch.Tensor | None = None) -> None:
        """Add the loss, the confusion matrix and the error of places, if any, of a batch of `images` images."""
        self._loss += loss.detach()
        if off_mm is not None:
            self._off_mm = off_mm if self._off_mm is None else self._off_mm + off_mm
        self._counts += counts
        self._turns += 1
        self._images += images

    def metrics(self, step: int, rate: float) -> Metrics:
        """Metrics after `step` steps, of all processes, each of which must call this. rate: learning rate."""
        batches = self._turns * self._processes.world_size
        loss = self._processes.add_up(self._loss).item() / batches
        off_mm = None if self._off_mm is None else round(self._processes.add_up(self._off_mm).item() / batches, 2)
        matrix = ConfusionMatrix(self._classes)
        matrix.counts += self._processes.add_up(self._counts).cpu().numpy()
        seconds = time.perf_counter() - self._start
        return Metrics(
            step,
            round(loss, 5),
            round(matrix.average_per_class_accuracy(), 5),
            round(matrix.pixel_accuracy(), 5),
            rate,
            round(self._images * self._processes.world_size / seconds, 2),
            round(self.watch.milliseconds["data"] / 1000 / seconds, 4),
            off_mm=off_mm,
        )


@dataclass(frozen=True)
class Validation:
    """Images on which a training is validated, when, and which weights it ends with; for `train`.

    images: one set or several. count: images of each set, the first in the permutation of its seed and epoch, as in
    `evaluate`; None for all. So all validations see the same images and draws, and `evaluate` gives their scores.
    every: steps between two validations; one more follows the last step.
    keep: "best" for the weights of the best validation, the first of highest average per-class accuracy (the last,
    where the head of places alone is trained); "last" for those of the last step.

    Raises BadConfig for a value out of range, or no images.
    """

    images: Sequence[RangeImages]
    every: int = bounded(DEFAULT_EVERY, 1)
    count: int | None = bounded(None, 1)
    keep: CheckpointName = "best"

    def __post_init__(self) -> None:
        given: Any = self.images
        object.__setattr__(self, "images", (given,) if isinstance(given, RangeImages) else given)
        check_fields(self)
        if not self.images or not all(isinstance(images, RangeImages) for images in self.images):
            raise BadConfig(f"a validation needs one or several RangeImages, found {self.images!r:.60}")
        object.__setattr__(self, "images", tuple(self.images))

    def plan(self) -> dict[str, Any]:
        """Facts, beside the network, on which the scores depend, as plain JSON."""
        return {"data": [images.identity() for images in self.images], "every": self.every, "images": self.count}

    def due(self, step: int, steps: int) -> bool:
        """Return whether a training of `steps` steps is validated when `step` of them are done."""
        return step % self.every == 0 or step == steps

    def scores(
        self, network: Network, num_workers: int = 0, worker_method: WorkerMethod = DEFAULT_WORKER_METHOD
    ) -> Scores:
        """Score a network, in evaluation mode, on the images: on whole images, as `evaluate` counts.

        num_workers, worker_method: see `loader`. Raises BadConfig, and as `loader`.
        """
        found = Evaluation(confidences=False, label_map=self.images[0].label_map)
        for images in self.images:
            found.merge(
                evaluate(
                    network, images, self.count, confidences=False, num_workers=num_workers, worker_method=worker_method
                )
            )
        return found.total()
