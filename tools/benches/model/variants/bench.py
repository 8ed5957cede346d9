"""`bench variants`: the gain of training with each artifact, and the robustness that it gives (Figs. 6 to 9).

One network for each of the five variants and each seed, alike in everything else, is evaluated on the test images of
all five variants, on two sweeps of exact strengths and on real frames. docs/results/variants.md says how to read the
results.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import time
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from statistics import mean
from typing import Any, Final

import torch

from benches.measuring import Figures, counter
from benches.model.ablation.conditions import AblationCondition, hard_condition
from benches.model.ablation.costs import loading_ms
from benches.model.chosen import parameters
from benches.model.people.bodies import annotated_bodies
from benches.model.people.scores import packed_views
from benches.model.variants.claims import ScoresOf, Tree, accuracies, claims
from benches.model.variants.real import ALTERED as ALTERED_FRAMES
from benches.model.variants.real import RealFrames, Values
from benches.model.variants.runs import Plan, Run, common_plan, origin, other_runs, runs_in, train
from benches.model.variants.scores import SWEEPS, TABLE, Condition, Evaluator, Sweep
from benches.model.variants.verdicts import ALTERED, REAL, RULE, Scores, differences, verdicts
from bodyseg_data.artifacts import VARIANTS, VariantName
from bodyseg_data.core import BadConfig, NotedProgress, silent
from bodyseg_data.loading import RangeImages
from bodyseg_data.rigs import Rig
from bodyseg_model.evaluation import over_seeds
from bodyseg_model.networks import build, find_device, load_network
from bodyseg_model.training import Metrics
from bodyseg_model.training.distributed import ProcessGroup

_PASSES: Final = 3
"""Forward passes that take as long as training on one image: one forward, and a backward of about two."""

_ACCURACY: Final = "average_per_class_accuracy"
_REAL_IMAGES: Final = 130  # that a network labels of all recordings, for the progress
_PEOPLE_VIEWS: Final = 6
_PEOPLE_POSES: Final = 10


def bench_variants(
    data: str,
    runs: tuple[Path, ...],
    seeds: int = 3,
    steps: int | None = None,
    images: int = 500,
    only_finished: bool = False,
    real: Path | None = None,
    hard: str | None = None,
    people: Path | None = None,
    together: int = 1,
    progress: NotedProgress = silent,
) -> Figures:
    """Train what is missing in the first folder of `runs`, then evaluate every network on the first `images` of `data`.

    Trainings are RUNS/VARIANT-SEED, carry on where they were cut, and share the recipe of those that are there, or else
    the preset's. Others of that recipe are further rows: NAME-SEED in the first folder, and those of the further
    folders, of any rig, which real frames alone can compare. Scores are kept in each run's cached_results.json.

    only_finished: train nothing. real: folder of recordings, see `RealFrames`. hard: a set of hard poses of the same
    rig. people: folder of meshes with landmarks, see `annotated_bodies`. together: processes that score networks side
    by side.

    Raises BadConfig for no finished training where nothing is to be trained, or trainings that differ in more than
    they may; otherwise as training and evaluating do.
    """
    planned = runs_in(runs[0], seeds)
    trainings = [run for run in planned if run.finished] if only_finished else planned
    if not trainings:
        raise BadConfig(f"--only-finished needs finished trainings VARIANT-SEED, found none in {runs[0]}")
    others = other_runs(runs, seeds)
    plan = common_plan([*trainings, *(run for run in others if not run.elsewhere)], data, steps)
    recordings = None if real is None else RealFrames(real, runs[0] / "real_labels.npz")
    work = _Work(data, trainings, others, plan, images, recordings, progress)
    with ExitStack() as stack:
        if hard is not None:
            work.more.append(hard_condition(hard))
        if people is not None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            packed_views(annotated_bodies(people, _PEOPLE_POSES), _PEOPLE_VIEWS, folder, work.rig)
            more = AblationCondition("none", label="people", title="scanned people", data=str(folder / "set"))
            work.more.append(more)
        measured = _measured(work, together)
    measured["missing"] = [run.name for run in planned if not run.finished]
    shown = () if recordings is None else recordings.shown({run.row: run.path for run in reversed(trainings)})
    return Figures(measured, shown)


class _Work:
    """Trainings compared on a set. rendered: trainings that rendered test images can compare, of the set's rig."""

    def __init__(
        self,
        data: str,
        trainings: list[Run],
        others: list[Run],
        plan: Plan,
        images: int,
        recordings: RealFrames | None,
        progress: NotedProgress,
    ) -> None:
        self.data, self.trainings, self.plan, self.images = data, trainings, plan, images
        self.recordings, self.progress = recordings, progress
        self.everything = [*trainings, *others]
        self.rendered = [run for run in self.everything if not run.elsewhere]
        self.sensors = {run.row: run.sensors for run in self.rendered if run.variant is None}
        self.evaluator = Evaluator(data, images)
        self.manifest = self.evaluator.images(TABLE["none"]).manifest
        self.test_images = min(images, len(self.evaluator.images(TABLE["none"])))
        self.more: list[AblationCondition] = [
            AblationCondition("all", label=row, sensor=sensors[0])
            for row, sensors in self.sensors.items()
            if len(sensors) == 1
        ]

    @property
    def rig(self) -> Rig:
        return self.manifest.rig

    def tests(self) -> dict[str, Condition]:
        """The conditions of the rule, by name. Raises BadConfig for a set of another rig."""
        for condition in self.more:
            found = self.evaluator.images(condition).manifest.rig
            if found != self.rig:
                raise BadConfig(f"test images '{condition.name}' must be of rig {self.rig.name}, found {found.name}")
        swept = {"noise of 40 mm": SWEEPS["noise"].at(40), "half missing": SWEEPS["missing"].at(0.5)}
        swept["flat"] = Condition("none", flat=True)
        variants = {str(variant): condition for variant, condition in TABLE.items()}
        return {**variants, **swept, **{condition.name: condition for condition in self.more}}

    def ms(self) -> Tree:
        """Processor time of a sample in the loader, by row; of a mixture, that of `<row>, <part>`, too."""
        ways = {str(variant): RangeImages(self.data, variant, "train") for variant in VARIANTS}
        parts = {
            row: {row if len(sensors) == 1 else f"{row}, {number}": each for number, each in enumerate(sensors, 1)}
            for row, sensors in self.sensors.items()
        }
        for each in parts.values():
            ways |= {name: RangeImages(self.data, "all", "train", sensor=sensor) for name, sensor in each.items()}
        found = loading_ms(ways)
        for row, each in parts.items():
            found.setdefault(row, {"ms": round(mean(found[name]["ms"] for name in each), 4)})
        return found


