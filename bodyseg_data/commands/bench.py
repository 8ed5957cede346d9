"""`bodyseg bench`: measure speed and accuracy side by side in one run."""

from __future__ import annotations

import importlib
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from bodyseg_data.benches.provenance import check_target, provenance, write_figures
from bodyseg_data.commands.progress import Progress
from bodyseg_data.errors import BadConfig
from bodyseg_data.options import option
from bodyseg_data.pictures import check_picture

EXAMPLE = "bodyseg bench occlusion --json occlusion.json"


@dataclass(frozen=True)
class _Bench:
    """What a bench takes. views: what --views counts, and its default; None if it measures whole bodies. figure:
    whether it draws one. mit: whether it also measures on MIT frames. workers: whether it loads with workers.
    """

    views: str | None = None
    figure: bool = False
    mit: bool = False
    workers: bool = False


BENCHES: Final = {
    "occlusion": _Bench("views in all, 60", figure=True),
    "borders": _Bench("views of each body, 12", figure=True),
    "partition": _Bench(figure=True, mit=True),
    "reduction": _Bench("views of each body, 4", figure=True, mit=True),
    "render": _Bench("views in all, 486", figure=True),
    "scaling": _Bench("views of each body, 54"),
    "interpenetration": _Bench("one frame in how many, 5"),
    "clothes": _Bench(mit=True),
    "proposal": _Bench(mit=True),
    "reliability": _Bench("hostile inputs in all, 100000"),
    "codec": _Bench("samples in all, 60", figure=True),
    "loader": _Bench("samples in all, 1080", figure=True, workers=True),
}
"""Name -> what it takes. `benches/NAME.py` measures by its `bench_NAME`, `benches/NAME_figure.py` draws."""

_COUNTS: Final = "; ".join(f"{name}: {bench.views}" for name, bench in BENCHES.items() if bench.views)
_WITH_MIT: Final = ", ".join(name for name, bench in BENCHES.items() if bench.mit)


@dataclass(frozen=True)
class Options:
    """What the command takes."""

    what: Literal[
        "occlusion",
        "borders",
        "partition",
        "reduction",
        "render",
        "scaling",
        "interpenetration",
        "clothes",
        "proposal",
        "reliability",
        "codec",
        "loader",
    ] = option("what to measure", positional=True)
    json: Path | None = option("write the figures to this file (default: print them)", None)
    figure: Path | None = option("also draw what was measured to this PNG file", None)
    views: int | None = option(f"how much to measure on ({_COUNTS})", None)
    mit: Path | None = option(f"for {_WITH_MIT}: folder of MIT frames to measure on as well", None)
    workers: tuple[int, ...] | None = option("for loader: numbers of worker processes to measure with (0 2)", None)


def run(options: Options) -> int:
    """Measure, and write or print the figures."""
    _check(options)
    names = ("views", "mit", "workers")
    given = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    shown = [f"--{name} {_shown(value)}" for name, value in given.items()]
    shown += [f"--{name} {path}" for name in ("json", "figure") if (path := getattr(options, name)) is not None]
    origin = provenance(" ".join(["tools/bench", options.what, *shown]))  # before: files may change meanwhile
    module = importlib.import_module(f"bodyseg_data.benches.{options.what}")
    with Progress("measuring", "steps") as progress:
        figures: dict[str, Any] = getattr(module, f"bench_{options.what}")(progress=progress.update, **given)
    if options.json is None:
        sys.stdout.write(json.dumps(origin | figures, indent=1) + "\n")
    else:
        write_figures(options.json, origin | figures)
        sys.stderr.write(f"wrote {options.json}\n")
    if options.figure is not None:
        module = importlib.import_module(f"bodyseg_data.benches.{options.what}_figure")
        getattr(module, f"draw_{options.what}")(figures, options.figure)
        sys.stderr.write(f"wrote {options.figure}\n")
    return 0


def _shown(value: Any) -> str:
    """As on the command line; of a folder its name only, since the rest belongs to this machine."""
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(getattr(value, "name", value))


def _check(options: Options) -> None:
    bench = BENCHES[options.what]
    if options.figure is not None:
        if not bench.figure:
            raise BadConfig(f"bench {options.what} draws no figure: leave --figure out")
        check_picture(options.figure, "--figure")
        check_target(options.figure, "--figure")
    if options.json is not None:
        check_target(options.json, "--json")
    if options.views is not None and bench.views is None:
        raise BadConfig(f"bench {options.what} measures whole bodies: leave --views out")
    if options.mit is not None and not bench.mit:
        raise BadConfig(f"--mit is for bench {_WITH_MIT}, found it with bench {options.what}")
    if options.workers is not None and not bench.workers:
        raise BadConfig(f"--workers is for bench loader, found it with bench {options.what}")
