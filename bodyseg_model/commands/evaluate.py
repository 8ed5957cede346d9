"""`bodyseg evaluate`: score a network on the test split of one set or several."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from bodyseg_data import loading
from bodyseg_data.artifacts import PAPER_SENSOR, VariantName, load_sensor_model, parse_artifacts
from bodyseg_data.commands import OCCLUDER_HELP, WHERE_HELP, Progress, check_target, command_line, option, provenance
from bodyseg_data.core import BadConfig, reported
from bodyseg_data.drawing import new_chart, save_picture
from bodyseg_data.files import last_name, make_folder, read_json, write_json
from bodyseg_data.labels import LabelMap
from bodyseg_data.loading import DEFAULT_WORKER_METHOD, WorkerMethod
from bodyseg_data.machine import peak_mb
from bodyseg_data.samples import OccluderName, ReadSplit
from bodyseg_model import evaluation, networks, runtimes, training

EXAMPLE = "bodyseg evaluate --run runs/all-0 --data shards --json all-0.json"

_FORMAT: Final = "bodyseg evaluation 1"
_OF_IMAGES: Final = ("variant", "split", "val_share", "where", "seed", "sensor", "noise_mm", "missing")
"""Options that are stored with the scores."""


@dataclass(frozen=True)
class Options:
    data: tuple[str, ...] = option("sets of shards to score on: folders or addresses", address=True)
    json: Path = option("write the scores to this file")
    run: Path | None = option(runtimes.RUN_HELP, None, heading="Network")
    backend: runtimes.BackendName | None = option(runtimes.BACKEND_HELP, None)
    precision: runtimes.Precision | None = option(runtimes.PRECISION_HELP, None)
    flip_average: bool = option(runtimes.FLIP_HELP, False)
    variant: VariantName = option("artifacts that the images have", "all", heading="Images")
    split: ReadSplit = option("split of the sets to score", "test")
    val_share: float = option("share of the train split that counts as val, not as train", 0.0)
    where: tuple[str, ...] = option(WHERE_HELP, ())
    images: int | None = option("number of images of each set, drawn from the split by --seed (default: all)", None)
    noise_mm: float | None = option("sigma of the noise, mm, of every image (default: drawn, as the sensor says)", None)
    missing: float | None = option("share of pixels missing, of every image (default: drawn, as the sensor says)", None)
    labels: str | None = option("label map to score by, joined from the network's classes (default: its own)", None)
    sensor: str = option("sensor model with the artifacts: the name of one that ships, or a TOML file", PAPER_SENSOR)
    occluder: OccluderName = option(OCCLUDER_HELP, "stored")
    artifacts: str = option('strengths in place of those of the sensor, as JSON like {"noise": {"high_mm": 50}}', "{}")
    seed: int = option("seed of the artifacts, and of the images drawn by --images", 0)
    other_rig: bool = option("score images of a rig far from the network's own, too (default: refuse them)", False)
    figures: Path | None = option("also draw charts and sample images, PNGs, into this folder", None, heading="Report")
    frames: int = option("images on which the network is timed, one by one (0: not at all)", 50)
    batch_size: int = option("images that go through the network together", 16, heading="Machine")
    num_workers: int = option("workers that load images (0: none, the program itself does)", 2)
    worker_method: WorkerMethod = option("kind of these workers: threads or processes", DEFAULT_WORKER_METHOD)
    device: str | None = option(runtimes.DEVICE_HELP, None)
    threads: int | None = option(runtimes.THREADS_HELP, None)


def run(options: Options) -> int:
    """Evaluate, write the scores, then draw the figures."""
    _check(options)
    trained = runtimes.load_network(options.run)
    trained = runtimes.put_on_backend(trained, options.backend, options.precision, options.flip_average)
    step, recipe = trained.card.get("step"), trained.card.get("recipe")
    steps = recipe.get("steps") if isinstance(recipe, dict) else None
    if isinstance(step, int) and step != steps:
        sys.stderr.write(f"the network's weights are those after step {step} of {steps}\n")
    runtimes.to_device(trained.network, options.device)
    sets = _open(options, trained.label_map if options.labels is None else options.labels)
    _check_fit(options, trained, sets)
    facts = _facts(options, trained)  # first, as files may change meanwhile
    picture = None if options.figures is None else evaluation.SamplePicture(sets[0].label_map)
    found = _evaluate(options, trained, sets, picture)
    timed = [sets[0][index]["range"][None] for index in sets[0].order(sets[0].epoch)[: options.frames].tolist()]
    times = evaluation.time_frames(trained.network, timed) if timed else None
    scores = evaluation.report(found)
    seconds = {stage: round(value / 1000, 2) for stage, value in found.milliseconds.items()}
    described = [_describe(images, options.images, trained) for images in sets]
    if options.figures is not None:
        make_folder(options.figures)  # which may hold the scores, too
    write_json(
        options.json,
        {
            **facts,
            "data": described,
            **scores,
            "milliseconds_per_frame": times,
            "seconds": seconds,
            "peak_mb": peak_mb(),
        },
    )
    written = [options.json]
    if options.figures is not None:
        written += evaluation.draw_figures(scores, options.figures)
        drawn = None if picture is None else picture.draw()
        if drawn is not None:
            written.append(options.figures / "samples.png")
            save_picture(drawn, written[-1])
    sys.stderr.write(f"{headline(scores)}\nwrote {', '.join(map(str, written))}\n")
    return 0


def _check(options: Options) -> None:
    for name, value, least in (("images", options.images, 1), ("frames", options.frames, 0)):
        if value is not None and value < least:
            raise BadConfig(f"--{name} must be at least {least}, found {value}")
    if options.figures is not None:
        new_chart(1, 1)  # fail now if matplotlib is missing, not after hours
        check_target(options.figures / "parts.png", "--figures", new_folder=True)
    check_target(options.json, "--json", new_folder=options.json.parent == options.figures)
    if options.json == options.figures:
        raise BadConfig(f"--json needs another name than the folder --figures, found {options.json}")
    if options.json.is_file() and options.json.stat().st_size:
        with reported("--json may replace earlier scores alone", BadConfig):
            if read_json(options.json).get("format") != _FORMAT:
                raise BadConfig(f"found another file, {options.json}")
    training.use_threads(options.threads)


def _open(options: Options, labels: str | LabelMap) -> list[loading.RangeImages]:
    """Open the sets. Raises BadConfig if two of them share a sample, which would count twice."""
    sets, path_of = [], dict[str, str]()
    sensor = load_sensor_model(options.sensor)
    artifacts = parse_artifacts(options.artifacts, "--artifacts", sensor)
    for path in options.data:
        images = evaluation.open_images(
            path,
            options.variant,
            options.split,
            options.seed,
            noise_mm=options.noise_mm,
            missing=options.missing,
            artifacts=artifacts,
            sensor=sensor,
            where=options.where,
            val_share=options.val_share,
            labels=labels,
            occluder=options.occluder,
        )
        for key in images.keys:
            if key in path_of:
                raise BadConfig(f"a sample counts once: {key} of {path} is also in {path_of[key]}")
        path_of |= dict.fromkeys(images.keys, path)
        sets.append(images)
    return sets


def _check_fit(options: Options, trained: networks.Trained, sets: list[loading.RangeImages]) -> None:
    """Warn of images of another rig or with other artifacts; raises BadConfig for a rig that is far off."""
    for images in sets:
        name = last_name(images.path)
        fit = evaluation.RigFit.worst(trained.rig, images.manifest.rigs)
        for line in (fit.check(name, options.other_rig), evaluation.sensor_warning(trained, images.augmentation, name)):
            if line is not None:
                sys.stderr.write(f"bodyseg evaluate: warning: {line}\n")


def _evaluate(
    options: Options,
    trained: networks.Trained,
    sets: list[loading.RangeImages],
    picture: evaluation.SamplePicture | None,
) -> evaluation.Evaluation:
    total = sum(_count(images, options.images) for images in sets)
    found, before = evaluation.Evaluation(label_map=sets[0].label_map), 0

    def show(done: int, _: int) -> None:
        progress.update(before + done, total)

    with Progress("evaluating", "images") as progress:
        for images in sets:
            found.merge(
                evaluation.evaluate(
                    trained.network,
                    images,
                    options.images,
                    label_map=trained.label_map,
                    batch_size=options.batch_size,
                    num_workers=options.num_workers,
                    worker_method=options.worker_method,
                    progress=show,
                    watch=None if picture is None else picture.watch,
                )
            )
            before += _count(images, options.images)
    return found


def _facts(options: Options, trained: networks.Trained) -> dict[str, Any]:
    """Provenance of the scores: command, network, artifacts."""
    facts: dict[str, Any] = {"format": _FORMAT, **provenance(command_line("bodyseg evaluate", options))}
    facts["run"] = None if options.run is None else options.run.name
    facts["card"] = trained.card
    facts["runtime"] = runtimes.backend_of(trained.network)
    return facts | {name: getattr(options, name) for name in _OF_IMAGES}


def _describe(images: loading.RangeImages, count: int | None, trained: networks.Trained) -> dict[str, Any]:
    manifest, identity = images.manifest, images.identity()
    return {
        "name": last_name(images.path),
        "source": manifest.source,
        "renderer": manifest.renderer,
        "rig": ", ".join(rig.name for rig in manifest.rigs),
        "pixels_a_metre_of_trained": round(evaluation.RigFit.worst(trained.rig, manifest.rigs).pixels_a_metre, 4),
        "image": [manifest.rig.camera.rows, manifest.rig.camera.columns],
        "samples_of_split": len(images),
        "evaluated": _count(images, count),
        "digest": identity["set"],
        "artifacts": identity["artifacts"],
    }


def _count(images: loading.RangeImages, count: int | None) -> int:
    return len(images) if count is None else min(count, len(images))


def headline(scores: dict[str, Any]) -> str:
    """Scores of an evaluation in one line: accuracy, gross errors, and accuracy where confidence is above 70 %."""

    def percent(share: float | None) -> str:
        return "-" if share is None else f"{100 * share:.1f} %"

    kept, gross = scores["confidence"]["above_70_percent"], scores["gross_errors"]
    line = f"{scores['images']} images: average per-class accuracy {percent(scores['average_per_class_accuracy'])}, "
    if gross is not None:
        line += f"{percent(gross['beyond_30_mm'])} of pixels farther than 30 mm from the part predicted for them, "
    if kept["average_per_class_accuracy"] is None:
        return line + "no pixel with a confidence above 70 %"
    return line + (
        f"{percent(kept['average_per_class_accuracy'])} where confidence is above 70 % "
        f"({percent(kept['share_of_pixels'])} of pixels)"
    )