def _score_rendered(data: str, images: int, runs: Sequence[Run], conditions: Sequence[Condition]) -> None:
    """Score the networks of finished trainings, in a process of its own; the scores are kept beside them."""
    torch.set_num_threads(1)
    evaluator, device = Evaluator(data, images), find_device()
    networks = {run: load_network(run.path).network.to(device) for run in runs}
    for condition in conditions:  # the outer loop, so that every set of test images is opened once
        for run, network in networks.items():
            evaluator.scores(run.path, network, condition, _with_extras(run, condition))


def _score_real(recordings: RealFrames, runs: Sequence[Run]) -> None:
    """As `_score_rendered`, on real frames."""
    for run in runs:
        recordings.scores(run.path)


def _score_together(work: _Work, conditions: Sequence[Condition], processes: int) -> None:
    """Score all networks, in `processes` at a time."""
    spawned = multiprocessing.get_context("spawn")  # a forked process could not use the GPU
    with ProcessPoolExecutor(processes, spawned) as pool:
        parts = [work.rendered[start::processes] for start in range(processes)]
        waiting = [pool.submit(_score_rendered, work.data, work.images, part, conditions) for part in parts if part]
        if work.recordings is not None:
            work.recordings.make_labels()  # meanwhile, once for all
            parts = [work.everything[start::processes] for start in range(processes)]
            waiting += [pool.submit(_score_real, work.recordings, part) for part in parts if part]
        for each in waiting:
            each.result()


def _with_extras(run: Run, condition: Condition) -> bool:
    return run.variant == "all" and condition == TABLE["all"]


