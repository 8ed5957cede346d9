"""Training: a set of shards and a recipe -> a network. Carries on after a kill with the same bits.

All that a step does follows from seed and step number: which images (their order belongs to seed and epoch), which are
mirrored, which pixels are looked at, and what dropout drops. So a checkpoint needs weights, the optimiser's memory and
a place in the data, and no state of a random generator.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
import torch
from torch import nn

from bodyseg_data import RangeImages, loader
from bodyseg_data.core.errors import BadConfig, Diverged, check_int
from bodyseg_data.core.parts import PART_COUNT
from bodyseg_data.core.randomness import generator
from bodyseg_data.loading.loader import Loader
from bodyseg_data.loading.range_images import Batch
from bodyseg_model.evaluation.scores import ConfusionMatrix
from bodyseg_model.networks.batch_transforms import cut_to_bodies, mirror, mirror_draws
from bodyseg_model.networks.checkpoints import save_network
from bodyseg_model.networks.registry import margin, settings_of
from bodyseg_model.training.distributed import ProcessGroup
from bodyseg_model.training.loss import NetworkWithLoss, part_weights
from bodyseg_model.training.optimisers import fill_optimiser, make_optimiser, optimiser_tensors, set_learning_rate
from bodyseg_model.training.recipes import Recipe
from bodyseg_model.training.run_folder import Checkpoint, RunFolder

_SAMPLES_FOR_WEIGHTS: Final = 128


@dataclass(frozen=True)
class Metrics:
    """What a stretch of steps was like. loss, accuracy (average per class) and pixels right: means over the window, of
    the images trained on. waited: share of the time that the network waited for data.
    """

    step: int
    loss: float
    accuracy: float
    pixel_accuracy: float
    learning_rate: float
    images_per_second: float
    data_wait: float


Report = Callable[[Metrics], None]


@dataclass(frozen=True)
class RunOptions:
    """What does not change the result: steps between lines of the log, and checkpoints; loader's workers; compiling."""

    log_every: int = 20
    checkpoint_every: int = 500
    num_workers: int = 2
    compile: bool = False

    def __post_init__(self) -> None:
        check_int("log_every", self.log_every, 1)
        check_int("checkpoint_every", self.checkpoint_every, 1)
        check_int("num_workers", self.num_workers, 0)


