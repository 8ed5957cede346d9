"""`tools/bench`: measure speed and accuracy side by side in one run."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from benches.charts.processors import FOLDER, folder_name
from benches.measuring import Conditions
from bodyseg_data.commands import Progress, check_target, flag_of, option, provenance
from bodyseg_data.core import BadConfig, check_int
from bodyseg_data.drawing import check_picture, new_chart
from bodyseg_data.files import make_folder, write_json
from bodyseg_data.machine import hardware

EXAMPLE = "tools/bench occlusion --json occlusion.json"


@dataclass(frozen=True)
class Bench:
    """A bench and its options.

    module: the one below `benches` whose `bench_NAME` measures. figure: the module beside it whose `draw_NAME` draws
    the results, if there is one. views: meaning of --views, and its default; None if the option is not taken.
    required, optional: names of further options. least: of its numbers, where that is not 1.
    """

    module: str
    figure: str | None = None
    views: str | None = None
    required: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()
    least: Mapping[str, int] = field(default_factory=dict)

    @property
    def accepted(self) -> tuple[str, ...]:
        """Names of all options that it accepts."""
        return (*(("views",) if self.views else ()), *self.required, *self.optional)


BENCHES: Final = {
    "occlusion": Bench("data.occlusion.bench", "figure", "views in all, 60"),
    "quantisation": Bench("data.occlusion.quantisation", None, "views of each step, 40"),
    "borders": Bench("data.surface.borders", "borders_figure", "views of each body, 12"),
    "partition": Bench("data.surface.partition", "partition_figure", optional=("mit",)),
    "reduction": Bench("data.surface.reduction", "reduction_figure", "views of each body, 4", optional=("mit",)),
    "render": Bench("data.render.bench", "figure", "views in all, 486"),
    "packing": Bench("data.render.packing", required=("data",), optional=("num_workers",)),
    "scaling": Bench("data.render.scaling", None, "views of each body, 54"),
    "cluster": Bench("data.render.cluster", None, "bodies of 54 views, 40", optional=("num_workers",)),
    "reading": Bench("data.reading.bench", required=("data",)),
    "cold": Bench("data.reading.cold_ranks", required=("data",)),
    "far": Bench("data.reading.far", None, "samples in all, 2016", optional=("data", "num_workers")),
    "interpenetration": Bench("data.surface.interpenetration", None, "one frame in how many, 5"),
    "everyday": Bench("model.failures.everyday", None, "bodies drawn, 130"),
    "clothes": Bench("data.surface.clothes", optional=("mit",)),
    "proposal": Bench("data.surface.proposal", optional=("mit",)),
    "reliability": Bench("fuzzing.bench", None, "hostile inputs in all, 100000"),
    "codec": Bench("data.codec.bench", "figure", "samples in all, 60"),
    "loader": Bench("data.loader.bench", "figure", "samples in all, 1080", optional=("num_workers",)),
    "open_data": Bench("data.open_data", None, "scenes, 60", optional=("num_workers",)),
    "workers": Bench("data.workers.bench", "figure", "samples in all, 540", optional=("num_workers",)),
    "variants": Bench(
        "model.variants.bench",
        "figure",
        required=("data", "runs"),
        optional=("seeds", "steps", "images", "only_finished", "real", "hard", "people", "together"),
    ),
    "network": Bench("model.networks.network", "network_figure", "typical frames, 12", optional=("runs", "scores")),
    "shipped": Bench("model.networks.shipped", required=("data", "hard", "people"), optional=("images",)),
    "runtimes": Bench(
        "model.networks.runtimes",
        "runtimes_figure",
        "typical frames, 3",
        required=("data",),
        optional=("runs", "images"),
    ),
    "numerical": Bench("model.networks.numerical", None, "test images, 25", required=("data",), optional=("runs",)),
    "sensors": Bench("model.networks.sensors", "sensors_figure", "bodies, 12", optional=("runs",)),
    "rooms": Bench("model.rooms.bench", "figure", "made rooms, 480", optional=("runs", "data")),
    "limits": Bench("model.rooms.limits", None, "made rooms to fit to, 200", optional=("runs",)),
    "segment": Bench("model.segment.bench", "figure", "made rooms of each size, 24"),
    "windows": Bench(
        "model.segment.windows", "windows_figure", "made rooms, 120", required=("data",), optional=("runs", "images")
    ),
    "people": Bench(
        "model.people.bench",
        None,
        "views of each body, 6",
        required=("data",),
        optional=("runs", "poses", "alone", "flip_average"),
    ),
    "cross_person": Bench(
        "model.people.cross_person", None, "views of each body, 6", required=("data", "runs"), optional=("poses",)
    ),
    "joints": Bench("model.people.joints", None, "bodies to fit to, 240", required=("data",), optional=("runs",)),
    "sensor_fit": Bench("model.sensor_fit.bench", "figure", "bodies, 1"),
    "architectures": Bench(
        "model.networks.architectures",
        None,
        "typical frames, 12",
        required=("data", "runs"),
        optional=("images", "forest"),
        least={"forest": 0},
    ),
    "ablation": Bench(
        "model.ablation.bench", "figure", required=("data", "runs"), optional=("images", "hard", "clothes")
    ),
    "real": Bench("model.real.bench", "figure", "frames, 50", required=("data",), optional=("runs", "flip_average")),
    "motion": Bench("model.motion", required=("data", "runs")),
    "steady": Bench(
        "model.real.steady",
        None,
        "frames, 100",
        required=("data",),
        optional=("runs", "flip_average"),
        least={"views": 2},
    ),
    "dense": Bench(
        "model.dense",
        "dense_figure",
        "views of each body, 6",
        required=("data",),
        optional=("runs", "images", "hard", "people"),
    ),
    "shuffles": Bench("model.shuffles", required=("data",), optional=("seeds", "steps", "images")),
    "harm": Bench("model.harm", required=("data",), optional=("runs", "images")),
    "training": Bench("model.training_speed", required=("data",), optional=("steps",), least={"steps": 4}),
    "gpu": Bench(
        "model.gpu",
        None,
        "samples of a pass, 2000",
        required=("data",),
        optional=("num_workers", "steps"),
        least={"steps": 4},
    ),
    "failures": Bench("model.failures.bench", "figure", required=("data",), optional=("runs", "images", "hard")),
    "mining": Bench(
        "model.failures.mining",
        None,
        required=("data", "runs", "ordinary"),
        optional=("hard", "seeds", "steps", "images"),
    ),
}
"""Name -> bench. Modules are imported when their bench runs."""

if TYPE_CHECKING:
    BenchName = str
else:
    BenchName = Literal[tuple(BENCHES)]

_COUNTS: Final = "; ".join(f"{name}: {bench.views}" for name, bench in BENCHES.items() if bench.views)


def _takers(name: str) -> str:
    """Names of the benches that accept an option, for its help text."""
    return ", ".join(bench for bench, facts in BENCHES.items() if name in facts.accepted)


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    what: BenchName = option("what to measure", positional=True)
    json: Path | None = option("write the figures to this file (default: print them)", None)
    figure: Path | None = option("also draw what was measured to this PNG file", None)
    results: Path | None = option(
        "folder of results: write figures and picture to processors/PROCESSOR/ there, as BENCH.json and BENCH.png",
        None,
    )
    views: int | None = option(f"size of the measurement (with its default: {_COUNTS})", None)
    mit: Path | None = option(f"for {_takers('mit')}: folder of MIT frames to measure on as well", None)
    num_workers: tuple[int, ...] | None = option(
        "numbers of workers to measure with (default: loader and open_data 0 2, workers 0 2 4, cluster 1 2 4, "
        "packing 2, gpu 0 8 16)",
        None,
    )
    data: str | None = option(
        f"for {_takers('data')}: folder or address of the set; for packing the name of a source", None, address=True
    )
    runs: tuple[Path, ...] | None = option(
        "for variants: folder of runs VARIANT-SEED, where missing ones are trained, and folders of others to compare "
        "on real frames; for architectures and ablation: folders of runs NAME-SEED; for motion: runs, all of them; "
        "for cross_person: a run for each person; for mining: folder of the trainings, which are made where they are "
        "missing; for rooms: a finder that never saw the unseen kinds; for network, "
        "runtimes, numerical, sensors, harm, dense, limits, windows, people, joints, real, steady and failures: runs",
        None,
    )
    seeds: int | None = option(
        "for variants, shuffles and mining: trainings of each variant, order or choice (default 3; mining 1)", None
    )
    steps: int | None = option(
        "steps of each training, for variants (default: that of the runs that exist, else the recipe's), shuffles "
        "(240), mining (80), training (60) and gpu (80)",
        None,
    )
    images: int | None = option(
        "number of test images (default: variants 500, architectures, runtimes and ablation 200, windows 300, "
        "dense 150, shuffles 500, harm 100, mining 400, failures 1000)",
        None,
    )
    hard: str | None = option(
        f"for {_takers('hard')}: folder or address of a set of the source `hard`, to test on as well",
        None,
        address=True,
    )
    ordinary: str | None = option(
        f"for {_takers('ordinary')}: folder or address of a set whose images are trained on beside those of --data",
        None,
        address=True,
    )
    clothes: tuple[str, ...] | None = option(
        "for ablation: two sets of the same views, of dressed bodies and of bare ones", None, address=True
    )
    forest: int | None = option(
        "for architectures: number of training images of a random forest (default 2000; 0: no forest)", None
    )
    poses: int | None = option(
        f"for {_takers('poses')}: meshes of each person in a folder without sub-folders, in the order of names "
        "(default 10)",
        None,
    )
    only_finished: bool = option("for variants: train nothing, compare what there is", False)
    real: Path | None = option("for variants: folder of recordings of real frames, to test on as well", None)
    people: Path | None = option(
        f"for {_takers('people')}: folder of scanned people with landmarks, to test on as well", None
    )
    together: int | None = option("for variants: processes that score networks side by side (default 1)", None)
    alone: bool = option("for people: scores alone, no landmarks", False)
    flip_average: bool = option("for people, real and steady: average the answers to images and mirror images", False)
    scores: tuple[Path, ...] | None = option(
        "for network: JSON files of `bodyseg evaluate` on `all`, for the accuracies", None
    )


_COUNTED: Final = ("views", "seeds", "steps", "images", "forest", "poses", "together")
"""Options that are whole numbers."""

_OF_ALL: Final = ("what", "json", "figure", "results")
"""Options that all benches accept."""

_FLAGS: Final = {each.name: flag_of(each) for each in fields(Options)}


def run(options: Options) -> int:
    """Measure, and write or print the figures."""
    _check(options)
    bench = BENCHES[options.what]
    json_file, picture = _targets(options)
    given = {name: value for name in bench.accepted if _is_given(value := getattr(options, name))}
    shown = [f"{_FLAGS[name]} {_shown(value)}".removesuffix(" True") for name, value in given.items()]
    shown += [f"{_FLAGS[name]} {path}" for name in ("json", "figure", "results") if (path := getattr(options, name))]
    origin = provenance(" ".join(["tools/bench", options.what, *shown]))  # before: files may change meanwhile
    conditions = Conditions()
    measuring = importlib.import_module(f"benches.{bench.module}")
    with Progress("measuring", "steps") as progress:
        figures: dict[str, Any] = getattr(measuring, f"bench_{options.what}")(progress=progress.update, **given)
    record = {**origin, **conditions.to_json(), **figures}
    if json_file is None:
        sys.stdout.write(json.dumps(record, indent=1) + "\n")
    else:
        write_json(json_file, record)
        sys.stderr.write(f"wrote {json_file}\n")
    if picture is not None:
        drawing = importlib.import_module(f"benches.{bench.module.rpartition('.')[0]}.{bench.figure}")
        getattr(drawing, f"draw_{options.what}")(figures, picture)
        sys.stderr.write(f"wrote {picture}\n")
    return 0


def _targets(options: Options) -> tuple[Path | None, Path | None]:
    """Files for the figures and for the picture; None: printed, or not drawn."""
    if options.results is None:
        return options.json, options.figure
    folder = options.results / FOLDER / folder_name(hardware())
    drawn = BENCHES[options.what].figure is not None
    return folder / f"{options.what}.json", folder / f"{options.what}.png" if drawn else None


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
    if options.results is not None:
        if options.json is not None or options.figure is not None:
            raise BadConfig("--results names both files: leave --json and --figure out")
        if not options.results.is_dir():
            raise BadConfig(f"--results must be a folder, found {options.results}")
        make_folder(options.results / FOLDER / folder_name(hardware()))
    if options.figure is not None:
        if bench.figure is None:
            raise BadConfig(f"bench {options.what} draws no figure: leave --figure out")
        check_picture(options.figure, "--figure")
        check_target(options.figure, "--figure")
    if _targets(options)[1] is not None:
        new_chart(1, 1)  # what cannot be drawn should not be found out after hours
    if options.json is not None:
        check_target(options.json, "--json")
    for name in (each.name for each in fields(options)):
        if name in (*_OF_ALL, *bench.accepted) or not _is_given(getattr(options, name)):
            continue
        if name == "views" and not bench.module.startswith("model."):
            raise BadConfig(f"bench {options.what} measures whole bodies: leave --views out")
        raise BadConfig(f"{_FLAGS[name]} is for bench {_takers(name)}, found it with bench {options.what}")
    for name in _COUNTED:
        if (value := getattr(options, name)) is not None:
            check_int(_FLAGS[name], value, bench.least.get(name, 1))
    for name in bench.required:
        if not _is_given(getattr(options, name)):
            raise BadConfig(f"bench {options.what} needs {_FLAGS[name]}")
