"""The state of every step: fresh, stale, absent or blocked, and why."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal

from benches.charts.processors import folder_name
from benches.result_cache import code_digest, json_digest
from benches.results.products import Products
from benches.results.records import Record, Records, record_of
from benches.results.step import NETWORKS, Graph, Places, Step
from bodyseg_data.core import BadConfig
from bodyseg_data.machine import hardware

State = Literal["fresh", "stale", "absent", "blocked"]
"""absent: made as it would be made today, but not in this work folder; needed only where a stale step reads it."""


@dataclass(frozen=True)
class Status:
    """The state of a step.

    reason: why it is not fresh. inputs: digests of what it reads today; None if some of that is yet to be made, so that
    the step cannot run now. seconds: the last run took. blocked: it could not be made if it were needed.
    """

    state: State
    reason: str = ""
    inputs: dict[str, str] | None = None
    seconds: float | None = None
    blocked: bool = False


@cache
def _code_of(modules: tuple[str, ...]) -> str:
    return code_digest(*modules)


def _has_gpu() -> bool:
    import torch

    return torch.cuda.is_available()


class Survey:
    """Compares the records of steps with commands, code and files of today.

    code: digest of modules, by their full names.
    """

    def __init__(
        self,
        graph: Graph,
        places: Places,
        records: Records,
        code: Callable[[tuple[str, ...]], str] = _code_of,
    ) -> None:
        self._graph, self._records, self._code = graph, records, code
        self._places = places
        self.products = Products(places)

    def statuses(self) -> dict[str, Status]:
        """The status of every step, by name. Raises BadConfig for a product or a record that cannot be read."""
        found: dict[str, Status] = {}
        for step in self._graph.steps.values():
            found[step.name] = self._status(step, found)
        return found

    def code(self, step: Step) -> str:
        """Digest of the code that computes a step's product."""
        return self._code(step.code)

    def key(self, step: Step, inputs: dict[str, str]) -> str:
        """Digest of all that a step's product follows from."""
        return json_digest([step.command, self.code(step), inputs])

    def _status(self, step: Step, earlier: dict[str, Status]) -> Status:
        record = self._records.get(step)
        inputs, waiting = self._inputs(step, earlier, record)
        seconds = None if record is None else record.seconds
        changed = self._changed(step, record, inputs)
        if not changed and waiting:
            changed = f"after {waiting[0]}"
        if not changed:
            made = self.products.made_by(step)
            if record is not None and made == record.made:
                return Status("fresh", "", inputs, seconds)
            if made is not None or step.kind not in ("set", "training"):
                changed = "the product is not the one that was made" if made is not None else "the product is missing"
        hindrance = self._hindrance(step, earlier)
        missing = [name for name in self._graph.inputs(step) if earlier[name].state != "fresh"]
        ready = None if hindrance or (missing and step.kind != "page") else inputs
        if not changed:
            return Status("absent", "not in the work folder", ready, seconds, bool(hindrance))
        if hindrance:
            return Status("blocked", hindrance, None, seconds, True)
        return Status("stale", changed, ready, seconds)

    def _inputs(
        self, step: Step, earlier: dict[str, Status], record: Record | None
    ) -> tuple[dict[str, str], list[str]]:
        """Digests of what a step reads, as far as they are known; and the steps that are yet to make theirs anew."""
        found: dict[str, str] = {}
        waiting = []
        for name in self._graph.inputs(step):
            made = self._records.get(self._graph.steps[name])
            if earlier[name].state in ("fresh", "absent") or step.kind == "page":
                found |= {} if made is None else {name: json_digest(dict(made.made))}
            else:
                waiting.append(name)
        for name in self._graph.external(step):
            known = None if record is None else record.inputs.get(name)
            digest = self.products.external(name) or known
            found |= {} if digest is None else {name: digest}
        return found, waiting

    def _changed(self, step: Step, record: Record | None, inputs: dict[str, str]) -> str:
        """The first thing that has changed since the last run; "" if nothing has."""
        if record is None:
            return "never made"
        if record.code is None:
            return "made before records were kept"
        if record.command != step.command:
            return "the command has changed"
        if record.code != self.code(step):
            return "the code has changed"
        names = [name for name, digest in inputs.items() if record.inputs.get(name) != digest]
        return f"{names[0]} has changed" if names else ""

    def _hindrance(self, step: Step, earlier: dict[str, Status]) -> str:
        """The first thing without which a step cannot run; "" if there is all."""
        for name in self._graph.external(step):
            if self.products.external(name) is None:
                return f"{name if name in NETWORKS else self._places.path(name)} is not there"
        if step.gpu and not _has_gpu():
            return "needs a GPU"
        if step.processor and step.processor != folder_name(hardware()):
            return f"needs the processor {step.processor}"
        if step.kind == "page":
            return ""
        blocked = [name for name in self._graph.inputs(step) if earlier[name].blocked]
        return f"needs {blocked[0]}, which cannot be made" if blocked else ""


def accept(survey: Survey, graph: Graph, records: Records, names: Sequence[str], origin: dict[str, str]) -> None:
    """Record products that are there as made by the code, commands and inputs of today.

    names: of steps. origin: commit and hardware of records that have none yet. A set or a training that has a record
    but is not in this work folder is the one of its record. Raises BadConfig for a product that is not there, or one
    whose inputs have no record.
    """
    for step in graph.steps.values():
        if step.name not in names:
            continue
        made, before = survey.products.made_by(step), records.get(step)
        if made is None and before is not None and step.kind in ("set", "training"):
            made = dict(before.made)
        if made is None:
            raise BadConfig(f"cannot accept {step.name}, which is not there")
        inputs: dict[str, str] = {}
        for name in graph.inputs(step):
            read = records.get(graph.steps[name])
            if read is None:
                raise BadConfig(f"cannot accept {step.name}: {name}, which it reads, has no record; accept it first")
            inputs[name] = json_digest(dict(read.made))
        for name in graph.external(step):
            digest = survey.products.external(name)
            if digest is None:
                raise BadConfig(f"cannot accept {step.name}: {name}, which it reads, is not there")
            inputs[name] = digest
        facts = origin if before is None else {"commit": before.commit, "hardware": before.hardware}
        seconds = None if before is None else before.seconds
        records.put(step, record_of(step, survey.code(step), inputs, made, seconds=seconds, **facts))
