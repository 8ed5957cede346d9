"""Results by processor: RESULTS/processors/PROCESSOR/BENCH.json, beside RESULTS/BENCH.json of benches measured once."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

from benches.charts.choice import Choice, Panel
from bodyseg_data.core import BadConfig
from bodyseg_data.files import read_json

FOLDER: Final = "processors"
HEAD: Final = ("folder", "name")
"""What a record says of a processor itself."""

ORIGIN: Final = ("command", "commit", "hardware")
"""What every file of figures says of itself."""

_HARDWARE: Final = re.compile(r"(\d+) cores? of (.+?)(?: \(|$)")


def processor_name(hardware: str) -> str:
    """Processor and number of cores ("AMD EPYC, 2 cores") of a line that `core.system.machine.hardware` returned.

    Raises BadConfig for another line.
    """
    found = _HARDWARE.match(hardware)
    if found is None:
        raise BadConfig(f"hardware must read 'N cores of PROCESSOR (ARCHITECTURE), N GiB', found {hardware!r}")
    count = int(found[1])
    return f"{found[2]}, {count} core{'s' if count > 1 else ''}"


def folder_name(hardware: str) -> str:
    """`processor_name` as the name of a folder: small letters and digits, joined by hyphens."""
    return re.sub(r"[^a-z0-9]+", "-", processor_name(hardware).lower()).strip("-")


class Measured(NamedTuple):
    """A file of figures."""

    file: Path
    content: dict[str, Any]


def figures_of(results: Path, bench: str) -> list[Measured]:
    """Figures of a bench in a folder of results: those of the folder itself, then those of each processor by name.

    Raises BadConfig for a file that is damaged or lies in the folder of another processor.
    """
    alone = results / f"{bench}.json"
    found = [Measured(alone, read_json(alone))] if alone.exists() else []
    found += [_of_processor(file) for file in sorted((results / FOLDER).glob(f"*/{bench}.json"))]
    for file, content in found:
        missing = [name for name in ORIGIN if not isinstance(content.get(name), str)]
        if missing:
            raise BadConfig(f"{file} must say its {', '.join(missing)}")
    return found


def by_processor(results: Path) -> list[dict[str, Any]]:
    """A record of each processor: its folder, its name, and the content of its files BENCH.json under BENCH.

    Raises BadConfig as `figures_of` does.
    """
    records: dict[str, dict[str, Any]] = {}
    for file in sorted((results / FOLDER).glob("*/*.json")):
        figures = _of_processor(file).content
        head = (file.parent.name, processor_name(figures["hardware"]))
        records.setdefault(file.parent.name, dict(zip(HEAD, head, strict=True)))[file.stem] = figures
    return list(records.values())


def panels_of(choice: Choice, figures: Sequence[Measured]) -> tuple[Panel, ...]:
    """A choice's panels from the figures of each processor; where there are several, its name leads the panel's.

    Raises BadConfig as `Choice.panels` does.
    """
    panels = []
    for one in figures:
        head = f"{processor_name(one.content['hardware'])}: " if len(figures) > 1 else ""
        panels += [replace(panel, name=head + panel.name) for panel in choice.panels(one.content, one.file)]
    return tuple(panels)


def _of_processor(file: Path) -> Measured:
    content = read_json(file)
    hardware = str(content.get("hardware"))
    wanted = folder_name(hardware)
    if file.parent.name != wanted:
        raise BadConfig(f"{file} was measured on {hardware}: it belongs into {FOLDER}/{wanted}")
    return Measured(file, content)
