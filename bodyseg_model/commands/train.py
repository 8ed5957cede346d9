"""`bodyseg train`: train a network on one variant of a set."""

from __future__ import annotations

import contextlib
import hashlib
import sys
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final, Literal

from bodyseg_data import loading
from bodyseg_data.artifacts import (
    PAPER_SENSOR,
    Artifact,
    Losses,
    MissingData,
    Noise,
    SensorModel,
    VariantName,
    kinds_of,
    load_sensor_model,
    parse_artifacts,
    sensor_for,
)
from bodyseg_data.commands import OCCLUDER_HELP, WHERE_HELP, Progress, command_line, option, provenance, rate_text
from bodyseg_data.core import BadConfig
from bodyseg_data.files import parse_json
from bodyseg_data.labels import PARTS33, TEMPLATE, LabelMap, label_map_names
from bodyseg_data.loading import DEFAULT_WORKER_METHOD, WorkerMethod
from bodyseg_data.samples import OccluderName, ReadSplit
from bodyseg_model import networks, runtimes, training
from bodyseg_model.networks import CardWords, CheckpointName

_WAIT_ADVISED: Final = 0.2  # share of a training's time spent waiting for images from which on there is advice
_CLASSES: Final = "classes"
_OF_HEADS: Final = {_CLASSES, TEMPLATE}  # settings in which a network may differ from the one that it starts from

EXAMPLE = "bodyseg train --data shards --variant all --network compact --out runs/all-0"


@dataclass(frozen=True)
class Options:
    data: tuple[str, ...] = option("sets of shards to train on, their train splits: folders or addresses", address=True)
    out: Path = option("folder of this training, new or empty, for its log, checkpoints and network")
    variant: tuple[VariantName, ...] = option(
        "artifacts that the images have: one for all sets, or each its own", ("all",)
    )
    network: networks.NetworkName = option("network to train", "compact")
    weights: tuple[float, ...] = option("weight of each set (default: its number of samples)", (), heading="Images")
    samples: int | None = option("samples in an epoch (default: as many as the sets have together)", None)
    labels: str | None = option(
        f"classes to predict: {', '.join(label_map_names())} or a label map (.toml) (default: the set's)", None
    )
    no_mirror: bool = option("never mirror images, as is needed for classes without a mirror image", False)
    occluder: OccluderName = option(OCCLUDER_HELP, "stored")
    only: tuple[str, ...] = option("take only samples whose key matches one of these patterns, like '*-d255-*'", ())
    where: tuple[str, ...] = option(WHERE_HELP, ())
    noise_mm: float | None = option("largest sigma, mm (default: the sensor's; paper: 100)", None, heading="Artifacts")
    missing: tuple[float, ...] | None = option("shares of pixels lost (default: the sensor's; paper: 0 0.05 0.5)", None)
    losses: float | None = option("largest share of pixels lost in patches or stripes (default: the sensor's)", None)
    sensor: tuple[str, ...] = option(
        "sensor models with the artifacts: names or TOML files; of several, each set is read once with each",
        (PAPER_SENSOR,),
    )
    artifacts: str = option('strengths in place of those of the sensor, as JSON like {"noise": {"high_mm": 50}}', "{}")
    recipe: training.RecipeName | None = option("recipe to start with (default: the network's)", None, heading="Recipe")
    steps: int | None = option("updates of the weights (default: the recipe's); --resume takes another number", None)
    batch_size: int | None = option("images that go through the network together (default: the recipe's)", None)
    accumulate: int | None = option("batches whose gradients are added up for a step (default: the recipe's)", None)
    learning_rate: float | None = option("learning rate of the last layer (default: the recipe's)", None, flag="lr")
    optimiser: training.OptimiserName | None = option("optimiser of the weights (default: the recipe's)", None)
    no_geometric_augmentation: bool = option("leave bodies where they are: no rotation, zoom or cuts of images", False)
    bust: float | None = option("share of the images that show only the upper body (default: the recipe's)", None)
    remnants: float = option("share of the images with remnants of a wall beside the body, as masks leave them", 0.0)
    ema: float | None = option("validate and save weights averaged by this decay, like 0.999 (default: recipe's)", None)
    start_share: float | None = option("share of the weights of --pretrained in those saved (default: none)", None)
    shuffle: Literal["global", "blocks"] = option("order of samples; blocks read a far store in few pieces", "global")
    val_share: float | None = option(
        "share of train to hold out, by subject and motion, and validate on (default: none)", None, heading="Validation"
    )
    val_every: int | None = option("steps between validations (default: 500)", None)
    val_images: int | None = option("images of each set to validate on (default: all that are held out)", None)
    keep: CheckpointName | None = option("weights to end with: best validation's or last step's (default: best)", None)
    seed: int = option("seed of initial weights, order, artifacts and all other draws", 0, heading="Run")
    resume: bool = option("carry on the training in --out from its last checkpoint", False)
    pretrained: Path | None = option(
        "weights to start from: compact, large, finder, a run's folder, a .safetensors file; for fcn_alexnet also "
        "AlexNet's (default: random weights)",
        None,
        heading="Network",
    )
    settings: str = option("settings of the network that differ from its defaults, as JSON", "{}")
    only_template: bool = option("with --pretrained: train the head of places alone; labels stay the same bits", False)
    precision: Literal["recipe", "float32", "bfloat16"] = option(
        "number type of layers; recipe: the recipe's, but float32 on a processor without instructions for bfloat16",
        "recipe",
        heading="Machine",
    )
    device: str | None = option(runtimes.DEVICE_HELP, None)
    threads: int | None = option(runtimes.THREADS_HELP, None)
    num_workers: int = option("workers that load images (0: none, the program itself does)", 2)
    worker_method: WorkerMethod = option("kind of these workers: threads or processes", DEFAULT_WORKER_METHOD)
    checkpoint_every: int = option("steps between checkpoints", 500)
    log_every: int = option("steps between lines of the log", 20)


