"""The trainings that `bench ablation` compares: which are there, what each differs in, and which are missing."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from benches.model.ablation.rows import BASE, ROW_OF_BASE, ROWS, AblationRow, Source, Tree
from bodyseg_data.commands.options import place_name
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.loading.range_images import RangeImages
from bodyseg_model.networks.checkpoints import read_json
from bodyseg_model.networks.registry import build, settings_of
from bodyseg_model.training.geometric_augmentation import GeometricAugmentation
from bodyseg_model.training.recipes import PRESETS, Recipe

NETWORK: Final = "compact"


@dataclass(frozen=True)
class Run:
    """A finished training and its folder."""

    thing: AblationRow
    seed: int
    path: Path


@dataclass(frozen=True)
class Plan:
    """Recipe and network settings of the base."""

    recipe: Recipe
    settings: dict[str, Any]


def find_runs(folders: Sequence[Path], things: Sequence[AblationRow] = ROWS) -> list[Run]:
    """All finished trainings of `things`, those of the base first; of two of one name, that in the first folder.

    Raises BadConfig if there is none of the base.
    """
    found: dict[str, Run] = {}
    for thing in (ROW_OF_BASE, *things):
        paths = [path for folder in folders for path in sorted(folder.glob(f"{thing.name}-*"))]
        for path in paths:
            seed = path.name.removeprefix(f"{thing.name}-")
            if seed.isdecimal() and (path / "network.json").exists():
                found.setdefault(path.name, Run(thing, int(seed), path))
    runs = list(found.values())
    if not runs or runs[0].thing.name != BASE:
        where = ", ".join(map(str, folders)) or "nowhere"
        raise BadConfig(f"an ablation needs finished trainings {BASE}-SEED to compare with, found none in {where}")
    return runs


def plan_of(run: Run) -> Plan:
    """Recipe and settings on a run's card; what it is too old to name is as in the preset. Raises BadConfig."""
    card = read_json(run.path / "network.json")
    try:
        if card["network"] != NETWORK:
            raise BadConfig(f"{run.path} must be a training of {NETWORK}, found {card['network']!r}")
        preset = asdict(PRESETS[NETWORK])
        return Plan(Recipe.from_json(preset | card["recipe"]), settings_of(build(NETWORK, card["settings"])))
    except (KeyError, TypeError, ValueError) as error:
        raise BadConfig(f"{run.path} must name recipe and settings of a training: {error!r}") from error


def check_run(run: Run, plan: Plan, expected: Tree) -> None:
    """Raise BadConfig, naming what differs, unless a training differs from the base in its row's effect alone.

    plan: the base's. expected: "data": identity of the images trained on.
    """
    card = read_json(run.path / "network.json")
    ours = plan_of(run)
    wanted: dict[str, Any] = {
        "settings": settings_of(build(NETWORK, {**plan.settings, **run.thing.settings})),
        "recipe": asdict(plan.recipe),
        "variant": run.thing.variant,
        "data": expected["data"] | {"seed": run.seed},
    }
    found = {"settings": ours.settings, "recipe": asdict(ours.recipe), "variant": card.get("variant")}
    found["data"] = {name: value for name, value in dict(card.get("data") or {}).items() if name != "only"}
    for name, value in wanted.items():
        if found[name] != value:
            raise BadConfig(
                f"{run.path} must differ from the base in one thing ({run.thing.name}): its {name} is "
                f"{found[name]!r}, expected {value!r}"
            )


def sets_of(data: str, clothes: tuple[str, ...] | None) -> dict[Source, str]:
    """Source -> address of its set."""
    if clothes is None:
        return {"": data}
    if len(clothes) != 2:
        raise BadConfig(f"clothes are told by two sets, of dressed bodies and of bare ones, found {len(clothes)}")
    return {"": data, "dressed": clothes[0], "bare": clothes[1]}


def identities(sets: Mapping[Source, str], things: Sequence[AblationRow]) -> dict[str, Tree]:
    """Row -> identity of its training images, and how many they are, of how many bodies and views."""
    found = {}
    for thing in {thing.name: thing for thing in things}.values():
        path = sets[thing.source]
        images = RangeImages(path, thing.variant, "train", artifacts=thing.artifacts, only=thing.only)
        words = [key.rsplit("-", 2) for key in images.keys]
        found[thing.name] = {
            # Which samples they are is told by the set's digest, however the patterns are put.
            "data": {name: value for name, value in images.identity().items() if name != "only"},
            "amount": {
                "samples": len(images),
                "bodies": len({body for body, *_ in words}),
                "views": len({tuple(view) for _, *view in words}),
            },
        }
    return found


def missing(
    found: Sequence[Run], things: Sequence[AblationRow], plan: Plan, sets: Mapping[Source, str], folders: Sequence[Path]
) -> list[Tree]:
    """The missing trainings, and the commands that make them."""
    there = {run.thing.name for run in found}
    return [
        {"name": f"{thing.name}-0", "command": _command(thing, plan.recipe, sets[thing.source], folders[-1])}
        for thing in things
        if thing.name not in there and thing.arguments is not None
    ]


def _command(thing: AblationRow, recipe: Recipe, data: str, folder: Path) -> str:
    words = ["bodyseg", "train", "--data", place_name(data), "--out", f"{folder.name}/{thing.name}-0"]
    words += ["--steps", str(recipe.steps), "--batch-size", str(recipe.batch_size)]
    words += ["--no-geometric-augmentation"] if recipe.geometric_augmentation == GeometricAugmentation() else []
    return shlex.join([*words, *(thing.arguments or ())])


def origin(run: Run) -> Tree:
    card = read_json(run.path / "network.json")
    return {"name": run.path.name, **{name: card.get(name) for name in ("command", "commit", "hardware")}}
