"""`bodyseg stability`: robustness of networks to sensor artifacts."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

from bodyseg_data import loading
from bodyseg_data.commands import WHERE_HELP, Progress, check_target, command_line, option, provenance
from bodyseg_data.core import BadConfig, check_int
from bodyseg_data.drawing import new_chart
from bodyseg_data.files import last_name, make_folder, write_json
from bodyseg_data.labels import PART_CLASSES
from bodyseg_model import networks, runtimes, stability, training

EXAMPLE = "bodyseg stability --run runs/all-0 runs/all-1 --data shards --out stability"

_FORMAT: Final = "bodyseg stability 1"


@dataclass(frozen=True)
class Options:
    run: tuple[Path, ...] = option("trainings' folders or .safetensors files; seeds of one training make a group")
    data: str = option("set of shards whose test split is used: folder or address", address=True)
    out: Path = option("folder that gets stability.json and stability.png")
    reference: tuple[Path, ...] = option(
        "runs that mCE compares with, such as FCN-AlexNet trained on none (default: no mCE)", ()
    )
    hard: str | None = option("set of hard poses, for the sweep 'hard' (default: without it)", None, address=True)
    sweeps: tuple[str, ...] = option(f"sweeps to measure: {', '.join(stability.SWEEPS)} (default: all)", ())
    where: tuple[str, ...] = option(WHERE_HELP, ())
    images: int = option("images at each strength of a sweep", 40)
    seed: int = option("seed of the artifacts, and of the images drawn by --images", 0)
    device: str | None = option(runtimes.DEVICE_HELP, None)
    threads: int | None = option(runtimes.THREADS_HELP, None)


def run(options: Options) -> int:
    """Measure the sweeps, write stability.json, then draw."""
    check_int("--images", options.images, 1)
    sweeps = stability.chosen(options.sweeps, options.hard is not None)
    threads = training.use_threads(options.threads)
    device = networks.find_device(options.device)
    facts = provenance(command_line("bodyseg stability", options))  # first, as files may change meanwhile
    runs = stability.load_runs((*options.run, *options.reference))
    groups = stability.group(runs)
    reference = stability.group_of(groups, options.reference)
    new_chart(1, 1)  # fail now if matplotlib is missing, not after hours
    written, picture = options.out / "stability.json", options.out / "stability.png"
    check_target(written, "--out", new_folder=True)
    start = time.perf_counter()
    for each in runs:
        each.trained.network.to(device)
    figures: dict[str, Any] = {
        "format": _FORMAT,
        **facts,
        "device": str(device),
        "threads": threads,
        "networks": {
            each.name: {name: each.trained.card.get(name) for name in ("command", "commit", "hardware")}
            for each in runs
        },
        **_images(options, runs, groups, sweeps, reference),
    }
    figures["seconds"] = round(time.perf_counter() - start, 1)
    make_folder(options.out)
    write_json(written, figures)
    stability.draw_stability(figures, picture)
    sys.stdout.writelines(f"{line}\n" for line in _curves(figures))
    sys.stderr.write(f"{_remarks(groups, reference)}wrote {written}, {picture}\n")
    return 0


def _curves(figures: dict[str, Any]) -> Iterator[str]:
    """A line for each sweep and group: average per class at each strength, per cent, and gross errors at the last."""
    for name, sweep in figures["sweeps"].items():
        for label, scores in figures["groups"].items():
            rows = zip(sweep["strengths"], scores["curves"][name]["mean"], strict=True)
            far = scores["gross_errors"][name]
            gross = "" if far is None else f"; there {100 * far['beyond_30_mm']['mean'][-1]:.1f} % beyond 30 mm"
            means = ", ".join(f"{100 * mean:.1f} % at {each:g}" for each, mean in rows)
            yield f"{name} ({sweep['axis']}), {label}: {means}{gross}"


def _images(
    options: Options,
    runs: list[stability.Run],
    groups: list[stability.Group],
    sweeps: dict[str, stability.Sweep],
    reference: stability.Group | None,
) -> dict[str, Any]:
    """Measure the sweeps over images."""
    opened = partial(loading.RangeImages, variant="none", split="test", seed=options.seed, where=options.where)
    images, hard = opened(options.data), None if options.hard is None else opened(options.hard)
    for each in filter(None, (images, hard)):
        if each.manifest.classes != PART_CLASSES:
            raise BadConfig(
                f"{each.path}: stability is measured on the 33 parts of bodies, found the classes "
                f"{each.manifest.classes.name!r}"
            )
    sweeps = stability.of_rig(sweeps, images.manifest.rig)
    conditions = [*dict.fromkeys(each for name, sweep in sweeps.items() for each in sweep.conditions(name))]
    with Progress("building", "bodies") as bodies, Progress("stability", "images") as progress:
        scenes = stability.Scenes(images, options.images, hard, bodies.update)
        found = stability.evaluate_conditions(runs, conditions, scenes, progress.update)
    return {
        "images": len(scenes),
        "seed": options.seed,
        "data": _describe(images),
        "hard": None if hard is None else _describe(hard),
        **stability.summarise(groups, sweeps, found, reference),
    }


def _describe(images: loading.RangeImages) -> dict[str, Any]:
    return {
        "name": last_name(images.path),
        "source": images.manifest.source,
        "rig": images.manifest.rig.name,
        "samples_of_split": len(images),
        "digest": images.identity()["set"],
    }


def _remarks(groups: list[stability.Group], reference: stability.Group | None) -> str:
    """Lines for standard error about missing seeds or reference."""
    few = [each.label for each in groups if each.few_seeds]
    lines = [f"fewer than {stability.FEWEST_SEEDS} seeds, so no spread to speak of: {', '.join(few)}\n"] if few else []
    lines += [] if reference is not None else ["no --reference, so no mCE\n"]
    return "".join(lines)
