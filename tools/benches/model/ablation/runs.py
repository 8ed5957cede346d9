"""The trainings that `bench ablation` compares: which are there, what each differs in, and which are missing."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from benches.model.ablation.rows import BASE, ROW_OF_BASE, ROWS, AblationRow, Source, Tree
from benches.model.chosen import recipe_from_json
from bodyseg_data.core import BadConfig
from bodyseg_data.files import last_name, read_json
from bodyseg_data.loading import RangeImages
from bodyseg_data.samples import split_key
from bodyseg_model.networks import build
from bodyseg_model.training import GeometricAugmentation, Recipe
from bodyseg_model.training.recipes import PRESETS

NETWORK: Final = "compact"


@dataclass(frozen=True)
class Run:
    """A finished training and its folder."""

    row: AblationRow
    seed: int
    path: Path


@dataclass(frozen=True)
class Plan:
    """Recipe and network settings of the base."""

    recipe: Recipe
    settings: dict[str, Any]


def find_runs(folders: Sequence[Path], rows: Sequence[AblationRow] = ROWS) -> list[Run]:
    """All finished trainings of `rows`, those of the base first; of two of one name, that in the first folder.

    Raises BadConfig if there is none of the base.
    """
    found: dict[str, Run] = {}
    for row in (ROW_OF_BASE, *rows):
        paths = [path for folder in folders for path in sorted(folder.glob(f"{row.name}-*"))]
        for path in paths:
            seed = path.name.removeprefix(f"{row.name}-")
            if seed.isdecimal() and (path / "network.json").exists():
                found.setdefault(path.name, Run(row, int(seed), path))
    runs = list(found.values())
    if not runs or runs[0].row.name != BASE:
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
        return Plan(recipe_from_json(preset | card["recipe"]), build(NETWORK, card["settings"]).settings)
    except (KeyError, TypeError, ValueError) as error:
        raise BadConfig(f"{run.path} must name recipe and settings of a training: {error!r}") from error


def check_run(run: Run, plan: Plan, expected: Tree) -> None:
    """Raise BadConfig, naming what differs, unless a training differs from the base in its row's effect alone.

    plan: the base's. expected: "data": identity of the images trained on.
    """
    card = read_json(run.path / "network.json")
    ours = plan_of(run)
    wanted: dict[str, Any] = {
        "settings": build(NETWORK, {**plan.settings, **run.row.settings}).settings,
        "recipe": asdict(plan.recipe),
        "variant": run.row.variant,
        "data": expected["data"] | {"seed": run.seed},
    }
    found = {"settings": ours.settings, "recipe": asdict(ours.recipe), "variant": card.get("variant")}
    found["data"] = {name: value for name, value in dict(card.get("data") or {}).items() if name != "only"}
    for name, value in wanted.items():
        if found[name] != value:
            raise BadConfig(
                f"{run.path} must differ from the base in one effect ({run.row.name}): its {name} is "
                f"{found[name]!r}, expected {value!r}"
            )


def sets_of(data: str, clothes: tuple[str, ...] | None) -> dict[Source, str]:
    """Source -> address of its set."""
    if clothes is None:
        return {"": data}
    if len(clothes) != 2:
        raise BadConfig(f"--clothes takes two sets, of dressed bodies and of bare ones, found {len(clothes)}")
    return {"": data, "dressed": clothes[0], "bare": clothes[1]}


def identities(sets: Mapping[Source, str], rows: Sequence[AblationRow]) -> dict[str, Tree]:
    """Row -> identity of its training images, and how many they are, of how many bodies and views."""
    found = {}
    for row in {row.name: row for row in rows}.values():
        path = sets[row.source]
        images = RangeImages(path, row.variant, "train", sensor=row.sensor, only=row.only)
        pairs = [split_key(key) for key in images.keys]
        found[row.name] = {
            # The set's digest identifies its samples, whatever patterns chose them.
            "data": {name: value for name, value in images.identity().items() if name != "only"},
            "amount": {
                "samples": len(images),
                "bodies": len({body for body, _ in pairs}),
                "views": len({view for _, view in pairs}),
            },
        }
    return found


def missing(
    found: Sequence[Run], rows: Sequence[AblationRow], plan: Plan, sets: Mapping[Source, str], folders: Sequence[Path]
) -> list[Tree]:
    """The missing trainings, and the commands that make them."""
    there = {run.row.name for run in found}
    return [
        {"name": f"{row.name}-0", "command": _command(row, plan.recipe, sets[row.source], folders[-1])}
        for row in rows
        if row.name not in there and row.arguments is not None
    ]


def _command(row: AblationRow, recipe: Recipe, data: str, folder: Path) -> str:
    words = ["bodyseg", "train", "--data", last_name(data), "--out", f"{folder.name}/{row.name}-0"]
    words += ["--steps", str(recipe.steps), "--batch-size", str(recipe.batch_size)]
    words += ["--no-geometric-augmentation"] if recipe.geometric_augmentation == GeometricAugmentation() else []
    return shlex.join([*words, *(row.arguments or ())])
