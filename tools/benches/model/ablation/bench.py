"""`bench ablation`: the gain and cost of each modelled effect, and how many bodies and views suffice.

Trainings are RUNS/NAME-SEED, made by `bodyseg train`, each with one effect left out of, or added to, those of all-SEED.
docs/results/ablation.md says how to read the results.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import torch

from benches.model.ablation.conditions import (
    CONDITIONS,
    AblationCondition,
    clothes_conditions,
    coarse_conditions,
    hard_condition,
)
from benches.model.ablation.costs import byte_costs, costs_of, loader_costs, network_costs, rendering_costs
from benches.model.ablation.rows import BASE, ROWS, RULE, AblationRow, Tree, deviation_of, enough, table, verdict, worth
from benches.model.ablation.runs import NETWORK, Run, check_run, find_runs, identities, missing, plan_of, sets_of
from benches.model.variants.runs import origin
from benches.model.variants.scores import Evaluator
from bodyseg_data.core import BadConfig, NotedProgress, silent
from bodyseg_data.loading import RangeImages
from bodyseg_model.evaluation import over_seeds
from bodyseg_model.networks import Network, find_device, load_network

_ACCURACY: Final = "average_per_class_accuracy"
_MEASURES: Final = 4  # of costs, beside the conditions

Accuracies = dict[str, list[float]]
"""AblationCondition -> accuracy of each seed's network."""


def bench_ablation(
    data: str,
    runs: tuple[Path, ...],
    images: int = 200,
    hard: str | None = None,
    clothes: tuple[str, ...] | None = None,
    progress: NotedProgress = silent,
) -> dict[str, Any]:
    """Evaluate every training of `runs` on the same test images, and measure the cost of each effect.

    data: the set that was trained on. runs: folders of trainings, NAME-SEED. images: test images of each kind. hard: a
    set of hard poses to test on as well. clothes: two sets of the same views, of dressed bodies and of bare ones, for
    trainings on either. Trains nothing: "missing" names the command of every training that is not there.
    Scores are kept in each run's cached_results.json.

    Raises BadConfig without a base, for a training that differs from it in something else, or for other than two sets
    of `clothes`; otherwise as `evaluate`.
    """
    sets = sets_of(data, clothes)
    start = time.perf_counter()
    chosen = [row for row in ROWS if row.source in sets]
    found = find_runs(runs, chosen)
    plan = plan_of(found[0])
    trained_on = identities(sets, [run.row for run in found])
    for run in found:
        check_run(run, plan, trained_on[run.row.name])
    conditions = _conditions(data, hard, clothes)
    coarse = [(row, condition) for row in chosen if row.step_mm for condition in coarse_conditions(row.step_mm)]
    base = [run for run in found if run.row.name == BASE]
    jobs = [(run.row, condition, run) for condition in conditions for run in found]
    jobs += [(row, condition, run) for row, condition in coarse for run in base]
    accuracies = _evaluated(data, images, jobs, progress)
    costs = _measured(data, plan.settings, progress, len(jobs))
    first = RangeImages(data, BASE, "train")
    rows = _rows(accuracies, costs, {name: each["amount"] for name, each in trained_on.items()}, first)
    figures = {
        "scale": {
            "steps": plan.recipe.steps,
            "images_a_step": plan.recipe.batch_size * plan.recipe.accumulate,
            **{f"train_{name}": count for name, count in trained_on[BASE]["amount"].items()},
            "test_images": images,
            "seeds": len(base),
        },
        "network": NETWORK,
        "settings": plan.settings,
        "recipe": plan.recipe.to_json(),
        "data": {"source": first.manifest.source, "train": trained_on[BASE]["data"]["set"]},
        "rule": RULE,
        "conditions": [{"name": condition.label, "title": condition.title} for condition in conditions],
        "base": {name: over_seeds(values) for name, values in accuracies[BASE].items()},
        "rows": rows,
        "enough": {prefix: enough(rows, f"{prefix}_") for prefix in ("bodies", "views")},
        "costs": costs,
        "missing": missing(found, chosen, plan, sets, runs),
        "networks": [origin(run.path) for run in found],
        "threads": torch.get_num_threads(),
        "seconds": round(time.perf_counter() - start, 1),
    }
    return {**figures, "table": table(figures)}


def _conditions(data: str, hard: str | None, clothes: tuple[str, ...] | None) -> list[AblationCondition]:
    """The conditions for which the sets have images."""
    conditions = [
        *CONDITIONS,
        *([hard_condition(hard)] if hard is not None else []),
        *(clothes_conditions(*clothes) if clothes else ()),
    ]
    found = []
    for condition in conditions:
        try:
            condition.open(data)
        except BadConfig:
            if not condition.only:
                raise
            continue  # a set of other bodies or views
        found.append(condition)
    return found


def _evaluated(
    data: str, images: int, jobs: Sequence[tuple[AblationRow, AblationCondition, Run]], progress: NotedProgress
) -> dict[str, Accuracies]:
    """Row -> condition -> accuracy of each seed."""
    evaluator, device = Evaluator(data, images), find_device()
    networks: dict[Path, Network] = {}
    accuracies: dict[str, Accuracies] = {}
    for done, (row, condition, run) in enumerate(jobs, start=1):
        if run.path not in networks:
            networks[run.path] = load_network(run.path).network.to(device)
        found = evaluator.scores(run.path, networks[run.path], condition, extras=False)
        accuracies.setdefault(row.name, {}).setdefault(condition.label, []).append(found[_ACCURACY])
        progress(done, len(jobs) + _MEASURES, f"{run.path.name} on {condition.label}")
    return accuracies


def _measured(data: str, settings: dict[str, Any], progress: NotedProgress, done: int) -> Tree:
    measures: dict[str, Callable[[], Tree | None]] = {
        "loader": lambda: loader_costs(data),
        "bytes": lambda: byte_costs(data),
        "network": lambda: network_costs(data, settings),
        "rendering": lambda: rendering_costs(RangeImages(data, BASE, "train").manifest.rig),
    }
    costs: Tree = {}
    for number, (name, measure) in enumerate(measures.items(), start=1):
        costs[name] = measure()
        progress(done + number, done + _MEASURES, f"cost: {name}")
    return costs


def _rows(
    accuracies: Mapping[str, Accuracies], costs: Tree, amounts: Mapping[str, Tree], images: RangeImages
) -> list[Tree]:
    spread = deviation_of(accuracies[BASE])
    bytes_a_sample = images.stored_bytes() / len(images)
    rows = []
    for row in ROWS:
        if row.name not in accuracies:
            continue
        against = row.against if row.against in accuracies else BASE
        have, lack = accuracies[against], accuracies[row.name]
        if row.added:
            have, lack = lack, have
        value = worth(have, lack, None if row.step_mm else spread)
        amount = amounts.get(row.name, amounts[BASE])
        rows.append(
            {
                "name": row.name,
                "what": row.what,
                "group": row.group,
                "added": row.added,
                "against": against,
                **amount,
                "accuracy": {name: over_seeds(values) for name, values in accuracies[row.name].items()},
                "worth": value,
                "helps": list(row.helps),
                **verdict(value, row.helps, decided=spread is not None or row.step_mm is not None),
                "cost": costs_of(row, costs, amount["samples"], amounts[against]["samples"], bytes_a_sample),
            }
        )
    return rows
