"""Training loop: a set of shards and a recipe -> a network. A killed training resumes with the same bits.

Seed and step number determine all that a step does: its images (their order belongs to seed and epoch), which of them
are mirrored, the pixels that the loss selects, and dropout. So a checkpoint needs weights, the optimiser's state and
the loader's state, and no state of a random generator.
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

from bodyseg_data import loader
from bodyseg_data.core.errors import BadConfig, Diverged, check_int
from bodyseg_data.core.parts import PART_COUNT
from bodyseg_data.core.randomness import generator
from bodyseg_data.loading.image_set import Batch, ImageSet
from bodyseg_data.loading.loader import Loader
from bodyseg_data.loading.workers import DEFAULT_WORKER_METHOD, WorkerMethod, check_worker_method
from bodyseg_model.evaluation.scores import ConfusionMatrix
from bodyseg_model.networks.batch_transforms import cut_to_bodies, mirror, mirror_draws
from bodyseg_model.networks.checkpoints import save_network
from bodyseg_model.networks.network import Network
from bodyseg_model.training.distributed import ProcessGroup
from bodyseg_model.training.loss import NetworkWithLoss, part_weights
from bodyseg_model.training.optimisers import fill_optimiser, make_optimiser, optimiser_tensors, set_learning_rate
from bodyseg_model.training.recipes import Recipe
from bodyseg_model.training.run_folder import Checkpoint, RunFolder

_SAMPLES_FOR_WEIGHTS: Final = 128


@dataclass(frozen=True)
class Metrics:
    """Metrics of the steps since the last line of the log, on the images trained on.

    step: number of steps done. loss: mean over the steps. accuracy: average per class; pixel_accuracy: share of the
    selected pixels that are right. learning_rate: of the last layer, in the last step. images_per_second: over all
    processes. data_wait: share of the time spent waiting for data.
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
    """Options that are not part of a training's plan: a resumed training may have others.

    log_every, checkpoint_every: steps between lines of the log, and between checkpoints. num_workers, worker_method:
    number and kind of the workers that load images; see `loader`. compile: whether the network is compiled first.
    Raises BadConfig for a value out of range.
    """

    log_every: int = 20
    checkpoint_every: int = 500
    num_workers: int = 2
    worker_method: WorkerMethod = DEFAULT_WORKER_METHOD
    compile: bool = False

    def __post_init__(self) -> None:
        check_int("log_every", self.log_every, 1)
        check_int("checkpoint_every", self.checkpoint_every, 1)
        check_int("num_workers", self.num_workers, 0)
        check_worker_method(self.worker_method)


