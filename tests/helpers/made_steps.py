"""Steps of tiny shell commands, for tests of `tools/bench all`: a set, two trainings, their results, a page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benches.results.command import Options, run_graph
from benches.results.step import Graph, Places, Step

SET = 'mkdir -p "$1" && cp "$0" "$1/manifest.json"'
TRAINING = """mkdir -p "$1"
cat "$0/manifest.json" > "$1/network.safetensors"
echo '{"network": "toy"}' > "$1/network.json"
"""
RESULT = """echo "{\\"of\\": \\"$(cat "$0/network.safetensors")\\"}" > "$1" """
PAGE = 'cat "$0"/?.json > "$1"'


def shell(name: str, kind: Any, script: str, *words: str, **facts: Any) -> Step:
    """A step that runs a script of the shell with `words` as $0, $1 ..."""
    return Step(name, kind, ("sh", "-ec", script, *words), **{"modules": (f"code.of.{name}",), **facts})


def a_set(script: str = SET, name: str = "sets/a") -> Step:
    """A set that is a copy of the file data/bodies."""
    return shell(name, "set", script, "data/bodies", name)


def a_training(name: str, script: str = TRAINING, **facts: Any) -> Step:
    """A training whose weights are the set's bytes."""
    return shell(name, "training", script, "sets/a", name, **facts)


def a_result(name: str, run: str, script: str = RESULT, **facts: Any) -> Step:
    """A JSON file with the weights of a training."""
    files = ((f"results/{name}.json", f"{name}.json"),)
    return shell(name, "results", script, run, f"results/{name}.json", results=files, **facts)


def a_page(*results: str) -> Step:
    """All results in one file."""
    files = (("docs/results/index.md", "index.md"),)
    reads = tuple(f"docs/results/{name}.json" for name in results)
    return shell("page", "page", PAGE, "docs/results", "docs/results/index.md", results=files, reads=reads)


def usual() -> list[Step]:
    """A set, two trainings, a result of each, and the page."""
    return [
        a_set(),
        a_training("runs/x-0"),
        a_training("runs/y-0"),
        a_result("x", "runs/x-0"),
        a_result("y", "runs/y-0"),
        a_page("x", "y"),
    ]


@dataclass
class Workshop:
    """A work folder, external data and a folder of results; and the code of every module, as a text of its own."""

    home: Path
    steps: list[Step] = field(default_factory=usual)
    code: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("data", "results"):
            (self.home / name).mkdir(exist_ok=True)
        (self.home / "data" / "bodies").write_text("bodies")

    @property
    def places(self) -> Places:
        return Places(self.home / "work", self.home / "data", self.home / "results")

    def run(self, *only: str, **facts: Any) -> int:
        """Run or list the steps; returns the exit status."""
        places = self.places
        options = Options(places.work, places.data, only, results=places.results, **facts)
        return run_graph(options, Graph(self.steps), lambda modules: self.code.get(modules[0], "code"))

    def results(self) -> dict[str, Any]:
        """Name -> content of the JSON files of results, without the records."""
        files: Sequence[Path] = sorted((self.home / "results").glob("*.json"))
        return {file.stem: json.loads(file.read_text()) for file in files if file.stem != "steps"}

    def records(self) -> dict[str, Any]:
        """Step -> record, as docs/results has them."""
        return dict(json.loads((self.home / "results" / "steps.json").read_text())["steps"])
