"""The trainings that `bench architectures` compares: several seeds each of several networks, trained alike."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from benches.model.networks.baselines import with_baselines
from bodyseg_data.core import BadConfig
from bodyseg_model.networks import SHIPPED, Network, Trained, load_network

SHARED: Final = ("steps", "batch_size", "accumulate")
"""Fields of a recipe that all networks share; the others may be tuned to a network."""

_NAME: Final = re.compile(r"(.+)-(\d+)")

Tree = dict[str, Any]


@dataclass(frozen=True)
class Run:
    """One training: the folder NAME-SEED, and what is in it."""

    path: Path
    name: str
    seed: int
    trained: Trained

    @property
    def network(self) -> Network:
        """The network, in evaluation mode."""
        return self.trained.network

    @property
    def family(self) -> str:
        """Its name in `NETWORKS`."""
        return str(self.trained.card["network"])

    @property
    def recipe(self) -> Tree:
        """The recipe on its card."""
        return dict(self.trained.card["recipe"])


def groups_in(folders: Sequence[Path]) -> dict[str, list[Run]]:
    """The trainings NAME-SEED in the folders: name -> one run a seed. Whatever else lies there is passed over.

    Raises BadConfig if there is none, one is unfinished or there twice, or two were not trained alike: networks must
    share variant `all`, images (but the seed), steps and batch; the seeds of a name share everything.
    """
    groups: dict[str, list[Run]] = {}
    with with_baselines():
        for folder in folders:
            if not folder.is_dir():
                raise BadConfig(f"--runs must be folders of trainings, found {folder}")
            for path in sorted(folder.iterdir()):
                if path.is_dir() and (named := _NAME.fullmatch(path.name)):
                    run = Run(path, named[1], int(named[2]), load_network(path))
                    groups.setdefault(run.name, []).append(run)
    if not groups:
        raise BadConfig(f"no training NAME-SEED in {', '.join(map(str, folders)) or 'no folder'}")
    first = next(iter(groups.values()))[0]
    for group in groups.values():
        group.sort(key=lambda run: run.seed)
        for run in group:
            _check_alike(run, first, _training_of)
            _check_alike(run, group[0], _everything_of)
        seeds = [run.seed for run in group]
        if len(set(seeds)) < len(seeds):
            raise BadConfig(f"every training must be there once, found seeds {seeds} of {group[0].name}")
    return dict(sorted(groups.items()))


def _training_of(run: Run) -> Tree:
    """Facts of a training that all networks must share."""
    card = run.trained.card
    data, recipe = card.get("data"), card.get("recipe")
    if card.get("variant") != "all" or not isinstance(data, dict) or not isinstance(recipe, dict):
        raise BadConfig(f"networks to compare are trained on all, found {card.get('variant')!r}: {run.path}")
    shared = {f"{name} of the images": value for name, value in data.items() if name != "seed"}
    return shared | {name: recipe.get(name) for name in SHARED}


def _everything_of(run: Run) -> Tree:
    """Facts of a training that the seeds of one name must share."""
    return {"network": run.family, "settings": run.network.settings, "recipe": run.recipe}


def _check_alike(run: Run, other: Run, facts: Callable[[Run], Tree]) -> None:
    ours, theirs = facts(run), facts(other)
    for name in sorted(ours.keys() | theirs.keys()):
        if ours.get(name) != theirs.get(name):
            raise BadConfig(
                f"networks to compare are trained alike: {name} is {ours.get(name)!r} in {run.path} and "
                f"{theirs.get(name)!r} in {other.path}"
            )


def is_shipped(run: Run) -> bool:
    """True if a network has the kind and settings of the one that ships, whatever its weights."""
    if not SHIPPED.exists():
        return False
    shipped = load_network(SHIPPED)
    return (run.family, run.network.settings) == (shipped.card["network"], shipped.network.settings)
