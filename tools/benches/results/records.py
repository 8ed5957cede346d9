"""Records of the steps that ran: what each one read, what it made, with which code, and how long that took.

WORK/steps.json has those of sets and trainings, which lie in the work folder. docs/results/steps.json has those of
results, and of the sets and trainings that these were made from: so a fresh checkout can say which results are stale.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final

from benches.results.step import Graph, Places, Step
from bodyseg_data.core import BadConfig
from bodyseg_data.files import write_result

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

    @classmethod
    def from_json(cls, tree: Any, where: str) -> Record:
        """Read what `asdict` gives. Raises BadConfig for anything else."""
        try:
            return cls(**{field.name: tree[field.name] for field in fields(cls)})
        except (TypeError, LookupError) as error:
            raise BadConfig(f"{where} is no record of a step: {error!r}") from error


class Records:
    """The records of a work folder and of docs/results, in their two files."""

    def __init__(self, graph: Graph, places: Places) -> None:
        self._graph = graph
        self._files = {"work": places.work / RECORDS, "results": places.results / RECORDS}
        self._records = {name: self._read(file) for name, file in self._files.items()}
        self._begun = self._read_begun()

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

    def _read(self, file: Path) -> dict[str, Record]:
        return {name: Record.from_json(tree, f"{file}: {name}") for name, tree in _read_records(file).items()}

    def _read_begun(self) -> dict[str, str]:
        file = self._files["work"]
        return dict(json.loads(file.read_text()).get("begun", {})) if file.exists() else {}

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


def _read_records(path: Path) -> dict[str, Any]:
    """Step -> record as JSON; none if there is no such file. Raises BadConfig for a file that holds no records."""
    if not path.exists():
        return {}
    try:
        steps = json.loads(path.read_text(encoding="utf-8"))["steps"]
        if not all(isinstance(record["made"], dict) for record in steps.values()):
            raise TypeError("made must be a table")
    except (OSError, ValueError, TypeError, LookupError, AttributeError) as error:
        raise BadConfig(f"{path} holds no records of steps: {error!r}") from error
    return dict(steps)
