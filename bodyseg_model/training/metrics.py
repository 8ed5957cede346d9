"""Metrics of a training, over the steps between two lines of its log."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import torch

from bodyseg_model.evaluation.scores import ConfusionMatrix
from bodyseg_model.training.distributed import ProcessGroup


@dataclass(frozen=True)
class Metrics:
    """Metrics of the steps since the last line of the log, on the images trained on.

    step: number of steps done. loss: mean over the steps. accuracy: average per class; pixel_accuracy: share of the
    selected pixels that are right. learning_rate: of the last layer, in the last step. images_per_second: over all
    processes. data_wait: share of the time spent waiting for data.

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
    val_accuracy: float | None = None
    val_pixel_accuracy: float | None = None
    val_best_step: int | None = None

    def to_json(self) -> dict[str, Any]:
        """The metrics as a JSON object, without those that are None."""
        return {name: value for name, value in asdict(self).items() if value is not None}


Report = Callable[[Metrics], None]
"""Function that is called with the metrics of each line of the log."""


class MetricsWindow:
    """Sums over the steps between two lines of the log; classes: number of classes that the network tells apart."""

    def __init__(self, processes: ProcessGroup, classes: int) -> None:
        self._processes, self._classes = processes, classes
        self._loss = torch.zeros((), device=processes.device)
        self._counts = torch.zeros(classes, classes, dtype=torch.int64, device=processes.device)
        self._turns = self._images = 0
        self._waited = 0.0
        self._start = time.perf_counter()

    @contextlib.contextmanager
    def waiting(self) -> Iterator[None]:
        """Count the time that the context lasts as waiting for data."""
        start = time.perf_counter()
        yield
        self._waited += time.perf_counter() - start

    def add(self, loss: torch.Tensor, counts: torch.Tensor, images: int) -> None:
        """Add the loss and confusion matrix of a batch of `images` images."""
        self._loss += loss.detach()
        self._counts += counts
        self._turns += 1
        self._images += images

    def metrics(self, step: int, rate: float) -> Metrics:
        """Metrics after `step` steps, of all processes, each of which must call this. rate: learning rate."""
        loss = self._processes.add_up(self._loss).item() / (self._turns * self._processes.world_size)
        matrix = ConfusionMatrix(self._classes)
        matrix.counts += self._processes.add_up(self._counts).cpu().numpy()
        seconds = time.perf_counter() - self._start
        right = matrix.counts.trace() / max(1, matrix.counts.sum())
        return Metrics(
            step,
            round(loss, 5),
            round(matrix.average_per_class_accuracy(), 5),
            round(float(right), 5),
            rate,
            round(self._images * self._processes.world_size / seconds, 2),
            round(self._waited / seconds, 4),
        )
