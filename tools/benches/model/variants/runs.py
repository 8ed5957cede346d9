"""The trainings that `bench variants` compares: one for each variant and seed, alike in everything else.

Trainings of one seed share first weights, order of the images, mirrors and the artifacts' draws, whatever their
variant. So two of them differ by the artifacts alone. Beside them may stand trainings with other artifacts, and, in
further folders, of another rig or recipe.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from benches.model.chosen import recipe_from_json
from bodyseg_data.artifacts import VARIANTS, SensorModel, VariantName, sensor_model_from_json
from bodyseg_data.commands import provenance
from bodyseg_data.core import BadConfig
from bodyseg_data.files import last_name, read_json
from bodyseg_data.loading import RangeImages
from bodyseg_model.networks import build
from bodyseg_model.training import Recipe, Report, RunFolder, RunOptions, Training, recipe_for
from bodyseg_model.training.distributed import ProcessGroup

NETWORK: Final = "compact"
"""That is trained where no training is there to say which."""
RUN_OPTIONS: Final = RunOptions()


@dataclass(frozen=True)
class Run:
    """One training and its folder.

    variant: of the five; None for another, whose artifacts its card names. row: in the tables, by default the variant.
    elsewhere: it lies in a further folder, and may be of another rig or recipe.
    """

    variant: VariantName | None
    seed: int
    path: Path
    row: str = ""
    elsewhere: bool = False

    @property
    def name(self) -> str:
        """NAME-SEED, which is also the folder's name."""
        return self.path.name

    @property
    def sensors(self) -> tuple[SensorModel, ...]:
        """The artifacts that a finished training was given, by its card: of a mixture, each of its parts. Raises
        BadConfig.
        """
        made = (part.get("artifacts", []) for part in _parts(read_json(self.path / "network.json")))
        named = ({"name": self.path.name, "artifacts": artifacts} for artifacts in made)
        return tuple(sensor_model_from_json(each, str(self.path)) for each in named)

    @property
    def finished(self) -> bool:
        """True if its network is there: the card is written last."""
        return RunFolder(self.path).network.with_suffix(".json").exists()

    def plan(self) -> dict[str, Any] | None:
        """The card, or the plan of an unfinished training; None if there is neither. Raises BadConfig if damaged."""
        for name in ("network.json", "run.json"):
            if (self.path / name).exists():
                return read_json(self.path / name)
        return None


@dataclass(frozen=True)
class Plan:
    """Facts that all trainings share. network, settings: which network. data: identity of the images, but variant and
    seed.
    """

    network: str
    recipe: Recipe
    settings: dict[str, Any]
    data: dict[str, Any]

    def of(self, run: Run) -> dict[str, Any]:
        """Facts that the card in the folder of `run` must have; of others than the variants, artifacts may differ."""
        facts = {"network": self.network, "settings": self.settings, "recipe": self.recipe.to_json(), "seed": run.seed}
        if run.variant is None:
            return {**facts, "set": self.data["set"]}
        return {**facts, "variant": run.variant, "data": {**self.data, "variant": run.variant, "seed": run.seed}}


def runs_in(folder: Path, seeds: int) -> list[Run]:
    """The trainings of every variant with seeds 0, 1 ..., all variants of a seed together. Raises BadConfig."""
    return [Run(variant, seed, folder / f"{variant}-{seed}", variant) for seed in range(seeds) for variant in VARIANTS]


def other_runs(folders: Sequence[Path], seeds: int) -> list[Run]:
    """Finished trainings NAME-SEED of other names in the first folder, in rows NAME; all of the further folders, in
    rows FOLDER/NAME.
    """
    found = []
    for number, folder in enumerate(folders):
        for path in sorted(folder.glob("*-*")):
            name, _, seed = path.name.rpartition("-")
            if not seed.isdecimal() or int(seed) >= seeds or (number == 0 and name in VARIANTS):
                continue
            run = Run(None, int(seed), path, f"{folder.name}/{name}" if number else name, bool(number))
            found += [run] if run.finished else []
    return found


def common_plan(runs: list[Run], data: str, steps: int | None) -> Plan:
    """The plan of the trainings that are there, to be that of the others too; the preset recipe if there is none.

    Raises BadConfig, naming the folder, if one is of other data, of another network, recipe or number of steps.
    """
    there = [(run, plan) for run in runs if (plan := run.plan()) is not None]
    identity = RangeImages(data, "none", "train").identity()
    if there:
        run, first = there[0]
        try:
            recipe = recipe_from_json(first["recipe"])
            shared = Plan(str(first["network"]), recipe, dict(first["settings"]), identity)
        except (KeyError, TypeError, ValueError) as error:
            raise BadConfig(f"{run.path} must name recipe and settings of a training: {error!r}") from error
        if steps is not None and shared.recipe.steps != steps:
            raise BadConfig(f"{run.path} is a training of {shared.recipe.steps} steps, --steps asks for {steps}")
    else:
        shared = Plan(NETWORK, recipe_for(NETWORK, steps=steps), build(NETWORK).settings, identity)
    for run, plan in there:
        found = {**plan, "set": " and ".join(sorted({str(part.get("set")) for part in _parts(plan)}))}
        for name, wanted in shared.of(run).items():
            if found.get(name) != wanted:
                raise BadConfig(
                    f"trainings to compare differ in variant and seed alone: {name} of {run.path} is "
                    f"{found.get(name)!r}, expected {wanted!r}"
                )
    return shared


def _parts(card: dict[str, Any]) -> list[dict[str, Any]]:
    """Identities of the images that a card or plan names, more than one of a mixture."""
    data = card.get("data") or {}
    return list(data.get("mixture", [data]))


def origin(folder: Path) -> dict[str, Any]:
    """Name of a training's folder, and the command, commit and hardware on its card."""
    card = read_json(folder / "network.json")
    return {"name": folder.name, **{name: card.get(name) for name in ("command", "commit", "hardware")}}


def train(run: Run, plan: Plan, data: str, processes: ProcessGroup, report: Report) -> None:
    """Train to the end, from the folder's last checkpoint if there is one, as `bodyseg train` would.

    Raises what `Training.run` raises.
    """
    network = build(plan.network, plan.settings, run.seed)
    images = RangeImages(data, run.variant or "all", "train", run.seed)
    training = Training(
        network, plan.network, images, plan.recipe, RunFolder(run.path), processes, run.seed, RUN_OPTIONS
    )
    command = f"tools/bench variants --data {last_name(data)} --runs {run.path.parent.name}"
    training.run(True, report, provenance(command))