def run(options: Options) -> int:
    """Train to the end."""
    if options.only_template and options.pretrained is None:
        raise BadConfig("--only-template trains a head for a network that is trained: give that as --pretrained")
    training.use_threads(options.threads)
    named = {each.name: getattr(options, each.name) for each in fields(training.Recipe) if hasattr(options, each.name)}
    recipe = training.recipe_for(
        options.recipe or networks.network_class(options.network).default_recipe,
        **named,
        only_places=options.only_template,
        mirror=False if options.no_mirror else None,
        geometric_augmentation=training.GeometricAugmentation() if options.no_geometric_augmentation else None,
        device=options.device,
        bf16={"recipe": None, "float32": False, "bfloat16": True}[options.precision],
    )
    if options.bust is not None:
        placed = replace(recipe.geometric_augmentation, bust=options.bust)
        recipe = replace(recipe, geometric_augmentation=placed)
    run_options = training.RunOptions(
        options.log_every, options.checkpoint_every, options.num_workers, options.worker_method
    )
    validation = _validation(options)
    settings = parse_json(options.settings.encode(), "--settings")
    planes = (TEMPLATE,) if settings.get(TEMPLATE) else ()
    sets = _open(options, "train", planes)
    images = training.mixed(sets, options.weights, options.samples, options.seed)
    start = _start(options)
    if options.start_share and start is None and not options.resume:
        raise BadConfig("--start-share is a share of a trained network's weights: give that as --pretrained")
    network = _network(options, sets[0].label_map, start, settings)
    pretrained = _pretrained(options, network, start, sets[0].label_map)
    first_process = loading.find_rank()[0] == 0
    made = (each.augmentation for each in sets if each.augmentation.variant != "none")
    clean = dict.fromkeys((each.sensor.name, each.variant) for each in made if not each.applied)
    for name, variant in clean if first_process else ():
        sys.stderr.write(f"sensor {name} has no artifact of variant {variant}: images stay clean\n")
    if options.resume and first_process and not (options.out / networks.RunFiles.CHECKPOINT).exists():
        sys.stderr.write(f"{options.out} has no checkpoint to resume: the training begins at its first step\n")
    with contextlib.ExitStack() as stack:
        report = stack.enter_context(reporting(options.out, recipe.steps, options.log_every)) if first_process else None
        trained = training.train(
            images,
            options.out,
            network,
            recipe,
            seed=options.seed,
            validation=validation,
            resume=options.resume,
            run_options=run_options,
            device=options.device,
            report=report,
            pretrained=pretrained,
            facts=provenance(command_line("bodyseg train", options)),
        )
    if validation is not None and first_process:
        card = trained.card
        score = f": validation per class {card['val_accuracy']:.1%}" if "val_accuracy" in card else ""
        sys.stderr.write(f"the network has the weights of step {card['step']} of {recipe.steps}{score}\n")
    return 0


