"""`bench variants`: the gain of training with each artifact, and the robustness that it gives (Figs. 7 and 8).

One network for each of the five variants and each seed, alike in everything else, is evaluated on the test images of
all five variants and on two sweeps of exact strengths. docs/results/variants.md says how to read the results.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch

from benches.model.chosen import parameters
from benches.model.variants.claims import ScoresOf, Tree, accuracies, claims
from benches.model.variants.runs import NETWORK, Plan, Run, common_plan, origin, runs_in, train
from benches.model.variants.scores import SWEEPS, SWEEPS_ALONE, TABLE, Condition, Evaluator, Sweep
from bodyseg_data.artifacts import VARIANTS, VariantName
from bodyseg_data.core import BadConfig, NotedProgress, check_int, silent
from bodyseg_model.evaluation import over_seeds
from bodyseg_model.networks import build, find_device, load_network
from bodyseg_model.training import Metrics
from bodyseg_model.training.distributed import ProcessGroup

_PASSES: Final = 3
"""Forward passes that take as long as training on one image: one forward, and a backward of about two."""


def bench_variants(
    data: str,
    runs: tuple[Path, ...],
    seeds: int = 3,
    steps: int | None = None,
    images: int = 500,
    alone: bool = False,
    progress: NotedProgress = silent,
) -> dict[str, Any]:
    """Train what is missing in the folder `runs`, then evaluate every network on the first `images` of `data`.

    Trainings are RUNS/VARIANT-SEED, carry on where they were cut, and share the recipe of those that are there, or else
    the preset's. Scores are kept in each run's cached_results.json. alone: sweep noise and missing data by themselves,
    too.

    Raises BadConfig for more than one folder, wrong numbers, or trainings that differ in more than variant and seed;
    otherwise as training and evaluating do.
    """
    if len(runs) != 1:
        raise BadConfig(f"bench variants keeps its trainings in one folder, found {len(runs)} with --runs")
    check_int("the number of test images", images, 1)
    trainings = runs_in(runs[0], seeds)
    plan = common_plan(trainings, data, steps)
    sweeps = SWEEPS | (SWEEPS_ALONE if alone else {})
    swept = (condition for sweep in sweeps.values() for condition in sweep.conditions)
    conditions = list(dict.fromkeys([*TABLE.values(), *swept]))
    evaluator = Evaluator(data, images)
    test_images = min(images, len(evaluator.images(conditions[0])))
    work = _Progress(trainings, plan, test_images * len(conditions), progress)
    start = time.perf_counter()
    device = find_device()
    for run in work.missing:
        train(run, plan, data, ProcessGroup(0, 1, device), work.report(run))
        work.trained(run)
    found: dict[tuple[Run, Condition], Tree] = {}
    networks = {run: load_network(run.path) for run in trainings}
    for condition in conditions:  # the outer loop, so that every set of test images is opened once
        for run, trained in networks.items():
            network = trained.network.to(device)
            extras = run.variant == "all" and condition == TABLE["all"]
            found[run, condition] = evaluator.scores(run.path, network, condition, extras)
            work.evaluated(run, condition, test_images)

    def scores_of(variant: VariantName, condition: Condition) -> list[Tree]:
        return [found[run, condition] for run in trainings if run.variant == variant]

    manifest = evaluator.images(conditions[0]).manifest
    return {
        "scale": {
            "steps": plan.recipe.steps,
            "images_a_step": _images_a_step(plan),
            "train_images": manifest.samples("train"),
            "test_images": test_images,
            "test_images_of": manifest.samples("test"),
            "image": [manifest.rig.camera.rows, manifest.rig.camera.columns],
            "seeds": seeds,
        },
        "network": NETWORK,
        "parameters": parameters(build(NETWORK, plan.settings)),
        "settings": plan.settings,
        "recipe": plan.recipe.to_json(),
        "data": {"source": manifest.source, "renderer": manifest.renderer, "train": plan.data["set"]},
        "device": str(device),
        "threads": torch.get_num_threads(),
        "seconds": round(time.perf_counter() - start, 1),
        "table": {
            variant: {test: over_seeds(accuracies(scores_of, variant, condition)) for test, condition in TABLE.items()}
            for variant in VARIANTS
        },
        "subsets": _subsets(scores_of),
        "sweeps": {name: _curves(scores_of, sweep) for name, sweep in sweeps.items()},
        "claims": claims(scores_of, alone),
        "networks": [origin(run.path) for run in trainings],
    }


def _images_a_step(plan: Plan) -> int:
    return plan.recipe.batch_size * plan.recipe.accumulate


def _curves(scores_of: ScoresOf, sweep: Sweep) -> Tree:
    others = list(VARIANTS[sweep.conditions[0].variant])
    curves = {}
    for variant in VARIANTS:
        points = [over_seeds(accuracies(scores_of, variant, condition)) for condition in sweep.conditions]
        seeds = [list(values) for values in zip(*(point["seeds"] for point in points), strict=True)]
        curves[variant] = {name: [point[name] for point in points] for name in ("mean", "sd")} | {"seeds": seeds}
    return {
        "title": sweep.title,
        "artifacts_of_the_test_images": others,
        "strengths": list(sweep.strengths),
        "curves": curves,
    }


def _subsets(scores_of: ScoresOf) -> Tree:
    """Accuracy on each subset of the test images of `all`, by training variant (Fig. 6); null for one too small."""
    found: Tree = {}
    for variant in VARIANTS:
        rows = [each["subsets"] for each in scores_of(variant, TABLE["all"])]
        values = {name: [row[name]["average_per_class_accuracy"] for row in rows] for name in rows[0]}
        found[variant] = {name: None if None in each else over_seeds(each) for name, each in values.items()}
    return found


@dataclass
class _Progress:
    """Progress of the whole bench, counted in images that networks have processed."""

    trainings: list[Run]
    plan: Plan
    images_a_network: int
    progress: NotedProgress
    done: int = 0

    def __post_init__(self) -> None:
        self.missing = [run for run in self.trainings if not run.finished]
        self._total = len(self.missing) * self._of_training(self.plan.recipe.steps)
        self._total += len(self.trainings) * self.images_a_network

    def _of_training(self, steps: int) -> int:
        return _PASSES * _images_a_step(self.plan) * steps

    def report(self, run: Run) -> Callable[[Metrics], None]:
        def show(figures: Metrics) -> None:
            note = f"training {run.name}, step {figures.step} of {self.plan.recipe.steps}, per class "
            self.progress(self.done + self._of_training(figures.step), self._total, f"{note}{figures.accuracy:.1%}")

        return show

    def trained(self, run: Run) -> None:
        self._add(self._of_training(self.plan.recipe.steps), f"trained {run.name}")

    def evaluated(self, run: Run, condition: Condition, images: int) -> None:
        self._add(images, f"{run.name} on {condition.name}")

    def _add(self, images: int, note: str) -> None:
        self.done += images
        self.progress(self.done, self._total, note)
