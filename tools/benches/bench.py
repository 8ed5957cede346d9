"""`bodyseg bench`: measure speed and accuracy side by side in one run."""

from __future__ import annotations

import importlib
import json
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, Literal

from bodyseg_data.core.provenance import check_target, provenance, write_figures
from bodyseg_data.commands.progress import Progress
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.commands.options import option
from bodyseg_data.drawing.style import check_picture, new_chart

EXAMPLE = "bodyseg bench occlusion --json occlusion.json"


@dataclass(frozen=True)
class Bench:
    """What a bench takes. views: what --views counts, and its default; None if it measures whole bodies. figure:
    whether it draws one. needs, also: further options that it must and may be given. package: where its modules are.
    """

    views: str | None = None
    figure: bool = False
    needs: tuple[str, ...] = ()
    also: tuple[str, ...] = ()
    package: str = "benches.data"

    @property
    def takes(self) -> tuple[str, ...]:
        """The options that it is called with, where they are given."""
        return (*(("views",) if self.views else ()), *self.needs, *self.also)


_OF_NETWORKS: Final = "benches.model"  # by name alone: nothing here imports a network until one is measured

BENCHES: Final = {
    "occlusion": Bench("views in all, 60", figure=True),
    "borders": Bench("views of each body, 12", figure=True),
    "partition": Bench(figure=True, also=("mit",)),
    "reduction": Bench("views of each body, 4", figure=True, also=("mit",)),
    "render": Bench("views in all, 486", figure=True),
    "scaling": Bench("views of each body, 54"),
    "interpenetration": Bench("one frame in how many, 5"),
    "clothes": Bench(also=("mit",)),
    "proposal": Bench(also=("mit",)),
    "reliability": Bench("hostile inputs in all, 100000"),
    "codec": Bench("samples in all, 60", figure=True),
    "loader": Bench("samples in all, 1080", figure=True, also=("workers",)),
    "variants": Bench(
        figure=True, needs=("data", "runs"), also=("seeds", "steps", "images", "alone"), package=_OF_NETWORKS
    ),
    "network": Bench("typical frames, 12", figure=True, also=("runs", "scores"), package=_OF_NETWORKS),
    "sensors": Bench("bodies, 12", figure=True, also=("runs",), package=_OF_NETWORKS),
    "architectures": Bench(
        "typical frames, 12", needs=("data", "runs"), also=("images", "forest"), package=_OF_NETWORKS
    ),
    "ablation": Bench(figure=True, needs=("data", "runs"), also=("images", "hard", "clothes"), package=_OF_NETWORKS),
    "failures": Bench(figure=True, needs=("data",), also=("runs", "images", "hard"), package=_OF_NETWORKS),
}
"""Name -> what it takes. `PACKAGE/NAME.py` measures by its `bench_NAME`, `PACKAGE/NAME_figure.py` draws."""

_COUNTS: Final = "; ".join(f"{name}: {bench.views}" for name, bench in BENCHES.items() if bench.views)


def _takers(name: str) -> str:
    """The benches that take an option."""
    return ", ".join(bench for bench, takes in BENCHES.items() if name in takes.takes)


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
        "variants",
        "network",
        "sensors",
        "architectures",
        "ablation",
        "failures",
    ] = option("what to measure", positional=True)
    json: Path | None = option("write the figures to this file (default: print them)", None)
    figure: Path | None = option("also draw what was measured to this PNG file", None)
    views: int | None = option(f"how much to measure on ({_COUNTS})", None)
    mit: Path | None = option(f"for {_takers('mit')}: folder of MIT frames to measure on as well", None)
    workers: tuple[int, ...] | None = option("for loader: numbers of worker processes to measure with (0 2)", None)
    data: str | None = option(f"for {_takers('data')}: folder or address of the set", None)
    runs: tuple[Path, ...] | None = option(
        "for variants: folder of the trainings, VARIANT-SEED each, where missing ones are made; for architectures and "
        "ablation: folder of the trainings, NAME-SEED each; for the others: trained networks",
        None,
    )
    seeds: int | None = option("for variants: trainings of each variant (3)", None)
    steps: int | None = option("for variants: steps of each training (those there, else the recipe's)", None)
    images: int | None = option("test images (variants 500, architectures and ablation 200, failures 1000)", None)
    hard: str | None = option(f"for {_takers('hard')}: a set of the source hard to test on as well", None)
    clothes: tuple[str, ...] | None = option("for ablation: two sets alike, of dressed bodies and of bare ones", None)
    forest: int | None = option("for architectures: training images of a forest to compare with (0: none)", None)
    alone: bool = option("for variants: also sweep noise and missing data without the other artifacts", False)
    scores: tuple[Path, ...] | None = option("for network: results of bodyseg evaluate on `all` to take over", None)


def run(options: Options) -> int:
    """Measure, and write or print the figures."""
    _check(options)
    bench = BENCHES[options.what]
    given = {name: value for name in bench.takes if _is_given(value := getattr(options, name))}
    shown = [f"--{name} {_shown(value)}".removesuffix(" True") for name, value in given.items()]
    shown += [f"--{name} {path}" for name in ("json", "figure") if (path := getattr(options, name)) is not None]
    origin = provenance(" ".join(["tools/bench", options.what, *shown]))  # before: files may change meanwhile
    module = importlib.import_module(f"{bench.package}.{options.what}")
    with Progress("measuring", "steps") as progress:
        figures: dict[str, Any] = getattr(module, f"bench_{options.what}")(progress=progress.update, **given)
    if options.json is None:
        sys.stdout.write(json.dumps(origin | figures, indent=1) + "\n")
    else:
        write_figures(options.json, origin | figures)
        sys.stderr.write(f"wrote {options.json}\n")
    if options.figure is not None:
        module = importlib.import_module(f"{bench.package}.{options.what}_figure")
        getattr(module, f"draw_{options.what}")(figures, options.figure)
        sys.stderr.write(f"wrote {options.figure}\n")
    return 0


def _is_given(value: Any) -> bool:
    return value is not None and value is not False


def _shown(value: Any) -> str:
    """As on the command line; of a folder its name only, since the rest belongs to this machine."""
    if isinstance(value, tuple):
        return " ".join(map(_shown, value))
    if isinstance(value, str) and "://" not in value:
        value = Path(value)
    return str(getattr(value, "name", value))


def _check(options: Options) -> None:
    bench = BENCHES[options.what]
    if options.figure is not None:
        if not bench.figure:
            raise BadConfig(f"bench {options.what} draws no figure: leave --figure out")
        check_picture(options.figure, "--figure")
        check_target(options.figure, "--figure")
        new_chart(1, 1)  # what cannot be drawn should not be found out after hours
    if options.json is not None:
        check_target(options.json, "--json")
    for name in (field.name for field in fields(options)):
        if name in ("what", "json", "figure") or not _is_given(getattr(options, name)) or name in bench.takes:
            continue
        if name == "views" and bench.package != _OF_NETWORKS:
            raise BadConfig(f"bench {options.what} measures whole bodies: leave --views out")
        raise BadConfig(f"--{name} is for bench {_takers(name)}, found it with bench {options.what}")
    for name in bench.needs:
        if not _is_given(getattr(options, name)):
            raise BadConfig(f"bench {options.what} needs --{name}")
