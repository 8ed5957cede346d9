"""Trained networks, and which of them differ by their seed alone."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from bodyseg_data.core.errors import BadConfig
from bodyseg_model.networks.checkpoints import Trained, load_network

FEWEST_SEEDS: Final = 3
"""Fewer say nothing about spread."""

_ALIKE: Final = ("network", "settings", "variant", "recipe")


@dataclass(frozen=True)
class Run:
    """A trained network. name: unique among those given."""

    name: str
    path: Path
    trained: Trained

    @property
    def seed(self) -> Any:
        """Of its training, as its card has it; None for a card that says nothing."""
        return self.trained.card.get("seed")


@dataclass(frozen=True)
class Group:
    """Networks that differ by their seed alone, in the order given. label: unique among groups."""

    label: str
    runs: tuple[Run, ...]

    @property
    def few_seeds(self) -> bool:
        """Whether there are too few seeds to speak of spread."""
        return len({run.seed for run in self.runs}) < FEWEST_SEEDS

    def to_json(self) -> dict[str, Any]:
        """What its networks share, and their names and seeds."""
        card = self.runs[0].trained.card
        return {
            **{name: card.get(name) for name in ("network", "settings", "variant")},
            "runs": [run.name for run in self.runs],
            "seeds": [run.seed for run in self.runs],
            "few_seeds": self.few_seeds,
        }


def load_runs(paths: Sequence[Path]) -> list[Run]:
    """The networks of runs' folders or .safetensors files, each once; raises BadConfig as `load_network`.

    A name is the folder's, with as many folders above it as it takes to tell it from the others.
    """
    places = {path.resolve(): path for path in paths}
    parts = {place: place.with_suffix("").parts for place in places}
    names = {}
    for place in places:
        deep = 1
        while deep < len(parts[place]) and sum(parts[place][-deep:] == other[-deep:] for other in parts.values()) > 1:
            deep += 1
        names[place] = "/".join(parts[place][-deep:])
    return [Run(names[place], path, load_network(path)) for place, path in places.items()]


def group(runs: Sequence[Run]) -> list[Group]:
    """Runs of one network, settings, variant, recipe and data together, in the order of their first."""
    alike: dict[str, list[Run]] = {}
    for run in runs:
        alike.setdefault(_identity(run.trained.card), []).append(run)
    labels = _labels([members[0] for members in alike.values()])
    return [Group(label, tuple(members)) for label, members in zip(labels, alike.values(), strict=True)]


def group_of(groups: Sequence[Group], paths: Sequence[Path]) -> Group | None:
    """The one group that `paths` are in; None for no paths. Raises BadConfig if they are in several."""
    places = {path.resolve() for path in paths}
    found = [each for each in groups if places & {run.path.resolve() for run in each.runs}]
    if len(found) > 1:
        raise BadConfig(
            "networks to compare with must differ by their seed alone, found "
            f"{', '.join(each.runs[0].name for each in found)}"
        )
    return found[0] if found else None


def _identity(card: dict[str, Any]) -> str:
    """All that shaped a network but its seed, as text."""
    data = card.get("data")
    if isinstance(data, dict):
        data = {name: value for name, value in data.items() if name != "seed"}
    return json.dumps([*(card.get(name) for name in _ALIKE), data], sort_keys=True)


def _labels(runs: Sequence[Run]) -> list[str]:
    """A name for the group of each run: the run's without its seed, or else with its network's, or else all of it."""
    short = [run.name.removesuffix(f"-{run.seed}") for run in runs]
    longer = [f"{name} ({run.trained.card['network']})" for name, run in zip(short, runs, strict=True)]
    for names in (short, longer):
        if max(Counter(names).values(), default=1) == 1:
            return names
    return [run.name for run in runs]
