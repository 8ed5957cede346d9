"""Reports of `bodyseg train`: lines of progress, and TensorBoard's log."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bodyseg_data.commands.progress import Progress, rate_text
from bodyseg_model.training.metrics import Metrics, Report


def silent(metrics: Metrics) -> None:
    """Report nothing."""


@contextlib.contextmanager
def reporting(folder: Path, steps: int, log_every: int) -> Iterator[Report]:
    """Report a training in `folder`: progress on standard error, and TensorBoard's log where that is installed."""
    board = _board(folder / "tensorboard")
    start = time.monotonic()
    first: list[int] = []

    def report(metrics: Metrics) -> None:
        first.append(metrics.step - log_every)
        done = metrics.step - max(0, first[0])
        left = (time.monotonic() - start) / max(1, done) * (steps - metrics.step)
        progress.update(
            metrics.step,
            steps,
            f"loss {metrics.loss:.3f}, right {metrics.pixel_accuracy:.1%}, per class {metrics.accuracy:.1%}, "
            f"{rate_text(metrics.images_per_second, 'images')}, waited {metrics.data_wait:.0%}{_validated(metrics)}, "
            f"{left:.0f} s left",
        )
        if board is not None:
            for name, value in metrics.to_json().items():
                if name != "step":
                    board.add_scalar(name, value, metrics.step)

    try:
        with Progress("training", "steps") as progress:
            yield report
    finally:
        if board is not None:
            board.close()


def _validated(metrics: Metrics) -> str:
    if metrics.val_accuracy is None:
        return ""
    return f", validation per class {metrics.val_accuracy:.1%} (best in step {metrics.val_best_step})"


def _board(path: Path) -> Any:
    """TensorBoard's writer, which makes its files at the first figures; None without the package."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        sys.stderr.write("bodyseg train: tensorboard is not installed, figures go to log.jsonl alone\n")
        return None
    return _Board(path, SummaryWriter)


class _Board:
    """Opens the writer late: a refused training leaves nothing behind."""

    def __init__(self, path: Path, writer: Any) -> None:
        self._path, self._new = path, writer
        self._writer: Any = None

    def add_scalar(self, name: str, value: float, step: int) -> None:
        if self._writer is None:
            self._writer = self._new(str(self._path))
        self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
