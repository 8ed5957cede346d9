"""Records of the steps that ran: what each one read, what it made, with which code, and how long that took.

WORK/steps.json has those of sets and trainings, which lie in the work folder. docs/results/steps.json has those of
results, and of the sets and trainings that these were made from: so a fresh checkout can say which results are stale.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from benches.results.step import Graph, Places, Step
from bodyseg_data.core import BadConfig
from bodyseg_data.files import read_json, write_result

FORMAT: Final = "bodyseg steps 1"
RECORDS: Final = "steps.json"


@dataclass(frozen=True)
class Record:
    """One run of a step.

    code: digest of the modules; None: not known. inputs: step or external product -> digest of what was read.
    made: product -> digest. seconds: it took; None: not known.
    """

    command: str
    code: str | None
    inputs: Mapping[str, str]
    made: Mapping[str, str]
    seconds: float | None
    commit: str
    hardware: str


class Records:
    """The records of a work folder and of docs/results, in their two files."""

    def __init__(self, graph: Graph, places: Places) -> None:
        self._graph = graph
        self._files = {"work": places.work / RECORDS, "results": places.results / RECORDS}
        self._records = {name: _read(file) for name, file in self._files.items()}
        work = self._files["work"]
        self._begun: dict[str, str] = read_json(work).get("begun", {}) if work.exists() else {}

    def get(self, step: Step) -> Record | None:
        """The last run of a step, as far as its product may still be there; None if there is none."""
        published = self._records["results"].get(step.name)
        if step.kind in ("set", "training"):
            return self._records["work"].get(step.name) or published
        return published

    def begun(self, step: Step) -> str | None:
        """The key with which a step has begun, or has run to its end; None if it never began here."""
        return self._begun.get(step.name)

    def begin(self, step: Step, key: str) -> None:
        """Remember that a step begins. Raises BadConfig if the file cannot be written."""
        self._begun[step.name] = key
        self._write("work")

    def put(self, step: Step, record: Record) -> None:
        """Keep a record; that of results together with those of all that they were made from. Raises BadConfig."""
        if step.kind in ("set", "training"):
            self._records["work"][step.name] = record
            self._write("work")
            return
        for name in self._graph.with_inputs([step.name]):
            if (each := self.get(self._graph.steps[name])) is not None:
                self._records["results"][name] = each
        self._records["results"][step.name] = record
        self._write("results")

    def _write(self, name: str) -> None:
        kept = sorted((step, record) for step, record in self._records[name].items() if step in self._graph.steps)
        steps = {step: asdict(record) for step, record in kept}
        tree: dict[str, Any] = {"format": FORMAT, "steps": steps}
        if name == "work":
            tree["begun"] = self._begun
        write_result(self._files[name], (json.dumps(tree, indent=1) + "\n").encode())


def record_of(step: Step, code: str, inputs: Mapping[str, str], made: Mapping[str, str], **facts: Any) -> Record:
    """The record of a run. facts: seconds, commit, hardware."""
    return Record(step.command, code, dict(inputs), dict(made), **facts)


def _read(file: Path) -> dict[str, Record]:
    """The records of a file, by step; none if there is no such file. Raises BadConfig for a file that holds none."""
    if not file.exists():
        return {}
    try:
        return {name: Record(**tree) for name, tree in read_json(file)["steps"].items()}
    except (TypeError, LookupError, AttributeError) as error:
        raise BadConfig(f"{file} holds no records of steps: {error!r}") from error
