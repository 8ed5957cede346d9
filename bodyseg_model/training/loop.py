"""Training: images and a recipe -> a network. A killed training resumes with the same bits.

Seed and step number determine all that a step does: its images (their order belongs to seed and epoch), which of them
are mirrored, the pixels that the loss selects, and dropout. So a checkpoint needs weights, the optimisers' state and
the loader's state, and no state of a random generator.
"""

from __future__ import annotations

import contextlib
import copy
import json
import math
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import NoneType
from typing import Any, Final, Literal

import numpy as np
import torch
from torch import nn

from bodyseg_data import RangeImages, load_template
from bodyseg_data.core import BadConfig, BodysegError, Checked, Draws, bounded, check_class, reported, signals_held
from bodyseg_data.files import claimed, last_name
from bodyseg_data.labels import PARTS33, TEMPLATE, UNLABELLED
from bodyseg_data.loading import DEFAULT_WORKER_METHOD, Batch, ImageSet, WorkerMethod
from bodyseg_data.machine import peak_mb
from bodyseg_model.networks import (
    CardWords,
    Checkpoint,
    Network,
    NetworkName,
    RunFiles,
    Trained,
    build,
    check_label_map,
    load_network,
    name_of,
    read_checkpoint,
    save_network,
)
from bodyseg_model.training.augmentation import augmented, signed_numbers
from bodyseg_model.training.distributed import ProcessGroup, joined_process_group
from bodyseg_model.training.loss import NetworkWithLoss, part_weights
from bodyseg_model.training.optimisers import fill_optimisers, make_optimisers, optimiser_tensors, set_learning_rate
from bodyseg_model.training.plan import Best, RunFolder, training_plan
from bodyseg_model.training.recipes import Recipe, recipe_for
from bodyseg_model.training.turns import TurnLoader, Turns, Weighted
from bodyseg_model.training.validation import WAITING_ADVICE, Metrics, MetricsWindow, Report, Validation


class Diverged(BodysegError):
    """Raised by `train` as soon as its loss is no longer finite."""


_OPTIMISER: Final = "optimiser."  # prefix of the optimisers' tensors in a checkpoint


def train(
    images: ImageSet | Sequence[Weighted],
    out: Path | str,
    network: Network | NetworkName = "compact",
    recipe: Recipe | None = None,
    *,
    seed: int = 0,
    validation: Validation | None = None,
    resume: bool = False,
    run_options: RunOptions | None = None,
    device: str | None = None,
    report: Report | None = None,
    pretrained: Mapping[str, Any] | None = None,
    facts: Mapping[str, Any] | None = None,
) -> Trained:
    """Train a network on images, and return it with its card, in evaluation mode on the processor.

        images = RangeImages("shards", variant="all", split="train")
        trained = train(images, "runs/all-0", recipe=recipe_for("compact", steps=2000))

    images: `RangeImages`, a `Mixture`, or a list of (images, weight) of several of them, which may differ in size: each
    batch is of one of them, in turns by their weights.
    out: the run's folder, new or empty: plan, log, checkpoints, network. `load_network(out)` loads the network again.
    network: a name, for one of as many classes as the images' label map, with weights drawn for `seed`; or a network of
    a registered class, whose weights a copy starts from. recipe: None for the network's own.
    validation: None for none; the network then has the weights of the last step. run_options: workers, and how often
    there are checkpoints and lines of the log.
    seed: of mirroring, geometric augmentation, dropout and the pixels that the loss selects; order and artifacts have
    the images' own. resume: carry on from the folder's last checkpoint, with the same bits as without a break.
    device: "cpu", "cuda:1" ...; None for a GPU if there is one. report: gets the metrics of each line of the log.
    pretrained: file and SHA-256 of the weights to start from, for plan and card. facts: further entries of the card.

    Under torchrun, the processes share each batch, and the first of them alone writes and reports. A KeyboardInterrupt
    ends the training after the step that runs, with a checkpoint; a second one ends it at once.

    Raises BadConfig for a folder in which another training is at work, that holds another one, or this one without
    `resume`; a network of other classes than the images or of no registered class; batches that cannot be divided
    evenly between the processes; or a device that is absent; Diverged for a loss that is not finite; and as `loader`.
    """
    turns = Turns(images)
    sets, label_map = turns.sets, turns.label_map
    check_class("recipe", recipe, Recipe, NoneType)
    check_class("validation", validation, Validation, NoneType)
    check_class("run_options", run_options, RunOptions, NoneType)
    if any(each.split is None and each.manifest.samples("test") for each in sets):
        warnings.warn("images to train on include the test split: open them with split='train'", stacklevel=2)
    if validation is not None and (both := _bodies(sets) & _bodies(validation.images)):
        shown = f"{len(both)} bodies named as those trained on, like {' '.join(min(both))!r}"
        warnings.warn(f"images to validate on show {shown}: if they are the same, scores are too high", stacklevel=2)
    classes = {} if label_map == PARTS33 else {"classes": len(label_map)}
    network = build(network, classes, seed) if isinstance(network, str) else copy.deepcopy(network)
    name = name_of(network)
    folder = RunFolder(Path(out))
    recipe = recipe or recipe_for(network.default_recipe)
    with joined_process_group(device) as processes:
        options = seed, run_options, validation, pretrained
        training = Training(network, name, images, recipe, folder, processes, *options)
        with claimed(folder.path, "training") if processes.first else contextlib.nullcontext():
            read_from = [last_name(each.path) for each in sets]  # cards are published
            facts = {"read_from": read_from, **(facts or {})}
            with reported("facts must be plain JSON", BadConfig, TypeError, ValueError):  # now, not at the end
                json.dumps(facts)
            training.run(resume, report or (lambda metrics: None), facts)
        processes.wait()  # the others, until the first has written the network
    return load_network(folder.path)