def _open(options: Options, split: ReadSplit, planes: tuple[str, ...] = ()) -> list[loading.RangeImages]:
    """Every set, in its variant, with each of the sensors. Raises BadConfig."""
    count = len(options.data)
    if len(options.variant) not in (1, count):
        raise BadConfig(f"--variant needs one for all sets or one for each, {count}, found {len(options.variant)}")
    variants = options.variant * count if len(options.variant) == 1 else options.variant
    remnants = [loading.Remnants(options.remnants)] if split == "train" and options.remnants else []
    return [
        loading.RangeImages(
            address,
            variant,
            split,
            options.seed,
            sensor=_sensor(options, variant, sensor),
            only=options.only,
            where=options.where,
            val_share=options.val_share or 0.0,
            labels=options.labels,
            occluder=options.occluder,
            planes=planes,
            transform=remnants,
        )
        for address, variant in zip(options.data, variants, strict=True)
        for sensor in options.sensor
    ]


def _validation(options: Options) -> training.Validation | None:
    """The validation that options ask for. Raises BadConfig for one of them without images held out."""
    if not options.val_share:
        for flag, value in (
            ("--val-every", options.val_every),
            ("--val-images", options.val_images),
            ("--keep", options.keep),
        ):
            if value is not None:
                raise BadConfig(f"{flag} is for a training with images to validate on: give --val-share, like 0.1")
        return None
    return training.Validation(
        _open(options, "val"),
        training.DEFAULT_EVERY if options.val_every is None else options.val_every,
        options.val_images,
        options.keep or "best",
    )


def _sensor(options: Options, variant: VariantName, name: str) -> SensorModel:
    sensor = load_sensor_model(name)
    given: list[Artifact] = [*parse_artifacts(options.artifacts, "--artifacts", sensor)]
    if options.noise_mm is not None:
        given.append(Noise(0.0, options.noise_mm))
    if options.missing is not None:
        given.append(MissingData(options.missing))
    if options.losses is not None:
        given.append(Losses(options.losses))
    # What another set's variant has is for that set; what none has is refused.
    others = {kind for each in options.variant for kind in kinds_of(each)}.difference(kinds_of(variant))
    return sensor_for(variant, sensor, [each for each in given if each.kind not in others])


def _start(options: Options) -> networks.Trained | None:
    """The network that the training starts from; None for random or published weights. Raises BadConfig for others."""
    path = options.pretrained
    if path is None or not (path.is_dir() or path.suffix in ("", ".safetensors")):
        return None
    start = networks.load_network(path)
    _check_alike(path, "network", options.network, start.card["network"])
    return start


def _network(
    options: Options, label_map: LabelMap, start: networks.Trained | None, given: Mapping[str, Any]
) -> networks.Network:
    """A new network for these classes, with the settings of the one it starts from where none are given."""
    theirs = {} if start is None else start.network.settings
    settings = {name: value for name, value in theirs.items() if name not in _OF_HEADS}
    classes = {} if label_map == PARTS33 else {_CLASSES: len(label_map)}
    return networks.build(options.network, {**settings, **classes, **given}, options.seed)


