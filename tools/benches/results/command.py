"""`tools/bench all`: make all results on accuracy anew, as far as they are stale."""

from __future__ import annotations

import contextlib
import sys
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

from benches.results.everything import everything
from benches.results.records import Records
from benches.results.running import Runner, duration
from benches.results.step import Graph, Places
from benches.results.survey import Status, Survey, accept
from bodyseg_data.commands import option, provenance
from bodyseg_data.core import BadConfig, check_int
from bodyseg_data.files import claimed

EXAMPLE = "tools/bench all --work ../work --data ../data --jobs 2"

ROOT: Final = Path(__file__).parents[3]


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    work: Path = option("folder of sets, trainings, logs and records; made if absent")
    data: Path | None = option("folder of external data: faust, mit, real (default: data in the work folder)", None)
    only: tuple[str, ...] = option("patterns of names of steps, like 'stability*' 'runs/ablation/*' (default: all)", ())
    list: bool = option("print the state of every step, and run none", False)
    jobs: int = option("number of steps that run at a time", 1)
    accept: bool = option(
        "run none, but record what is there as made by the code, inputs and commands of today: after a change that "
        "alters no result",
        False,
    )
    results: Path = option("folder of results", ROOT / "docs" / "results")


def run(options: Options) -> int:
    """Make what is stale. Returns 0 if all steps chosen are fresh at the end, else 1."""
    return run_graph(options, everything())


def run_graph(options: Options, graph: Graph, code: Callable[[tuple[str, ...]], str] | None = None) -> int:
    """`run` with the steps of any graph. code: digest of modules."""
    check_int("--jobs", options.jobs, 1)
    if not options.results.is_dir():
        raise BadConfig(f"--results must be a folder, found {options.results}")
    chosen = _chosen(graph, options.only)
    work = options.work.absolute()
    data = work / "data" if options.data is None else options.data.absolute()
    places = Places(work, data, options.results.absolute())
    with contextlib.ExitStack() as stack:
        if not options.list:
            stack.enter_context(claimed(work, "tools/bench all"))
        records = Records(graph, places)
        survey = Survey(graph, places, records) if code is None else Survey(graph, places, records, code)
        if options.accept:
            origin = provenance("")
            accept(survey, graph, records, chosen, {name: origin[name] for name in ("commit", "hardware")})
        if options.list or options.accept:
            statuses = survey.statuses()
            sys.stdout.write(table({name: statuses[name] for name in chosen}))
        else:
            runner = Runner(graph, places, records, survey, options.jobs, _say)
            statuses = runner.run({*chosen})
            _say(summary(runner, {name: statuses[name] for name in chosen}))
    return int(any(statuses[name].state not in ("fresh", "absent") for name in chosen))


def table(statuses: Mapping[str, Status]) -> str:
    """A line for every step, with its state, the time of its last run, and why it is not fresh; then their numbers."""
    width = max(map(len, statuses))
    lines = []
    for name, status in statuses.items():
        seconds = "" if status.seconds is None else duration(status.seconds)
        lines.append(f"{name:{width}}  {status.state:7}  {seconds:>7}  {status.reason}".rstrip())
    counts = Counter(status.state for status in statuses.values())
    stale = [status.seconds for status in statuses.values() if status.state == "stale"]
    timed = [seconds for seconds in stale if seconds is not None]
    numbers = ", ".join(f"{count} {state}" for state, count in sorted(counts.items()))
    more = f", {len(stale) - len(timed)} of them never timed" if len(timed) < len(stale) else ""
    expected = f"; the stale ones took {duration(sum(timed))} last time{more}" if stale else ""
    return "\n".join([*lines, f"{len(statuses)} steps: {numbers}{expected}", ""])


def summary(runner: Runner, statuses: Mapping[str, Status]) -> str:
    """One line on a whole run."""
    parts = [f"{len(runner.made)} made"]
    if runner.failed:
        parts.append(f"{len(runner.failed)} failed ({', '.join(sorted(runner.failed))})")
    for state, word in (("stale", "not made"), ("blocked", "blocked")):
        names = [name for name, status in statuses.items() if status.state == state and name not in runner.failed]
        if names:
            first = f"{names[0]}: {statuses[names[0]].reason}"
            parts.append(f"{len(names)} {word} ({first}{', ...' if len(names) > 1 else ''})")
    fresh = sum(status.state in ("fresh", "absent") for status in statuses.values())
    return ", ".join([*parts, f"{fresh} fresh"])


def _chosen(graph: Graph, patterns: tuple[str, ...]) -> list[str]:
    for pattern in patterns:
        if not any(fnmatchcase(name, pattern) for name in graph.steps):
            raise BadConfig(f"--only {pattern} matches no step; --list prints their names")
    return [name for name in graph.steps if not patterns or any(fnmatchcase(name, each) for each in patterns)]


def _say(line: str) -> None:
    sys.stderr.write(f"{line}\n")
    sys.stderr.flush()
