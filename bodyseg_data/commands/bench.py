"""`bodyseg bench`: measure speed and accuracy side by side in one run."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from bodyseg_data.benches.provenance import provenance
from bodyseg_data.commands.progress import Progress
from bodyseg_data.errors import BadConfig
from bodyseg_data.files import write_atomically
from bodyseg_data.options import option

EXAMPLE = "bodyseg bench occlusion --json occlusion.json"


@dataclass(frozen=True)
class Options:
    """What the command takes."""

    what: Literal["occlusion"] = option("what to measure", positional=True)
    json: Path | None = option("write the figures to this file (default: print them)", None)
    figure: Path | None = option("also draw where the errors are, to this PNG file", None)
    views: int = option("how many views to measure on", 60)


def run(options: Options) -> int:
    """Measure, and write or print the figures."""
    from bodyseg_data.benches.occlusion import bench_occlusion

    with Progress("measuring", "views") as progress:
        figures = bench_occlusion(options.views, progress.update)
    target = "" if options.json is None else f" --json {options.json}"
    tree = provenance(f"tools/bench {options.what} --views {options.views}{target}") | figures
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
        from bodyseg_data.benches.occlusion_figure import draw_occlusion

        draw_occlusion(options.figure)
        sys.stderr.write(f"wrote {options.figure}\n")
    return 0