class Training:
    """One training, from its first step or its last checkpoint to its end.

    network: with its initial weights; name: its key in `registry.NETWORKS`. seed: of mirroring, geometric augmentation,
    dropout and the pixels that the loss selects; order and artifacts have the images' own. Raises BadConfig for batches
    that cannot be divided evenly between the processes.
    """

    def __init__(
        self,
        network: Network,
        name: str,
        images: ImageSet,
        recipe: Recipe,
        folder: RunFolder,
        processes: ProcessGroup,
        seed: int = 0,
        run_options: RunOptions | None = None,
    ) -> None:
        if recipe.batch_size % processes.world_size:
            raise BadConfig(
                f"batch_size must be a multiple of the {processes.world_size} processes, found {recipe.batch_size}"
            )
        self.name, self.images, self.recipe, self.folder = name, images, recipe, folder
        self.processes, self.seed, self.run_options = processes, seed, run_options or RunOptions()
        self.network = network.to(processes.device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.optimiser = make_optimiser(self.network, recipe)
        self.step = 0

    def __repr__(self) -> str:
        return f"Training({self.name!r}, {self.folder!r}, step {self.step} of {self.recipe.steps})"

    def plan(self) -> dict[str, Any]:
        """Network, settings, variant, seed, recipe and data as plain JSON: the same plan gives the same result."""
        return {
            "network": self.name,
            "settings": self.network.settings,
            "variant": self.images.variant,
            "seed": self.seed,
            "recipe": asdict(self.recipe),
            "data": self.images.identity(),
        }

    def run(self, resume: bool, report: Report, facts: dict[str, Any]) -> None:
        """Train to the end and write the network with its card, which also holds `facts`.

        report: called with metrics every `log_every` steps, in the first process only. Raises BadConfig for a folder of
        another plan, Diverged for a loss that is not finite, and as the loader.
        """
        loader_state = self._begin(resume)
        batch = self.recipe.batch_size // self.processes.world_size
        pin = self.processes.device.type == "cuda"
        workers, method = self.run_options.num_workers, self.run_options.worker_method
        data_loader = loader(self.images, batch, workers, drop_last=True, pin_memory=pin, worker_method=method)
        if loader_state is not None:
            data_loader.load_state_dict(loader_state)
        objective = self._objective()
        self.network.train()
        window = _MetricsWindow(self.processes)
        batches = _endless(data_loader)
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
                self.folder.keep(self._checkpoint(data_loader))
        if self.processes.first:
            save_network(self.folder.network, self.network, self.name, {**self.plan(), **facts})

    def _begin(self, resume: bool) -> dict[str, Any] | None:
        """Open the folder and restore its last checkpoint; returns the loader's state, None at the beginning."""
        checkpoint = self.folder.begin(self.plan(), resume) if self.processes.first else self.folder.last()
        if checkpoint is None:
            return None
        weights = {name.partition(".")[2]: t for name, t in checkpoint.tensors.items() if name.startswith("network.")}
        state = {name.partition(".")[2]: t for name, t in checkpoint.tensors.items() if name.startswith("optimiser.")}
        try:
            self.network.load_state_dict(weights)
        except RuntimeError as error:
            raise BadConfig(f"{self.folder.path}: the checkpoint must be of this network: {error}") from error
        fill_optimiser(self.optimiser, state)
        self.step = checkpoint.step
        if self.processes.first:
            self.folder.forget_after(self.step)
        return checkpoint.loader_state

    def _checkpoint(self, data_loader: Loader) -> Checkpoint:
        weights = {f"network.{name}": tensor for name, tensor in self.network.state_dict().items()}
        state = {f"optimiser.{name}": tensor for name, tensor in optimiser_tensors(self.optimiser).items()}
        return Checkpoint(self.step, data_loader.state_dict(), weights | state)

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

    def _one_step(self, objective: nn.Module, batches: Iterator[Batch], window: _MetricsWindow) -> None:
        device, recipe = self.processes.device, self.recipe
        self.optimiser.zero_grad(set_to_none=True)
        for index in range(recipe.accumulate):
            with window.waiting():
                batch = next(batches)
            range_m = batch["range"].to(device, non_blocking=True)
            labels = batch["labels"].to(device, non_blocking=True)
            if recipe.crop:
                network = self.network
                range_m, labels = cut_to_bodies(range_m, labels, network.margin, network.crop_multiple)
            epochs, keys = batch["epoch"], batch["key"]
            if recipe.mirror:
                range_m, labels = mirror(range_m, labels, mirror_draws(self.seed, epochs, keys).to(device))
            range_m, labels = recipe.geometric_augmentation(range_m, labels, self.seed, epochs, keys)
            name = f"pixels {index}"
            offset = torch.from_numpy(generator(self.seed, self.step, "", name).random(2, np.float32))
            with (
                self._gradient_sync(objective, index),
                torch.autocast(device.type, torch.bfloat16, enabled=recipe.bf16),
            ):
                loss, counts = objective(range_m, labels, offset)
                if not torch.isfinite(loss):
                    raise Diverged(
                        f"the loss is {loss.item()} in step {self.step + 1}, with the samples {', '.join(batch['key'])}"
                    )
                (loss / recipe.accumulate).backward()
            window.add(loss, counts, len(batch["key"]))
        if recipe.clip:
            nn.utils.clip_grad_norm_(self.network.parameters(), recipe.clip)
        self.optimiser.step()

    def _gradient_sync(self, objective: nn.Module, index: int) -> contextlib.AbstractContextManager[None]:
        """Context in which gradients are exchanged between processes in the last batch of a step only."""
        if self.processes.world_size > 1 and index < self.recipe.accumulate - 1:
            quiet: contextlib.AbstractContextManager[None] = objective.no_sync()  # type: ignore[operator]  # of DDP
            return quiet
        return contextlib.nullcontext()


class _MetricsWindow:
    """Sums over the steps between two lines of the log."""

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


def _endless(data_loader: Loader) -> Iterator[Batch]:
    """Batches, epoch after epoch."""
    while True:
        yield from data_loader


def _part_pixels(images: ImageSet) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Pixels of each part, int64 [33], in clean samples spread evenly over the set."""
    counts = np.zeros(PART_COUNT, np.int64)
    for index in images.spread(_SAMPLES_FOR_WEIGHTS).tolist():
        counts += np.bincount(images.clean(index).labels.ravel(), minlength=256)[:PART_COUNT]
    return counts