def _measured(work: _Work, together: int) -> dict[str, Any]:
    start = time.perf_counter()
    tests = work.tests()
    swept = (condition for sweep in SWEEPS.values() for condition in sweep.conditions)
    conditions: list[Condition] = list(dict.fromkeys([*tests.values(), *swept]))
    missing, a_step = [run for run in work.trainings if not run.finished], _PASSES * _images_a_step(work.plan)
    steps = work.plan.recipe.steps
    of_real = 0 if work.recordings is None else _REAL_IMAGES
    total = len(missing) * a_step * steps + len(work.rendered) * len(conditions) * work.test_images
    total += len(work.everything) * of_real
    advance = counter(work.progress, total)
    device = find_device()
    for done, run in enumerate(missing):

        def show(figures: Metrics, run: Run = run, before: int = done * a_step * steps) -> None:
            note = f"training {run.name}, step {figures.step} of {steps}, per class {figures.accuracy:.1%}"
            work.progress(before + a_step * figures.step, total, note)

        train(run, work.plan, work.data, ProcessGroup(0, 1, device), show)
        advance(a_step * steps, f"trained {run.name}")
    if together > 1:
        _score_together(work, conditions, together)
    found: dict[tuple[Run, Condition], Tree] = {}
    networks = {run: load_network(run.path) for run in work.rendered}
    for condition in conditions:  # the outer loop, so that every set of test images is opened once
        for run, trained in networks.items():
            network, extras = trained.network.to(device), _with_extras(run, condition)
            found[run, condition] = work.evaluator.scores(run.path, network, condition, extras)
            advance(work.test_images, f"{run.name} on {condition.name}")
    real: dict[Run, Mapping[str, Values]] = {}
    if work.recordings is not None:
        for run in work.everything:
            real[run] = work.recordings.scores(run.path)
            advance(of_real, f"{run.row}-{run.seed} on real frames")

    def scores_of(seeds: Collection[int]) -> ScoresOf:
        return lambda variant, condition: [
            found[run, condition] for run in work.trainings if run.variant == variant and run.seed in seeds
        ]

    seeds = {variant: [run.seed for run in work.trainings if run.variant == variant] for variant in VARIANTS}
    trained_on = [variant for variant in VARIANTS if seeds[variant]]
    everyone = scores_of({seed for each in seeds.values() for seed in each})
    measures = _measures(found, tests, real)
    loading = work.ms()
    manifest, plan = work.manifest, work.plan
    return {
        "scale": {
            "steps": plan.recipe.steps,
            "images_a_step": _images_a_step(plan),
            "train_images": manifest.samples("train"),
            "test_images": work.test_images,
            "test_images_of": manifest.samples("test"),
            "image": [work.rig.camera.rows, work.rig.camera.columns],
            "rig": work.rig.name,
            "seeds": max(map(len, seeds.values())),
        },
        "network": plan.network,
        "parameters": parameters(build(plan.network, plan.settings)),
        "settings": plan.settings,
        "recipe": plan.recipe.to_json(),
        "data": {"source": manifest.source, "renderer": manifest.renderer, "train": plan.data["set"]},
        "device": str(device),
        "threads": torch.get_num_threads(),
        "seconds": round(time.perf_counter() - start, 1),
        "table": {
            row: {test: over_seeds([*each[test].values()]) for test in tests}
            for row, each in measures.items()
            if "none" in each
        },
        "sweeps": {name: _curves(everyone, sweep, trained_on) for name, sweep in SWEEPS.items()},
        "real": {
            row: {
                name.split(": ", 1)[1]: over_seeds([*seeds.values()])
                for name, seeds in each.items()
                if name.startswith((REAL, ALTERED))
            }
            for row, each in measures.items()
        },
        "differences": {base: differences(measures, base) for base in ("none", "all", "sensor")},
        "loader": loading,
        "rule": RULE,
        "verdicts": verdicts(measures, {row: each["ms"] for row, each in loading.items()}),
        "claims": claims(scores_of, seeds, measures if real else None),
        "networks": [origin(run.path) for run in work.everything],
    }


def _measures(
    found: Mapping[tuple[Run, Condition], Tree],
    tests: Mapping[str, Condition],
    real: Mapping[Run, Mapping[str, Values]],
) -> Scores:
    """Row -> measure -> seed -> value: accuracy on rendered images, every measure on real frames."""
    rows: dict[str, dict[str, dict[int, float]]] = {}

    def add(run: Run, name: str, value: float) -> None:
        rows.setdefault(run.row, {}).setdefault(name, {})[run.seed] = value

    named = {condition: name for name, condition in tests.items()}
    for (run, condition), scores in found.items():
        if condition in named:
            add(run, named[condition], scores[_ACCURACY])
    for run, recordings in real.items():
        for recording, values in recordings.items():
            for name, value in values.items():
                add(run, f"{ALTERED if name in ALTERED_FRAMES else REAL}{recording}, {name}", value)
    return rows


def _images_a_step(plan: Plan) -> int:
    return plan.recipe.batch_size * plan.recipe.accumulate


def _curves(scores_of: ScoresOf, sweep: Sweep, trained_on: Sequence[VariantName]) -> Tree:
    others = list(VARIANTS[sweep.conditions[0].variant])
    curves = {}
    for variant in trained_on:
        points = [over_seeds(accuracies(scores_of, variant, condition)) for condition in sweep.conditions]
        seeds = [list(values) for values in zip(*(point["seeds"] for point in points), strict=True)]
        curves[variant] = {name: [point[name] for point in points] for name in ("mean", "sd")} | {"seeds": seeds}
    return {
        "title": sweep.title,
        "artifacts_of_the_test_images": others,
        "strengths": list(sweep.strengths),
        "curves": curves,
    }
