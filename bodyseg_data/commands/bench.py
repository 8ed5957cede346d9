"""`bodyseg bench`: measure speed and accuracy side by side in one run."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
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

    what: Literal[
        "occlusion", "borders", "render", "scaling", "partition", "reduction", "interpenetration", "proposal"
    ] = option("what to measure", positional=True)
    json: Path | None = option("write the figures to this file (default: print them)", None)
    figure: Path | None = option("also draw the methods and their errors to this PNG file", None)
    views: int | None = option(
        "how many views to measure on (default: 60; for borders 12 of each body, for scaling 54, for render 486; "
        "for reduction 4 of each body; for interpenetration: one frame in how many, 5)",
        None,
    )
    mit: Path | None = option("for partition, reduction and proposal: folder of MIT frames to measure on as well", None)


def run(options: Options) -> int:
    """Measure, and write or print the figures."""
    if options.what == "scaling" and options.figure is not None:
        raise BadConfig("bench scaling measures three numbers and draws no figure: leave --figure out")
    if options.what == "interpenetration" and options.figure is not None:
        raise BadConfig("bench interpenetration draws no figure: leave --figure out")
    if options.what == "proposal" and options.figure is not None:
        raise BadConfig("bench proposal draws no figure: leave --figure out")
    if options.what in ("partition", "proposal") and options.views is not None:
        raise BadConfig(f"bench {options.what} measures whole bodies: leave --views out")
    if options.what not in ("partition", "reduction", "proposal") and options.mit is not None:
        raise BadConfig(f"--mit is for bench partition, reduction and proposal, found it with bench {options.what}")
    with Progress("measuring", "steps") as progress:
        counted = {} if options.views is None else {"views": options.views}
        figures = _measure(options)(progress=progress.update, **counted)
    target = "" if options.json is None else f" --json {options.json}"
    counted_as = f" --views {figures['views']}" if "views" in figures else ""
    frames = "" if options.mit is None else f" --mit {options.mit.name}"
    tree = provenance(f"tools/bench {options.what}{counted_as}{frames}{target}") | figures
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
        _draw(options, figures)(options.figure)
        sys.stderr.write(f"wrote {options.figure}\n")
    return 0


def _measure(options: Options) -> Callable[..., dict[str, Any]]:
    if options.what == "partition":
        from bodyseg_data.benches.partition import bench_partition

        return partial(bench_partition, mit=options.mit)
    if options.what == "reduction":
        from bodyseg_data.benches.reduction import bench_reduction

        return partial(bench_reduction, mit=options.mit)
    if options.what == "proposal":
        from bodyseg_data.benches.proposal import bench_proposal

        return partial(bench_proposal, mit=options.mit)
    if options.what == "borders":
        from bodyseg_data.benches.borders import bench_borders

        return bench_borders
    if options.what == "render":
        from bodyseg_data.benches.render import bench_render

        return bench_render
    if options.what == "scaling":
        from bodyseg_data.benches.scaling import bench_scaling

        return bench_scaling
    if options.what == "interpenetration":
        from bodyseg_data.benches.interpenetration import bench_interpenetration

        return bench_interpenetration
    from bodyseg_data.benches.occlusion import bench_occlusion

    return bench_occlusion


def _draw(options: Options, figures: dict[str, Any]) -> Callable[[Path], None]:
    if options.what == "render":
        from bodyseg_data.benches.render_figure import draw_render

        return partial(draw_render, figures)
    if options.what == "partition":
        from bodyseg_data.benches.partition_figure import draw_partition

        return partial(draw_partition, figures)
    if options.what == "reduction":
        from bodyseg_data.benches.reduction_figure import draw_reduction

        return partial(draw_reduction, figures)
    if options.what == "borders":
        from bodyseg_data.benches.borders_figure import draw_borders

        return draw_borders
    from bodyseg_data.benches.occlusion_figure import draw_occlusion

    return draw_occlusion
