"""`tools/chart`: speed against accuracy, one chart a choice, from what the benches measured."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benches.charts.choices import CHOICES
from benches.charts.drawing import Picture, draw
from benches.charts.processors import ORIGIN, figures_of, panels_of
from benches.charts.report import described
from benches.results.page import render_page
from bodyseg_data.commands import option
from bodyseg_data.core import BadConfig
from bodyseg_data.files import make_folder, write_json, write_result

EXAMPLE = "tools/chart --in docs/results --out charts"

_ALL = "charts.json"


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    in_: Path = option("folder of the benches' figures: BENCH.json, or processors/PROCESSOR/BENCH.json", flag="in")
    out: Path = option("folder for the charts, CHOICE.svg and CHOICE.png each, and for charts.json; made if absent")
    page: tuple[Path, ...] = option(
        "also fill templates PATH.in with numbers of --in, and write them to these files", ()
    )


def run(options: Options) -> int:
    """Draw all that there are figures for. Returns 2 if there are none."""
    if not options.in_.is_dir():
        raise BadConfig(f"--in must be a folder, found {options.in_}")
    if options.out.resolve() == options.in_.resolve():
        raise BadConfig(f"--out must be another folder than --in, where pictures have the same names: {options.out}")
    templates = {page: _template(page) for page in options.page}  # before the work, not after it
    drawn: dict[str, Picture] = {}
    descriptions: dict[str, Any] = {}
    left_out: dict[str, str] = {}
    for choice in CHOICES:
        figures = figures_of(options.in_, choice.stem)
        if not figures:
            file = options.in_ / f"{choice.stem}.json"
            left_out[choice.name] = f"no {file.name}, which `tools/bench {choice.bench} --json {file}` makes"
            continue
        panels = panels_of(choice, figures)
        if not panels:
            left_out[choice.name] = f"nothing to compare in {', '.join(str(one.file) for one in figures)}"
            continue
        sources = [
            {"file": one.file.relative_to(options.in_).as_posix()} | {name: one.content[name] for name in ORIGIN}
            for one in figures
        ]
        drawn[choice.name] = draw(choice, panels, sources)
        descriptions[choice.name] = described(choice, panels, sources)
    for name, why in left_out.items():
        sys.stderr.write(f"chart {name} is left out: {why}\n")
    if not drawn:
        return 2
    summary = {"charts": descriptions, "left_out": sorted(left_out)}
    _write(options.out, drawn, summary)
    sys.stderr.write(f"wrote {len(drawn)} charts into {options.out}\n")
    for page, text in templates.items():
        write_result(page, render_page(text, options.in_, {"charts": summary}).encode())
        sys.stderr.write(f"wrote {page}\n")
    return 0


def _template(page: Path) -> str:
    template = page.with_name(page.name + ".in")
    try:
        return template.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BadConfig(f"--page needs a template of UTF-8 text: {template}: {error}") from error


def _write(out: Path, drawn: dict[str, Picture], descriptions: dict[str, Any]) -> None:
    make_folder(out)
    for name, picture in drawn.items():
        write_result(out / f"{name}.svg", picture.svg)
        write_result(out / f"{name}.png", picture.png)
    write_json(out / _ALL, descriptions)
