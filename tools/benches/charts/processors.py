"""Results by processor: RESULTS/processors/PROCESSOR/BENCH.json, beside RESULTS/BENCH.json of benches measured once."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from benches.charts.choice import Choice, Panel
from benches.charts.fields import Field, read_fields
from bodyseg_data.core import BadConfig

FOLDER: Final = "processors"
HEAD: Final = ("folder", "name")
"""What a record says of a processor itself."""

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


def figures_of(results: Path, bench: str) -> list[Field]:
    """Figures of a bench in a folder of results: those of the folder itself, then those of each processor by name.

    Raises BadConfig for a file that is damaged or lies in the folder of another processor.
    """
    alone = results / f"{bench}.json"
    found = [read_fields(alone)] if alone.exists() else []
    return found + [_of_processor(file) for file in sorted((results / FOLDER).glob(f"*/{bench}.json"))]


def by_processor(results: Path) -> list[dict[str, Any]]:
    """A record of each processor: its folder, its name, and the content of its files BENCH.json under BENCH.

    Raises BadConfig as `figures_of` does.
    """
    records: dict[str, dict[str, Any]] = {}
    for file in sorted((results / FOLDER).glob("*/*.json")):
        fields = _of_processor(file)
        record = records.setdefault(file.parent.name, _head(fields))
        record[file.stem] = fields.value
    return list(records.values())


def panels_of(choice: Choice, figures: Sequence[Field]) -> tuple[Panel, ...]:
    """A choice's panels from the figures of each processor; where there are several, its name leads the panel's.

    Raises BadConfig as `Choice.panels` does.
    """
    panels = []
    for one in figures:
        head = f"{processor_name(one['hardware'].text())}: " if len(figures) > 1 else ""
        panels += [replace(panel, name=head + panel.name) for panel in choice.panels(one)]
    return tuple(panels)


def _head(fields: Field) -> dict[str, Any]:
    return dict(zip(HEAD, (fields.file.parent.name, processor_name(fields["hardware"].text())), strict=True))


def _of_processor(file: Path) -> Field:
    fields = read_fields(file)
    wanted = folder_name(fields["hardware"].text())
    if file.parent.name != wanted:
        raise BadConfig(f"{file} was measured on {fields['hardware'].text()}: it belongs into {FOLDER}/{wanted}")
    return fields
