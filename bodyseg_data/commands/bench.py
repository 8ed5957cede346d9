"""`bodyseg bench`: measure speed and accuracy side by side in one run."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from bodyseg_data.benches.provenance import provenance
from bodyseg_data.commands.progress import Progress
from bodyseg_data.errors import BadConfig
from bodyseg_data.files import write_atomically
from bodyseg_data.options import option

EXAMPLE = "bodyseg bench occlusion --json occlusion.json"


@dataclass(frozen=True)
class Options:
    """What the command takes."""

    what: Literal["occlusion", "borders"] = option("what to measure", positional=True)
    json: Path | None = option("write the figures to this file (default: print them)", None)
    figure: Path | None = option("also draw the methods and their errors to this PNG file", None)
    views: int | None = option("how many views to measure on (default: 60; for borders 12 of each body)", None)


def run(options: Options) -> int:
    """Measure, and write or print the figures."""
    with Progress("measuring", "steps") as progress:
        counted = {} if options.views is None else {"views": options.views}
        figures = _measure(options)(progress=progress.update, **counted)
    target = "" if options.json is None else f" --json {options.json}"
    tree = provenance(f"tools/bench {options.what} --views {figures['views']}{target}") | figures
    text = json.dumps(tree, indent=1) + "\n"
    if options.json is None:
        sys.stdout.write(text)
    else:
        try:
            write_atomically(options.json, text.encode())
        except OSError as error:
            raise BadConfig(f"cannot write {options.json}: {error.strerror or error}") from error
        sys.stderr.write(f"wrote {options.json}\n")
    if options.figure is not None:
        _draw(options)(options.figure)
        sys.stderr.write(f"wrote {options.figure}\n")
    return 0


def _measure(options: Options) -> Callable[..., dict[str, Any]]:
    if options.what == "borders":
        from bodyseg_data.benches.borders import bench_borders

        return bench_borders
    from bodyseg_data.benches.occlusion import bench_occlusion

    return bench_occlusion


def _draw(options: Options) -> Callable[[Path], None]:
    if options.what == "borders":
        from bodyseg_data.benches.borders_figure import draw_borders

        return draw_borders
    from bodyseg_data.benches.occlusion_figure import draw_occlusion

    return draw_occlusion
