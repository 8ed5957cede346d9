"""Results that are not what the code, the commands and the data of today would give."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from functools import cache
from pathlib import Path
from typing import Final

from benches.results.everything import everything
from benches.results.records import Records
from benches.results.step import Places
from benches.results.survey import Survey

MARK: Final = "**Measured by earlier code"
"""Begins the paragraph that names them on a page."""

_FOLDER: Final = "processors/"
_OF_PROCESSORS: Final = "[those by processor](tables.md#by-processor)"
"""One link for the many files of that folder."""
_COMMITS: Final = "[last table](tables.md#repeat-it)"

_NOWHERE: Final = Path("no work folder")


@cache
def stale_results(folder: Path) -> frozenset[str]:
    """Files of a folder of results that are stale, as `tools/bench all --list` says in a fresh checkout."""
    graph = everything()
    places = Places(_NOWHERE, _NOWHERE, folder.absolute())
    statuses = Survey(graph, places, Records(graph, places)).statuses()
    return frozenset(
        name
        for step in graph.steps.values()
        if step.kind == "results" and statuses[step.name].state not in ("fresh", "absent")
        for _, name in step.results
    )


def outdated(stale: Collection[str], results: Iterable[str]) -> str:
    """A paragraph that names those of `results` that are stale; "" if none is."""
    links = [_OF_PROCESSORS if name.startswith(_FOLDER) else f"[{name}]({name})" for name in results if name in stale]
    if not links:
        return ""
    named = ", ".join(dict.fromkeys(links))
    return f"{MARK}**, at the commits of the {_COMMITS}: {named}. `tools/bench all --list` says what has changed.\n"


def without_mark(page: str) -> str:
    """A page without that paragraph, which follows from the code and not from the results."""
    lines = page.split("\n")
    kept = [number for number, line in enumerate(lines) if not line.startswith(MARK)]
    return "\n".join(lines[number] for number in kept)