def _bodies(sets: Iterable[RangeImages]) -> set[tuple[str, ...]]:
    """Subset, subject and mesh of all bodies of sets that are packed from bodies."""
    tables = [images.table() for images in sets if images.manifest.fields.of_bodies]
    return {row for table in tables for row in zip(table["subset"], table["subject"], table["mesh"], strict=True)}


_WAIT_NAMED: Final = 0.01  # share of time spent waiting from which on the log says what for


@dataclass(frozen=True)
class RunOptions(Checked):
    """Options of a training that are not part of its plan, so that a resumed one may have others; for `train`.

    log_every, checkpoint_every: steps between lines of the log, and between checkpoints. num_workers, worker_method:
    number and kind of the workers that load images; see `loader`. Raises BadConfig for a value out of range.
    """

    log_every: int = bounded(20, 1)
    checkpoint_every: int = bounded(500, 1)
    num_workers: int = bounded(2, 0)
    worker_method: WorkerMethod = DEFAULT_WORKER_METHOD


class Training:
    """One training, from its first step or its last checkpoint to its end.

    network: with its initial weights; name: its key in `names.NETWORKS`. validation: by the first process alone
    while the others wait. All else is as of `train`, which also says what raises BadConfig.
    """

    def __init__(
        self,
        network: Network,
        name: str,
        images: ImageSet | Sequence[Weighted],
        recipe: Recipe,
        folder: RunFolder,
        processes: ProcessGroup,
        seed: int = 0,
        run_options: RunOptions | None = None,
        validation: Validation | None = None,
        pretrained: Mapping[str, Any] | None = None,
    ) -> None:
        turns = Turns(images)
        if recipe.batch_size % processes.world_size:
            raise BadConfig(
                f"batch_size must be a multiple of the {processes.world_size} processes, found {recipe.batch_size}"
            )
        if kinds := {torch.get_default_dtype(), *(each.dtype for each in network.parameters())} - {torch.float32}:
            raise BadConfig(f"weights and torch.get_default_dtype() must be float32 in training, found {kinds.pop()}")
        check_label_map(network, turns.label_map)
        held_out = () if validation is None else validation.images
        for each in (*turns.sets, *held_out):
            if each.unlabelled == UNLABELLED and not each.label_map.has_rest:
                raise BadConfig("images to train on have no class for surfaces of none: open them without unlabelled")
            if (differing := turns.label_map.difference(each.label_map)) is not None:
                raise BadConfig(f"all images of a training must have the same classes, found {differing}")
        # Whether there is a pair asks for mirror images first, which raises, and says for which class there is none.
        if recipe.mirror and (alike := turns.label_map.unpaired):
            no_pair = "are no pair, but half of images are mirrored: say mirror in the set's classes, or --no-mirror"
            warnings.warn(f"classes {' and '.join(alike)} {no_pair}", stacklevel=2)
        if network.on_template:
            check_template(turns)
        if recipe.only_places:
            if not network.on_template:
                raise BadConfig(f"only_places needs a network of the setting {TEMPLATE!r}, found a {name} without")
            network.requires_grad_(False).get_submodule(TEMPLATE).requires_grad_(True)
        self.name, self.images, self.recipe, self.folder = name, turns, recipe, folder
        self.processes, self.seed, self.run_options = processes, seed, run_options or RunOptions()
        self.network = network.to(processes.device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.optimisers = make_optimisers(self.network, recipe)
        self.averaged = AveragedNetwork(self.network, recipe.ema) if recipe.ema and processes.first else None
        self._start = {name: each.clone() for name, each in network.state_dict().items()} if recipe.start_share else {}
        self.validation, self.pretrained = validation, pretrained
        self.step = 0
        self._best: Best | None = None

    def plan(self) -> dict[str, Any]:
        """Everything that the result depends on, as plain JSON; see `training_plan`."""
        facts = self.name, self.network, self.images, self.recipe
        return training_plan(*facts, self.seed, self.validation, self.pretrained)

    def run(self, resume: bool, report: Report, facts: Mapping[str, Any]) -> None:
        """Train to the end and write the network with its card, which also holds `facts`.

        report: called with metrics every `log_every` steps and after each validation, in the first process only. Raises
        as `train`.
        """
        loader_state = self._begin(resume)
        batch = self.recipe.batch_size // self.processes.world_size
        pin = self.processes.device.type == "cuda"
        workers, method = self.run_options.num_workers, self.run_options.worker_method
        order: Literal["blocks"] | None = "blocks" if self.recipe.shuffle == "blocks" else None
        data_loader = self.images.loader(batch, workers, order, drop_last=True, pin_memory=pin, worker_method=method)
        if loader_state is not None:
            data_loader.load_state_dict(loader_state)
        objective = self._objective()
        self.network.train(not self.recipe.only_places)
        window = MetricsWindow(self.processes, self.network.classes)
        self._loaded = data_loader.stats()
        batches = iter(data_loader)
        whole = True
        try:
            while self.step < self.recipe.steps:
                # A first Ctrl-C breaks no step; processes that wait for each other cannot hold it back.
                alone = self.processes.world_size == 1
                with signals_held(only_first=True) if alone else contextlib.nullcontext():
                    whole = False
                    self._one_step(objective, batches, window)
                    window = self._logged(window, data_loader, report, facts)
                    last = self.step == self.recipe.steps
                    if self.processes.first and (self.step % self.run_options.checkpoint_every == 0 or last):
                        self._checkpoint(data_loader).write(self.folder.path)
                    whole = True
        except KeyboardInterrupt:
            if whole and self.step and self.processes.first:
                self._checkpoint(data_loader).write(self.folder.path)
            raise
        if self.processes.first:
            self._save(facts)

    def _logged(
        self, window: MetricsWindow, data_loader: TurnLoader, report: Report, facts: Mapping[str, Any]
    ) -> MetricsWindow:
        """Validate and log after a step for which that is due; returns the window of the next step."""
        if self.step == 1 and self.processes.first:
            self.folder.start(self.plan())  # not earlier: a first try that fails leaves the folder usable
        validation = self.validation
        if validation is not None and not validation.due(self.step, self.recipe.steps):
            validation = None
        if self.step % self.run_options.log_every and self.step < self.recipe.steps and validation is None:
            return window
        metrics = window.metrics(self.step, self.optimisers[-1].param_groups[-1]["lr"])
        now = data_loader.stats()
        if metrics.data_wait >= _WAIT_NAMED:
            slowest = max(WAITING_ADVICE, key=lambda stage: now[stage] - self._loaded[stage])
            metrics = replace(metrics, waited_for=slowest)
        self._loaded = now
        if self.processes.first:
            if validation is not None:
                metrics = self._validated(metrics, validation, facts)
            self.folder.log({**metrics.to_json(), "peak_mb": peak_mb()})
            report(metrics)
        return MetricsWindow(self.processes, self.network.classes)

    def _begin(self, resume: bool) -> dict[str, Any] | None:
        """Open the folder and restore its last checkpoint; returns the loader's state, None at the beginning."""
        checkpoint = (
            self.folder.begin(self.plan(), resume) if self.processes.first else read_checkpoint(self.folder.path)
        )
        if self.processes.first:
            self.folder.forget_after(0 if checkpoint is None else checkpoint.step)
        if checkpoint is None:
            return None
        with reported(f"{self.folder.path}: the checkpoint must be of this network", BadConfig, RuntimeError):
            self.network.load_state_dict(checkpoint.part(Checkpoint.TRAINED))
            if self.averaged is not None:
                self.averaged.network.load_state_dict(checkpoint.part(Checkpoint.AVERAGED))
        fill_optimisers(self.optimisers, checkpoint.part(_OPTIMISER))
        if self._start:  # not those that were given, which may be named once only
            self._start = {name: t.to(self.processes.device) for name, t in checkpoint.part(Checkpoint.START).items()}
        self.step = checkpoint.step
        if self.validation is not None:
            self._best = self.folder.best() if self.processes.first else None
        return checkpoint.loader_state

    def _checkpoint(self, data_loader: TurnLoader) -> Checkpoint:
        parts = {Checkpoint.TRAINED: self.network.state_dict(), _OPTIMISER: optimiser_tensors(self.optimisers)}
        parts |= {Checkpoint.START: self._start} if self._start else {}
        if self.averaged is not None:
            parts[Checkpoint.AVERAGED] = self.averaged.network.state_dict()
        tensors = {f"{prefix}{name}": tensor for prefix, part in parts.items() for name, tensor in part.items()}
        return Checkpoint(self.step, data_loader.state_dict(), tensors)

    def result(self) -> Network:
        """What is validated and saved: the trained weights or their average, with the share of those at the start."""
        trained = self.network if self.averaged is None else self.averaged.network
        if not self._start:
            return trained
        mean = copy.deepcopy(trained)
        mean.load_state_dict(Checkpoint.mean(mean.state_dict(), self._start, self.recipe.start_share))
        return mean

    def _validated(self, metrics: Metrics, validation: Validation, facts: Mapping[str, Any]) -> Metrics:
        """Validate; returns the metrics with those of the validation, and keeps the weights if they are the best."""
        workers, method = self.run_options.num_workers, self.run_options.worker_method
        result = self.result()
        scores = validation.scores(result.eval(), workers, method)
        self.network.train(not self.recipe.only_places)
        accuracy = scores.confusion.average_per_class_accuracy()
        if math.isnan(accuracy):  # these images show no body
            return metrics
        if self._best is None or accuracy > self._best.accuracy or self.recipe.only_places:  # whose labels never change
            self._best = Best(self.step, accuracy)
            save_network(self.folder.path / RunFiles.BEST, result, self.name, self._card(facts, self.step))
        right = round(scores.confusion.pixel_accuracy(), 5)
        best = self._best.step
        return replace(metrics, val_accuracy=round(accuracy, 5), val_pixel_accuracy=right, val_best_step=best)

    def _save(self, facts: Mapping[str, Any]) -> None:
        step, network = self.step, self.result()
        if self.validation is not None and self.validation.keep == "best" and self._best is not None:
            step, network = self._best.step, load_network(self.folder.path / RunFiles.BEST).network
        save_network(self.folder.network, network, self.name, self._card(facts, step))

    def _card(self, facts: Mapping[str, Any], step: int) -> dict[str, Any]:
        """Facts of the card of the weights of `step`."""
        card = {CardWords.PRETRAINED: None, **self.folder.plan(), **facts, "step": step, "last_step": self.step}
        if self._best is not None and self._best.step == step:
            card["val_accuracy"] = self._best.accuracy
        return card

    def _objective(self) -> nn.Module:
        weights = torch.ones(self.network.classes)
        if self.recipe.balance:
            if not (pixels := self.images.class_pixels()).any():
                raise BadConfig("images to train on must show a pixel that has a class, found none: is the rig right?")
            weights = part_weights(pixels, self.recipe.balance)
        objective: nn.Module = NetworkWithLoss(self.network, weights, self.recipe.loss_stride)
        objective = objective.to(self.processes.device)
        if self.processes.world_size > 1:
            if self.processes.device.type == "cuda":
                objective = nn.SyncBatchNorm.convert_sync_batchnorm(objective)  # type: ignore[no-untyped-call]
            objective = nn.parallel.DistributedDataParallel(objective)
        return objective

    def _one_step(self, objective: nn.Module, batches: Iterator[Batch], window: MetricsWindow) -> None:
        device, recipe = self.processes.device, self.recipe
        set_learning_rate(self.optimisers, recipe.learning_rate_at(self.step))
        torch.manual_seed(
            int(Draws(self.seed, self.step, "").generator(f"dropout {self.processes.rank}").integers(2**62))
        )
        self.network.zero_grad()
        for index in range(recipe.accumulate):
            with window.watch("data"):
                batch = next(batches)
            range_m = batch["range"].to(device, non_blocking=True)
            labels = batch["labels"].to(device, non_blocking=True)
            epochs, keys, places = batch["epoch"], batch["key"], None
            if self.network.on_template:
                places = signed_numbers(batch["planes"][TEMPLATE].to(device, non_blocking=True))
            sides = self.images.label_map if recipe.mirror else None
            moving = self.seed, epochs, keys, recipe.geometric_augmentation, sides, places
            range_m, labels, places = augmented(range_m, labels, *moving)
            name = f"pixels {index}"
            offset = torch.from_numpy(Draws(self.seed, self.step, "").generator(name).random(2, np.float32))
            # Gradients are exchanged between processes in the last batch of a step only.
            alone = self.processes.world_size == 1 or index == recipe.accumulate - 1
            exchange: Any = contextlib.nullcontext() if alone else objective.no_sync()  # type: ignore[operator]  # of DDP
            with exchange, torch.autocast(device.type, torch.bfloat16, enabled=recipe.bf16):
                loss, counts, off_mm = objective(range_m, labels, offset, places)
                if not torch.isfinite(loss):
                    raise Diverged(
                        f"the loss is {loss.item()} in step {self.step + 1}, with the samples {', '.join(batch['key'])}"
                    )
                (loss / recipe.accumulate).backward()
            window.add(loss, counts, len(batch["key"]), off_mm)
        if recipe.clip:
            nn.utils.clip_grad_norm_(self.network.parameters(), recipe.clip)
        for optimiser in self.optimisers:
            optimiser.step()
        if self.averaged is not None:
            self.averaged.update(self.network, self.step)
        self.step += 1


def check_template(images: Turns) -> None:
    """Raise BadConfig unless images come with the map of the body, the plane `TEMPLATE` of this package's template."""
    for each in images.sets:
        source = each.columns[TEMPLATE].source if TEMPLATE in each.planes and TEMPLATE in each.columns else None
        if source != load_template().name:
            raise BadConfig(
                f"a network with places on the template needs the plane {TEMPLATE!r} of {each.path}, of the template "
                f"{load_template().name!r}, found {source!r}: open the images with planes=[{TEMPLATE!r}]"
            )


class AveragedNetwork:
    """A network whose weights are the exponential moving average of another's (Polyak and Juditsky, 1992).

    After step t, counted from 0, average = d average + (1 - d) weights with d = min(decay, (1 + t) / (10 + t)), so that
    the first weights, which are random, are soon forgotten. The statistics of batch normalisation are averaged like the
    weights (docs/how-to/training.md has the comparison); whole numbers are copied.

    network: the averaged network, in evaluation mode. decay: the largest share that the average keeps in a step.
    """

    def __init__(self, network: Network, decay: float) -> None:
        self.network = copy.deepcopy(network).eval().requires_grad_(False)
        self.decay = decay

    @torch.no_grad()
    def update(self, network: Network, step: int) -> None:
        """Take in the weights after step `step`, counted from 0. network: of the same shape as the averaged one."""
        decay = min(self.decay, (1 + step) / (10 + step))
        weights = network.state_dict()
        for name, average in self.network.state_dict().items():
            if average.is_floating_point():
                average.lerp_(weights[name], 1 - decay)
            else:
                average.copy_(weights[name])
