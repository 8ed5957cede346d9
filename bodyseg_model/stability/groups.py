"""Groups of trained networks that differ by their seed alone."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.labels.label_map import PARTS33
from bodyseg_model.networks.checkpoints import Trained, load_network

FEWEST_SEEDS: Final = 3
"""With fewer seeds a standard deviation says little."""

_ALIKE: Final = ("network", "settings", "variant", "recipe")


@dataclass(frozen=True)
class Run:
    """A trained network. path: a run's folder or a .safetensors file. name: unique among those loaded together."""

    name: str
    path: Path
    trained: Trained = field(repr=False)

    @property
    def seed(self) -> Any:
        """Seed of the training, from the network's card; None if the card has none."""
        return self.trained.card.get("seed")


@dataclass(frozen=True)
class Group:
    """Networks that differ by their seed alone, in the order given. label: unique among groups."""

    label: str
    runs: tuple[Run, ...]

    @property
    def few_seeds(self) -> bool:
        """True for fewer seeds than `FEWEST_SEEDS`."""
        return len({run.seed for run in self.runs}) < FEWEST_SEEDS

    def to_json(self) -> dict[str, Any]:
        """Network, settings and variant that the runs share, and the runs' names and seeds."""
        card = self.runs[0].trained.card
        return {
            **{name: card.get(name) for name in ("network", "settings", "variant")},
            "runs": [run.name for run in self.runs],
            "seeds": [run.seed for run in self.runs],
            "few_seeds": self.few_seeds,
        }


def load_runs(paths: Sequence[Path]) -> list[Run]:
    """Load the networks of runs' folders or .safetensors files, each once; raises BadConfig as `load_network`,
    and for a network of other classes than the 33 parts.

    A run is named after its folder, with as many parent folders as are needed to tell it from the others.
    """
    given = {path.resolve(): path for path in paths}
    every = [full.with_suffix("").parts for full in given]
    runs = []
    for parts, path in zip(every, given.values(), strict=True):
        depth = 1
        while depth < len(parts) and sum(parts[-depth:] == other[-depth:] for other in every) > 1:
            depth += 1
        trained = load_network(path)
        if trained.label_map != PARTS33:
            raise BadConfig(
                f"{path}: stability is measured on the 33 parts, which a network with labels "
                f"{trained.label_map.name!r} does not predict"
            )
        runs.append(Run("/".join(parts[-depth:]), path, trained))
    return runs


def group(runs: Sequence[Run]) -> list[Group]:
    """Group runs of one network, settings, variant, recipe and data; groups are in the order of their first runs."""
    alike: dict[str, list[Run]] = {}
    for run in runs:
        alike.setdefault(_identity(run.trained.card), []).append(run)
    labels = _labels([members[0] for members in alike.values()])
    return [Group(label, tuple(members)) for label, members in zip(labels, alike.values(), strict=True)]


def group_of(groups: Sequence[Group], paths: Sequence[Path]) -> Group | None:
    """Find the one group that contains `paths`; None for no paths. Raises BadConfig if they are in several."""
    given = {path.resolve() for path in paths}
    found = [each for each in groups if given & {run.path.resolve() for run in each.runs}]
    if len(found) > 1:
        raise BadConfig(
            "networks to compare with must differ by their seed alone, found "
            f"{', '.join(each.runs[0].name for each in found)}"
        )
    return found[0] if found else None


def _identity(card: dict[str, Any]) -> str:
    """Everything on a card that identifies a training, except its seed, as JSON text."""
    data = card.get("data")
    if isinstance(data, dict):
        data = {name: value for name, value in data.items() if name != "seed"}
    return json.dumps([*(card.get(name) for name in _ALIKE), data], sort_keys=True)


def _labels(runs: Sequence[Run]) -> list[str]:
    """Unique labels of groups: the first run's name without "-SEED", or with its network added, or the full name."""
    short = [run.name.removesuffix(f"-{run.seed}") for run in runs]
    longer = [f"{name} ({run.trained.card['network']})" for name, run in zip(short, runs, strict=True)]
    for names in (short, longer):
        if max(Counter(names).values(), default=1) == 1:
            return names
    return [run.name for run in runs]