def _pretrained(
    options: Options, network: networks.Network, start: networks.Trained | None, label_map: LabelMap
) -> dict[str, Any] | None:
    """Fill a network with trained or published weights; returns its card's entry on the file, None for random weights.

    The last layer for other classes, and a head of places on the template that the trained one lacks, keep their random
    weights. Raises BadConfig for one of other settings, or of other classes where the head of places alone is trained.
    """
    path = options.pretrained
    if path is None:
        return None
    if start is None:
        network.load_pretrained(path)
        with path.open("rb") as file:
            return _entry(path, hashlib.file_digest(file, "sha256").hexdigest())
    for name in sorted((network.settings.keys() | start.network.settings.keys()) - _OF_HEADS):
        _check_alike(path, f"setting {name}", network.settings.get(name), start.network.settings.get(name))
    new, read = network.state_dict(), start.network.state_dict()
    fit = {name: read[name] for name, weights in new.items() if name in read and read[name].shape == weights.shape}
    network.load_state_dict({**new, **fit})
    anew = ", ".join(name for name in new if name not in fit)
    if options.start_share and anew:
        raise BadConfig(f"--start-share needs all weights in --pretrained {path}, which lacks {anew}")
    if (theirs := start.label_map).difference(label_map) is not None:
        if options.only_template:
            raise BadConfig(f"--only-template needs the labels of --pretrained {path}, {theirs.name!r}")
        does = f"{anew} begin at random" if anew else "all weights are kept, as there are as many"
        sys.stderr.write(f"{path} has other classes, {theirs.name!r}: {does}\n")
    return _entry(path, start.card[CardWords.WEIGHTS_SHA256])


def _check_alike(path: Path, what: str, ours: object, theirs: object) -> None:
    if ours != theirs:
        raise BadConfig(f"--pretrained {path} must have the {what} {ours!r} of this training, found {theirs!r}")


def _entry(path: Path, digest: str) -> dict[str, Any]:
    return {"file": path.resolve().name, CardWords.WEIGHTS_SHA256: digest}


@contextlib.contextmanager
def reporting(folder: Path, steps: int, log_every: int) -> Iterator[training.Report]:
    """Report a training in `folder`: progress on standard error, and TensorBoard's log where that is installed."""
    new_board: Any = None
    try:
        from torch.utils.tensorboard import SummaryWriter

        new_board = SummaryWriter  # which makes its files when it is made
    except ImportError:
        sys.stderr.write("bodyseg train: tensorboard is not installed, figures go to log.jsonl alone\n")
    board: Any = None
    start = time.monotonic()
    first: int | None = None
    before = 0  # step of the last line
    waits: dict[str, float] = defaultdict(float)

    def report(metrics: training.Metrics) -> None:
        nonlocal board, first, before
        if metrics.waited_for is not None:
            waits[metrics.waited_for] += metrics.data_wait * min(log_every, metrics.step - before) / steps
        before = metrics.step
        first = max(0, metrics.step - log_every) if first is None else first
        left = (time.monotonic() - start) / max(1, metrics.step - first) * (steps - metrics.step)
        validated = ""
        if metrics.val_accuracy is not None:
            validated = f", validation per class {metrics.val_accuracy:.1%} (best in step {metrics.val_best_step})"
        progress.update(
            metrics.step,
            steps,
            f"loss {metrics.loss:.3f}, right {metrics.pixel_accuracy:.1%}, per class {metrics.accuracy:.1%}, "
            f"{rate_text(metrics.images_per_second, 'images')}, waited {metrics.data_wait:.0%} for data"
            f"{'' if metrics.waited_for is None else f' ({metrics.waited_for})'}"
            f"{validated}, {left:.0f} s left",
        )
        if new_board is not None:
            board = board or new_board(str(folder / "tensorboard"))  # not earlier: a refused training leaves nothing
            for name, value in metrics.to_json().items():
                if name not in ("step", "waited_for"):
                    board.add_scalar(name, value, metrics.step)

    try:
        with Progress("training", "steps") as progress:
            yield report
    finally:
        if board is not None:
            board.close()
        if waits and sum(waits.values()) > _WAIT_ADVISED:
            stage = max(waits, key=waits.__getitem__)
            sys.stderr.write(f"waited for data, mostly for {stage}; what may help: {training.WAITING_ADVICE[stage]}\n")
    if first is None:
        sys.stderr.write(f"{folder} holds this training, which has ended: a larger --steps carries it on\n")
