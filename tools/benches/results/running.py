"""Runs the steps that are stale, several at a time, and carries on where an earlier run was cut short."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from benches.environment import child_environment
from benches.results.records import Records, record_of
from benches.results.step import DATA, RESULTS, SHIPPED, TOOLS, Graph, Places, Step
from benches.results.survey import Status, Survey
from bodyseg_data.commands import provenance
from bodyseg_data.core import BadConfig
from bodyseg_data.files import write_result
from bodyseg_model.networks import SHIPPED as SHIPPED_FILE
from bodyseg_model.networks import RunFiles

PROGRAMS: Final = {
    "bodyseg": [sys.executable, "-m", "benches.model.networks.baselines"],  # `bodyseg` that knows rivals of ours, too
    "tools/bench": [sys.executable, "-m", "benches", "bench"],
    "tools/landmarks": [sys.executable, "-m", "benches", "landmarks"],
    "tools/chart": [sys.executable, "-m", "benches", "chart"],
}
"""First word of a step -> the program of this checkout. Any other word is a program of the system."""

_FIRST_CHECK_S, _CHECK_S = 0.01, 0.2  # each pause is twice the one before: short steps are seen at once
_GRACE_S: Final = 60.0  # in which a step that is interrupted may end in order


@dataclass
class _Running:
    step: Step
    process: subprocess.Popen[bytes]
    inputs: dict[str, str]
    origin: dict[str, str]
    log: Path
    before: int  # bytes of the log, which is that of all runs
    start: float = field(default_factory=time.monotonic)


class Runner:
    """Runs steps in a work folder.

    jobs: number of steps at a time. say: prints a line when a step begins and when it ends.
    """

    def __init__(
        self, graph: Graph, places: Places, records: Records, survey: Survey, jobs: int, say: Callable[[str], None]
    ) -> None:
        self._graph, self._places, self._records, self._survey = graph, places, records, survey
        self._jobs, self._say = jobs, say
        self.failed: set[str] = set()
        self.made: set[str] = set()
        self._running: list[_Running] = []

    def run(self, chosen: set[str]) -> dict[str, Status]:
        """Make those of the chosen steps that are stale, and what they need; returns the statuses afterwards.

        A step that fails stops the steps that read its product, and no others. A KeyboardInterrupt ends the running
        steps in order: the next run carries their trainings and sets on. Raises BadConfig as `Survey.statuses`.
        """
        try:
            while True:
                statuses = self._survey.statuses()
                wanted = self._wanted(chosen, statuses)
                self._start(wanted, statuses)
                if not self._running:
                    return statuses
                self._wait()
        finally:
            self._stop()

    def _wanted(self, chosen: set[str], statuses: dict[str, Status]) -> set[str]:
        """Names of stale steps that are chosen or needed by one that is, and of absent ones that are needed."""
        found: set[str] = set()
        waiting = [name for name in chosen if statuses[name].state == "stale"]
        while waiting:
            name = waiting.pop()
            if name in found or statuses[name].state not in ("stale", "absent"):
                continue
            found.add(name)
            step = self._graph.steps[name]
            if step.kind != "page":  # which is of the results that are there
                waiting += self._graph.inputs(step)
        return found - self.failed - self.made

    def _start(self, wanted: set[str], statuses: dict[str, Status]) -> None:
        for step in self._in_turn(statuses):
            busy = {each.step.name for each in self._running}
            if step.name not in wanted or step.name in busy:
                continue
            if len(self._running) == self._jobs or any(each.step.alone for each in self._running):
                return
            if step.alone and self._running:
                continue
            if step.kind == "page" and (busy or self._more(wanted - {step.name}, statuses)):
                continue
            inputs = statuses[step.name].inputs
            if inputs is not None:
                try:
                    self._begin(step, inputs)
                except BadConfig as error:
                    self._fail(step, str(error))

    def _in_turn(self, statuses: dict[str, Status]) -> list[Step]:
        """All steps in the graph's order; of several at a time, first those without a record, then those that took
        longest, so that none is left alone at the end.
        """
        steps = [*self._graph.steps.values()]
        if self._jobs == 1:
            return steps
        taken = {name: math.inf if status.seconds is None else status.seconds for name, status in statuses.items()}
        return sorted(steps, key=lambda step: -taken[step.name])

    def _more(self, wanted: set[str], statuses: dict[str, Status]) -> bool:
        """True if one of these steps can still run."""
        return any(statuses[name].inputs is not None for name in wanted)

    def _begin(self, step: Step, inputs: dict[str, str]) -> None:
        key = self._survey.key(step, inputs)
        work = self._places.work
        if step.kind in ("set", "training") and self._records.begun(step) != key:
            _set_aside(work, step.name)
        for link, target in step.links:
            _link(work / link, SHIPPED_FILE if target == SHIPPED else work / target / RunFiles.NETWORK)
        for source, _ in step.results:
            self._places.path(source).parent.mkdir(parents=True, exist_ok=True)
        (work / step.name).parent.mkdir(parents=True, exist_ok=True)
        log = self._log(step)
        log.parent.mkdir(parents=True, exist_ok=True)
        self._records.begin(step, key)
        program, *words = step.words
        tops = f"{DATA}/", RESULTS, f"{TOOLS}/"
        named = [str(self._places.path(word)) if word.startswith(tops) else word for word in words]
        origin = provenance(step.command)
        facts = {name: origin[name] for name in ("commit", "hardware")}
        with log.open("ab") as file:
            before = file.tell()
            try:
                process = subprocess.Popen(
                    [*PROGRAMS.get(program, [program]), *named],
                    cwd=work,
                    env=child_environment(),
                    stdin=subprocess.DEVNULL,
                    stdout=file,
                    stderr=subprocess.STDOUT,
                )
            except OSError as error:
                raise BadConfig(f"cannot run {program}: {error.strerror or error}") from error
            self._running.append(_Running(step, process, inputs, facts, log, before))  # at once: an interrupt ends it
        self._say(f"begun   {step.name}")

    def _wait(self) -> None:
        """Wait until a step has ended, and keep what it made."""
        pause_s = _FIRST_CHECK_S
        while not (ended := [each for each in self._running if each.process.poll() is not None]):
            time.sleep(pause_s)
            pause_s = min(2 * pause_s, _CHECK_S)
        for each in ended:
            self._running.remove(each)
            self._end(each)

    def _end(self, done: _Running) -> None:
        step, seconds = done.step, time.monotonic() - done.start
        if done.process.returncode != 0:
            said = done.log.read_bytes()[done.before :].decode(errors="replace").split("\n")
            last = next((line.strip() for line in reversed(said) if line.strip()), "")
            self._fail(step, last or f"exit status {done.process.returncode}")
            return
        try:
            self._publish(step)
        except BadConfig as error:
            self._fail(step, str(error))
            return
        made = self._survey.products.made_by(step)
        if made is None:
            self._fail(step, "the command ended well, but its product is not there")
            return
        facts = {"seconds": round(seconds, 1), **done.origin}
        self._records.put(step, record_of(step, self._survey.code(step), done.inputs, made, **facts))
        self.made.add(step.name)
        self._say(f"done    {step.name} in {duration(seconds)}")

    def _fail(self, step: Step, why: str) -> None:
        self.failed.add(step.name)
        self._say(f"failed  {step.name}: {why} ({self._log(step)})")

    def _publish(self, step: Step) -> None:
        """Copy results from the work folder into docs/results. Raises BadConfig."""
        for source, name in step.results:
            path, target = self._places.path(source), self._places.results / name
            if path == target:
                continue
            if not path.exists():
                raise BadConfig(f"the command ended well, but made no {source}")
            for file in [path] if path.is_file() else sorted(each for each in path.iterdir() if each.is_file()):
                goal = target if path.is_file() else target / file.name
                goal.parent.mkdir(parents=True, exist_ok=True)
                write_result(goal, file.read_bytes())

    def _stop(self) -> None:
        for each in self._running:
            each.process.terminate()
        for each in self._running:
            try:
                each.process.wait(_GRACE_S)
            except subprocess.TimeoutExpired:
                each.process.kill()
                each.process.wait()
            self._say(f"stopped {each.step.name}")
        self._running.clear()

    def _log(self, step: Step) -> Path:
        return self._places.work / "logs" / f"{step.name.replace('/', '.')}.log"


def duration(seconds: float) -> str:
    """A time in the largest unit that gives two digits: "95 s", "12 min", "3.4 h"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5970 else f"{seconds / 3600:.1f} h"


def _set_aside(work: Path, name: str) -> None:
    """Move a product of other code or other inputs to WORK/replaced, so that nothing is lost."""
    product = work / name
    if not product.exists():
        return
    folder = work / "replaced"
    number = next(each for each in range(1, 10**9) if not (folder / f"{name}.{each}").exists())
    target = folder / f"{name}.{number}"
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(product, target)


def _link(folder: Path, weights: Path) -> None:
    """Make a run's folder whose network is a link to `weights` and its card. Raises BadConfig if a network is there.

    The folder itself is no link, since commands name a run after the folder that it is in.
    """
    for target in (weights, weights.with_suffix(".json")):
        link = (folder / RunFiles.NETWORK).with_suffix(target.suffix)
        if link.exists() and not link.is_symlink():
            raise BadConfig(f"{link} must be a link to {target}: move it away")
        folder.mkdir(parents=True, exist_ok=True)
        link.unlink(missing_ok=True)
        link.symlink_to(os.path.relpath(target.resolve(), folder.resolve()))
