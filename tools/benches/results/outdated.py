"""Results that are not what the code, the commands and the data of today would give."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Final

from benches.results.everything import everything
from benches.results.records import Records
from benches.results.step import Places
from benches.results.survey import Survey

NEVER: Final = "never made"
"""The reason of a result without a record: `tools/bench all` has not made it, and nothing says by which code it was."""

MARK: Final = "**Not measured by the code of today"
"""Begins the paragraph that names them on a page."""

_FOLDER: Final = "processors/"
_OF_PROCESSORS: Final = "[those by processor](tables.md#by-processor)"
"""One link for the many files of that folder."""

_NOWHERE: Final = Path("no work folder")


@cache
def stale_results(folder: Path) -> dict[str, str]:
    """File of a folder of results -> why it is stale, as `tools/bench all --list` says it in a fresh checkout."""
    graph = everything()
    places = Places(_NOWHERE, _NOWHERE, folder.absolute())
    records = Records(graph, places)
    statuses = Survey(graph, places, records).statuses()
    return {
        name: NEVER if records.get(step) is None else statuses[step.name].reason
        for step in graph.steps.values()
        if step.kind == "results" and statuses[step.name].state not in ("fresh", "absent")
        for _, name in step.results
    }


def outdated(stale: Mapping[str, str], results: Iterable[str]) -> str:
    """A paragraph that names those of `results` that are stale; "" if none is."""
    links = {
        name: _OF_PROCESSORS if name.startswith(_FOLDER) else f"[{name}]({name})" for name in results if name in stale
    }
    if not links:
        return ""
    known, unknown = (
        list(dict.fromkeys(link for name, link in links.items() if (stale[name] == NEVER) is never))
        for never in (False, True)
    )
    parts = []
    if known:
        parts.append(f"the code, a command or the data has changed since: {', '.join(known)}")
    if unknown:
        parts.append(f"measured by hand, so that nothing records the code: {', '.join(unknown)}")
    return f"{MARK}**, and to be measured anew: {'; '.join(parts)}. `tools/bench all --list` says why.\n"


def without_mark(page: str) -> str:
    """A page without that paragraph, which follows from the code and not from the results."""
    lines = page.split("\n")
    kept = [number for number, line in enumerate(lines) if not line.startswith(MARK)]
    return "\n".join(lines[number] for number in kept)