class Training:
    """One training, from its first step or its last checkpoint to its end.

    network: with the weights to start from; name: as in `networks.NETWORKS`. seed: of mirrors, dropout and the pixels
    looked at; order and artifacts are the images' own.
    """

    def __init__(
        self,
        network: nn.Module,
        name: str,
        images: RangeImages,
        recipe: Recipe,
        folder: RunFolder,
        processes: ProcessGroup,
        seed: int = 0,
        run_options: RunOptions | None = None,
    ) -> None:
        if recipe.batch_size % processes.world_size:
            raise BadConfig(
                f"a batch of {recipe.batch_size} images cannot be shared out evenly to {processes.world_size} processes"
            )
        self.name, self.images, self.recipe, self.folder = name, images, recipe, folder
        self.processes, self.seed, self.run_options = processes, seed, run_options or RunOptions()
        self.network = network.to(processes.device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.optimiser = make_optimiser(self.network, recipe)
        self.step = 0

    def plan(self) -> dict[str, Any]:
        """What is trained on what, as plain JSON: two trainings with one plan have one result."""
        return {
            "network": self.name,
            "settings": settings_of(self.network),
            "variant": self.images.variant,
            "seed": self.seed,
            "recipe": asdict(self.recipe),
            "data": self.images.identity(),
        }

    def run(self, resume: bool, report: Report, facts: dict[str, Any]) -> None:
        """Train to the end and write the network with its card, which also holds `facts`.

        report: called with metrics every `log_every` steps, in the first process only. Raises BadConfig for a folder
        that does not fit, Diverged for a loss that is not finite, and what the loader raises.
        """
        place = self._begin(resume)
        batch = self.recipe.batch_size // self.processes.world_size
        pin = self.processes.device.type == "cuda"
        feed = loader(self.images, batch, self.run_options.num_workers, drop_last=True, pin_memory=pin)
        if place is not None:
            feed.load_state_dict(place)
        objective = self._objective()
        self.network.train()
        window = _MetricsWindow(self.processes)
        batches = _endless(feed)
        while self.step < self.recipe.steps:
            set_learning_rate(self.optimiser, self.recipe.learning_rate_at(self.step))
            torch.manual_seed(
                int(generator(self.seed, self.step, "", f"dropout {self.processes.rank}").integers(2**62))
            )
            self._one_step(objective, batches, window)
            self.step += 1
            last = self.step == self.recipe.steps
            if self.step % self.run_options.log_every == 0 or last:
                metrics = window.metrics(self.step, self.optimiser.param_groups[-1]["lr"])
                if self.processes.first:
                    self.folder.log(asdict(metrics))
                    report(metrics)
                window = _MetricsWindow(self.processes)
            if self.processes.first and (self.step % self.run_options.checkpoint_every == 0 or last):
                self.folder.keep(self._checkpoint(feed))
        if self.processes.first:
            save_network(self.folder.network, self.network, self.name, {**self.plan(), **facts})

    def _begin(self, resume: bool) -> dict[str, Any] | None:
        """Open the folder; the place in the data to go on from."""
        checkpoint = self.folder.begin(self.plan(), resume) if self.processes.first else self.folder.last()
        if checkpoint is None:
            return None
        weights = {name.partition(".")[2]: t for name, t in checkpoint.tensors.items() if name.startswith("network.")}
        memory = {name.partition(".")[2]: t for name, t in checkpoint.tensors.items() if name.startswith("optimiser.")}
        try:
            self.network.load_state_dict(weights)
        except RuntimeError as error:
            raise BadConfig(f"{self.folder.path}: the checkpoint is of another network: {error}") from error
        fill_optimiser(self.optimiser, memory)
        self.step = checkpoint.step
        if self.processes.first:
            self.folder.forget_after(self.step)
        return checkpoint.place

    def _checkpoint(self, feed: Loader) -> Checkpoint:
        weights = {f"network.{name}": tensor for name, tensor in self.network.state_dict().items()}
        memory = {f"optimiser.{name}": tensor for name, tensor in optimiser_tensors(self.optimiser).items()}
        return Checkpoint(self.step, feed.state_dict(), weights | memory)

    def _objective(self) -> nn.Module:
        weights = torch.ones(PART_COUNT)
        if self.recipe.balance:
            weights = part_weights(_part_pixels(self.images), self.recipe.balance)
        objective: nn.Module = NetworkWithLoss(
            self.network, weights, self.recipe.loss_stride, self.run_options.compile
        ).to(self.processes.device)
        if self.processes.world_size > 1:
            if self.processes.device.type == "cuda":
                objective = nn.SyncBatchNorm.convert_sync_batchnorm(objective)  # type: ignore[no-untyped-call]
            objective = nn.parallel.DistributedDataParallel(objective)
        return objective

    def _one_step(self, objective: nn.Module, batches: Iterator[tuple[int, Batch]], window: _MetricsWindow) -> None:
        device, recipe = self.processes.device, self.recipe
        self.optimiser.zero_grad(set_to_none=True)
        for turn in range(recipe.accumulate):
            with window.waiting():
                epoch, batch = next(batches)
            range_m = batch["range"].to(device, non_blocking=True)
            labels = batch["labels"].to(device, non_blocking=True)
            if recipe.crop:
                range_m, labels = cut_to_bodies(range_m, labels, margin(self.network))
            if recipe.mirror:
                range_m, labels = mirror(range_m, labels, mirror_draws(self.seed, epoch, batch["key"]).to(device))
            range_m, labels = recipe.geometric_augmentation(range_m, labels, self.seed, epoch, batch["key"])
            name = f"pixels {turn}"
            place = torch.from_numpy(generator(self.seed, self.step, "", name).random(2, np.float32))
            with self._gathered_at(objective, turn), torch.autocast(device.type, torch.bfloat16, enabled=recipe.bf16):
                loss, counts = objective(range_m, labels, place)
                if not torch.isfinite(loss):
                    raise Diverged(
                        f"the loss is {loss.item()} in step {self.step + 1}, with the samples {', '.join(batch['key'])}"
                    )
                (loss / recipe.accumulate).backward()
            window.add(loss, counts, len(batch["key"]))
        if recipe.clip:
            nn.utils.clip_grad_norm_(self.network.parameters(), recipe.clip)
        self.optimiser.step()

    def _gathered_at(self, objective: nn.Module, turn: int) -> contextlib.AbstractContextManager[None]:
        """Gradients are exchanged between processes once a step, in its last turn."""
        if self.processes.world_size > 1 and turn < self.recipe.accumulate - 1:
            quiet: contextlib.AbstractContextManager[None] = objective.no_sync()  # type: ignore[operator]  # of DDP
            return quiet
        return contextlib.nullcontext()


class _MetricsWindow:
    """Adds up what happens between two lines of the log."""

    def __init__(self, processes: ProcessGroup) -> None:
        self._processes = processes
        self._loss = torch.zeros((), device=processes.device)
        self._counts = torch.zeros(PART_COUNT, PART_COUNT, dtype=torch.int64, device=processes.device)
        self._turns = self._images = 0
        self._waited = 0.0
        self._start = time.perf_counter()

    @contextlib.contextmanager
    def waiting(self) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self._waited += time.perf_counter() - start

    def add(self, loss: torch.Tensor, counts: torch.Tensor, images: int) -> None:
        self._loss += loss.detach()
        self._counts += counts
        self._turns += 1
        self._images += images

    def metrics(self, step: int, rate: float) -> Metrics:
        loss = self._processes.add_up(self._loss).item() / (self._turns * self._processes.world_size)
        matrix = ConfusionMatrix()
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


def _endless(feed: Loader) -> Iterator[tuple[int, Batch]]:
    """Batches with their epochs, pass after pass."""
    while True:
        epoch = feed.epoch
        for batch in feed:
            yield epoch, batch


def _part_pixels(images: RangeImages) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Pixels of each part, int64 [33], in clean samples spread evenly over the set."""
    counts = np.zeros(PART_COUNT, np.int64)
    for index in np.unique(np.linspace(0, len(images) - 1, _SAMPLES_FOR_WEIGHTS).astype(int)).tolist():
        counts += np.bincount(images.clean(index).labels.ravel(), minlength=256)[:PART_COUNT]
    return counts
