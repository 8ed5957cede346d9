"""A step of `tools/bench all`: one command, the product that it makes, and the products that it reads."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from benches.bench import BENCHES
from bodyseg_data.core import BadConfig
from bodyseg_model.commands.cli import COMMANDS

Kind = Literal["set", "training", "results", "page"]

RESULTS: Final = "docs/results"
DATA: Final = "data"
TOOLS: Final = "tools"
SHIPPED: Final = "shipped"
FINDER: Final = "finder"
LARGE: Final = "large"
PLACES: Final = "places"
NETWORKS: Final = (SHIPPED, FINDER, LARGE, PLACES)
"""Names of the networks that ship, where a step reads them."""


@dataclass(frozen=True)
class Places:
    """Folders of a run. work: sets, trainings, logs. data: external data. results: docs/results of a checkout."""

    work: Path
    data: Path
    results: Path

    def path(self, word: str) -> Path:
        """The file or folder that a word of a command names: DATA/..., docs/results/..., tools/..., else in the work
        folder.
        """
        top, _, rest = word.partition("/")
        if top == DATA:
            return self.data / rest
        if top == TOOLS:
            return Path(__file__).parents[2] / rest
        if word == RESULTS or word.startswith(f"{RESULTS}/"):
            return self.results / word[len(RESULTS) + 1 :]
        return self.work / word


@dataclass(frozen=True)
class Step:
    """One command, run in the work folder.

    name: of a set or training, its folder in the work folder. words: the command; `bodyseg`, `tools/bench` and
    `tools/chart` stand for the checkout's, and names of files are as `Places.path` reads them. results: (file or
    folder that the command writes, its name in docs/results). links: (folder of a run, the training that it is another
    name of), made before the command runs. reads: further products that no word names, such as `SHIPPED`. alone: no
    other step may run beside it, because it takes times. gpu: needs one. processor: the only one that it may run on, as
    `folder_name` names it; "" for any. modules: that compute the product; those of the command unless given.
    """

    name: str
    kind: Kind
    words: tuple[str, ...]
    results: tuple[tuple[str, str], ...] = ()
    links: tuple[tuple[str, str], ...] = ()
    reads: tuple[str, ...] = ()
    alone: bool = False
    gpu: bool = False
    processor: str = ""
    modules: tuple[str, ...] = ()

    @property
    def command(self) -> str:
        """The command as text."""
        return " ".join(self.words)

    @property
    def code(self) -> tuple[str, ...]:
        """Full names of the modules whose code, with all that they import, computes the product.

        Modules that draw are left out: a new colour is no reason to measure for hours.
        """
        if self.modules:
            return self.modules
        program, name = self.words[:2]
        if program == "bodyseg":
            return (COMMANDS[name][0].partition(":")[0],)
        if program == "tools/bench":
            return (f"benches.{BENCHES[name].module}",)
        drawn = {"tools/chart": "benches.results.chart", "tools/landmarks": "benches.landmarks.command"}
        return (drawn[program],) if program in drawn else ()


class Graph:
    """Steps in an order in which they can run, and the products that each one reads.

    Raises BadConfig if two steps have one name or make one product, or one reads the product of a later step.
    """

    def __init__(self, steps: Sequence[Step]) -> None:
        self.steps = {step.name: step for step in steps}
        if len(self.steps) < len(steps):
            name, count = Counter(step.name for step in steps).most_common(1)[0]
            raise BadConfig(f"steps need different names, found {name} {count} times")
        makers: dict[str, str] = {}
        self._inputs: dict[str, tuple[str, ...]] = {}
        self._external: dict[str, tuple[str, ...]] = {}
        for step in steps:
            read = dict.fromkeys(name for word in _read_by(step) for name in _makers_of(word, makers))
            self._inputs[step.name] = tuple(read)
            unmade = dict.fromkeys(word for word in _read_by(step) if word not in makers)
            self._external[step.name] = tuple(
                word for word in unmade if word.startswith((f"{DATA}/", f"{RESULTS}/", f"{TOOLS}/")) or word in NETWORKS
            )
            for product in _products(step):
                if product in makers:
                    raise BadConfig(f"{product} is made by two steps, {makers[product]} and {step.name}")
                makers[product] = step.name
        for step in steps:
            later = {name for word in _read_by(step) for name in _makers_of(word, makers)} - {step.name}
            if later - {*self._inputs[step.name]}:
                raise BadConfig(f"{step.name} must stand behind {', '.join(sorted(later))}, whose products it reads")

    def inputs(self, step: Step) -> tuple[str, ...]:
        """Names of the steps whose products a step reads."""
        return self._inputs[step.name]

    def external(self, step: Step) -> tuple[str, ...]:
        """Files that it reads and no step makes: of `NETWORKS`, DATA/..., docs/results/... or tools/..."""
        return self._external[step.name]

    def with_inputs(self, names: Iterable[str]) -> set[str]:
        """The steps of these names, and all steps whose products they read, directly or not."""
        found: set[str] = set()
        waiting = list(names)
        while waiting:
            name = waiting.pop()
            if name not in found:
                found.add(name)
                waiting += self._inputs[name]
        return found


def _read_by(step: Step) -> Iterator[str]:
    """Words that may name a product that a step reads, its own left out."""
    own = {step.name, *(source for source, _ in step.results), *(link for link, _ in step.links)}
    yield from (word for word in step.words[1:] if word not in own)
    yield from (target for _, target in step.links)
    yield from step.reads


def _products(step: Step) -> tuple[str, ...]:
    if step.kind in ("set", "training"):
        return (step.name,)
    return tuple(f"{RESULTS}/{name}" for _, name in step.results)


def _makers_of(word: str, makers: dict[str, str]) -> Iterator[str]:
    """Steps that make the product that a word names, or those within the folder that it names."""
    if word in makers:
        yield makers[word]
    elif word:
        yield from (maker for product, maker in makers.items() if product.startswith(f"{word}/"))
