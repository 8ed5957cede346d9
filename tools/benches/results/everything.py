"""All steps that make docs/results: sets, trainings, results on accuracy, results on speed, the pages."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from benches.results.step import FINDER, LARGE, PLACES, RESULTS, SHIPPED, Graph, Step
from benches.results.trainings import (
    ABLATION_LINKS,
    ALEXNET_RUNS,
    BARE,
    BOX,
    BOX_LINKS,
    CANDIDATES,
    DRESSED,
    FULL_RUNS,
    HARD,
    KINECT_HARD,
    MAPPED,
    MAPPED_HARD,
    NETWORK_RUNS,
    OPEN,
    ORDINARY,
    OTHER_RUNS,
    PAPER,
    PAPER_RUNS,
    PLACED_RUNS,
    READ,
    REFERENCE_RUNS,
    SMALLER_LINKS,
    Links,
    seeds,
    sets,
    trainings,
)
from benches.results.trainings import KINECT as KINECT_SET

FAUST: Final = "data/faust"
KINECT: Final = "data/real/kinect_v1"
MIT: Final = "data/mit"
REAL: Final = "data/real"

PROCESSORS: Final = ("amd-epyc-2-cores", "amd-epyc-with-avx-512-2-cores", "intel-xeon-processor-with-amx-2-cores")
"""Those whose results are published, as `benches.charts.processors.folder_name` names them."""


def pages(results: Path) -> tuple[str, ...]:
    """Names of the pages of results in a folder: those with a template, NAME.in, beside them."""
    return tuple(sorted(path.name.removesuffix(".in") for path in results.glob("*.md.in")))


PAGES: Final = pages(Path(__file__).parents[3] / RESULTS)
"""The pages of this checkout."""

_ALL_SWEEPS: Final = ("--images", "25", "--threads", "1")


def everything() -> Graph:
    """The graph of `tools/bench all`."""
    steps = [*sets(), *trainings(), *_landmarks(), *_shipped(), *_trained(), *_stability(), *_speed(), *_by_processor()]
    names = [f"{RESULTS}/{name}" for step in steps for _, name in step.results]
    return Graph([*steps, _page(names)])


def _bench(name: str, *words: str, to: str = "", drawn: bool = False, more: tuple[str, ...] = (), **facts: Any) -> Step:
    """A step of `tools/bench NAME` that writes TO.json, and TO.png if it is `drawn`; more: pictures beside it."""
    to = to or name
    targets = ["--json", f"results/{to}.json", *(["--figure", f"results/{to}.png"] if drawn else [])]
    files = [f"{to}.json", *([f"{to}.png"] if drawn else []), *more]
    results = tuple((f"results/{file}", file) for file in files)
    return Step(to, "results", ("tools/bench", name, *words, *targets), results, **facts)


def _evaluation(name: str, data: str, *words: str, more: Links = ()) -> Step:
    """A step of `bodyseg evaluate` on the network that ships; it writes NAME.json. more: what else it makes."""
    command = ("bodyseg", "evaluate", "--data", data, "--json", f"results/{name}.json", *words)
    return Step(name, "results", command, ((f"results/{name}.json", f"{name}.json"), *more), reads=(SHIPPED,))


def _landmarks() -> Iterator[Step]:
    """Landmarks, labels and bodies, before any network."""
    yield _bench("proposal", "--mit", MIT)
    words = ("tools/landmarks", "--source", "open", "--meshes", "C-march-060")
    files = ("--propose", "results/march.json", "--out", "results/proposal.png")
    yield Step("proposal_picture", "results", (*words, *files), (("results/proposal.png", "proposal.png"),))
    yield _bench("borders", "--views", "12", drawn=True)
    yield _bench("clothes", "--mit", MIT)
    yield _bench("interpenetration", "--views", "5")
    yield _bench("everyday", "--views", "91")


def _shipped() -> Iterator[Step]:
    """The networks that ship, on the 936 test images of a tenth of `open`: packed in minutes, with few other bodies."""
    shipped = (SHIPPED,)
    figures, flip = ("--figures", "results/compact"), "--flip-average"
    yield _evaluation("compact", DRESSED, *figures, more=(("results/compact", "compact"),))
    yield _evaluation("compact_hard", HARD)
    yield _evaluation("compact_flip_average", DRESSED, flip)
    yield _evaluation("compact_hard_flip_average", HARD, flip)
    yield _bench("people", "--data", FAUST, reads=shipped)
    yield _bench("people", "--data", FAUST, "--alone", flip, to="people_flip_average", reads=shipped)
    both = ("--data", DRESSED, "--hard", HARD, "--people", FAUST)
    yield _bench("shipped", *both, reads=(*shipped, LARGE))
    yield _bench("real", "--data", KINECT, "--views", "24", drawn=True, reads=shipped)
    yield _bench("real", "--data", KINECT, "--views", "24", flip, to="real_flip_average", reads=shipped)
    yield _bench("steady", "--data", KINECT, reads=shipped)
    yield _bench("steady", "--data", KINECT, flip, to="steady_flip_average", reads=shipped)
    large = ("--runs", LARGE)
    yield _bench("people", "--data", FAUST, "--alone", *large, to="people_large")
    yield _bench("real", "--data", KINECT, "--views", "24", *large, to="real_large")
    yield _bench("limits", "--views", "200", *large, to="limits_large", reads=(FINDER,))
    yield _bench("sensors", "--views", "2", drawn=True, reads=shipped)
    yield _bench("joints", "--data", FAUST, reads=shipped)
    yield _bench("limits", "--views", "200", reads=(*shipped, FINDER))
    yield _bench("rooms", "--views", "480", "--data", REAL, drawn=True, reads=(*shipped, FINDER))
    yield _bench("windows", "--data", HARD, drawn=True, reads=shipped)
    yield _bench("gpu", "--data", OPEN, reads=shipped, alone=True, gpu=True)
    failures = ("--data", DRESSED, "--images", "1000", "--hard", HARD)
    yield _bench("failures", *failures, drawn=True, more=("failures_hard.png",), reads=shipped)
    mining = ("--data", CANDIDATES, "--runs", "runs/mining", "--ordinary", ORDINARY, "--hard", HARD, "--seeds", "2")
    yield _bench("mining", *mining, reads=shipped)


def _trained() -> Iterator[Step]:
    """Networks that were trained for the comparison."""
    scored, on_real = ("--images", "60", "--only-finished"), ("--real", REAL, "--people", FAUST)
    full = ("--data", KINECT_SET, "--runs", "runs/full", "--seeds", "3", *scored, "--hard", KINECT_HARD, *on_real)
    yield _bench("variants", *full, drawn=True, more=("variants_real.png",), alone=True)
    for of, count in (("paper", "3"), ("paper_alexnet", "2")):
        of_paper = ("--data", PAPER, "--runs", f"runs/{of}", "--seeds", count, *scored, "--hard", HARD, *on_real)
        yield _bench("variants", *of_paper, to=f"variants_{of}", alone=True)
    unlike = (*seeds("runs/full/none"), *seeds("runs/full/all"))
    yield _bench("harm", "--data", KINECT_SET, "--runs", *unlike, "--images", "60", reads=(SHIPPED,), alone=True)
    fine = ("--data", KINECT_SET, "--runs", "runs/fine", "--seeds", "2", *scored)
    yield _bench("variants", *fine, to="variants_fine", alone=True)
    yield _bench("cross_person", "--data", FAUST, "--runs", *PLACED_RUNS)
    folder = ("--runs", "runs/networks")
    yield _bench("architectures", "--data", OPEN, *folder, "--images", "200", alone=True)
    yield _bench("shuffles", "--data", OPEN)
    on_template = ("--data", MAPPED, "--hard", MAPPED_HARD, "--people", FAUST)
    yield _bench("dense", *on_template, "--views", "4", "--images", "100", drawn=True, reads=(SHIPPED, PLACES))
    smaller = ("--data", OPEN, "--runs", "runs/smaller", "--images", "200", "--forest", "0")
    yield _bench("architectures", *smaller, to="smaller", links=SMALLER_LINKS, alone=True)
    named = ("--data", OPEN, "--runs", "runs/networks/compact-0", "--hard", HARD)
    yield _bench("failures", *named, "--images", "500", to="failures_open")
    sets_read = ("--data", OPEN, "--hard", HARD, "--clothes", DRESSED, BARE)
    rows = ("--runs", "runs/ablation", "--images", "40")
    yield _bench("ablation", *sets_read, *rows, drawn=True, links=ABLATION_LINKS, alone=True)


def _speed() -> Iterator[Step]:
    """Measurements on one machine: methods side by side, each with its error."""
    yield _bench("occlusion", drawn=True, more=("occlusion_errors.png",), alone=True)
    yield _bench("quantisation", "--views", "40", alone=True)
    yield _bench("partition", "--mit", MIT, drawn=True, alone=True)
    yield _bench("reduction", "--views", "4", "--mit", MIT, drawn=True, alone=True)
    yield _bench("codec", drawn=True, alone=True)
    yield _bench("workers", "--views", "324", drawn=True, alone=True)
    yield _bench("open_data", alone=True)
    yield _bench("scaling", alone=True)
    yield _bench("cluster", alone=True)
    yield _bench("reading", "--data", READ, alone=True)
    yield _bench("cold", "--data", READ)
    yield _bench("far", alone=True)
    yield _bench("sensor_fit", drawn=True, alone=True)
    yield _bench("reliability")
    for to, source in (("packing", "open"), ("packing_hard", "hard")):
        yield _bench("packing", "--data", source, to=to, alone=True)


def _by_processor() -> Iterator[Step]:
    """Measurements that a processor decides, on each of `PROCESSORS`."""
    for processor in PROCESSORS:
        for name, words in {
            "loader": (),
            "network": ("--scores", f"{RESULTS}/compact.json"),
            "render": (),
            "runtimes": ("--data", OPEN, "--images", "200"),
            "segment": ("--views", "40"),
            "training": ("--data", OPEN),
        }.items():
            to = f"processors/{processor}/{name}"
            drawn = name != "training"
            reads = () if name in ("loader", "render") else (SHIPPED,)
            yield _bench(name, *words, to=to, drawn=drawn, reads=reads, alone=True, processor=processor)


def _stability() -> Iterator[Step]:
    """Robustness: accuracy under rising severity, in motion, in other arithmetic."""
    for to, run in (("numerical", "runs/paper/all-0"), ("numerical_fcn_alexnet", "runs/paper_alexnet/all-0")):
        yield _bench("numerical", "--data", PAPER, "--views", "25", "--runs", run, to=to)
    either = (*PAPER_RUNS, *ALEXNET_RUNS)
    yield _stability_of("stability", (*either, BOX), BOX_LINKS, data=PAPER, reference=ALEXNET_RUNS[:1])
    yield _bench("motion", "--data", PAPER, "--runs", *either, to="stability_motion")
    lost = ("noise", "missing", "patches", "stripes", "mixed", "speed", "clothes", "ambient")
    few = ("--sweeps", *lost, "--images", "20", "--threads", "1")
    others = (row for row in OTHER_RUNS if row != "mixture")  # has no harm of its own
    compared = (*FULL_RUNS, *itertools.chain(*(seeds(f"runs/full/{row}") for row in others)))
    yield _stability_of("variants_stability", compared, sweeps=few, data=KINECT_SET, drawn=True)
    yield _stability_of("stability_architectures", NETWORK_RUNS, reference=REFERENCE_RUNS)
    hidden = ("--sweeps", "hidden", "hidden_shown", "--images", "14", "--threads", "1")
    yield _stability_of("stability_hidden", (BOX,), BOX_LINKS, sweeps=hidden, data=DRESSED)
    cut = ("patches", "stripes", "crop_above", "crop_below")
    everyday = ("tilt", "turned", "desk", "kick", "fist", "mixed", "remnants")
    harms = ("--sweeps", *cut, *everyday, "--images", "20", "--threads", "1")
    both = ("compact", LARGE)
    yield _stability_of("stability_shipped", both, sweeps=harms, data=DRESSED, drawn=True, reads=(SHIPPED,))


def _stability_of(
    name: str,
    runs: tuple[str, ...],
    links: Links = (),
    sweeps: tuple[str, ...] = _ALL_SWEEPS,
    data: str = OPEN,
    drawn: bool = False,
    reference: tuple[str, ...] = (),
    reads: tuple[str, ...] = (),
) -> Step:
    """A step of `bodyseg stability`; with networks of reference beside hard poses, and with a picture."""
    out = f"stability/{name}"
    compared = ("--reference", *reference, "--hard", HARD) if reference else ()
    words = ("bodyseg", "stability", "--run", *runs, "--data", data, "--out", out, *compared, *sweeps)
    kinds = ("json", "png") if drawn or reference else ("json",)
    results = tuple((f"{out}/stability.{kind}", f"{name}.{kind}") for kind in kinds)
    return Step(name, "results", words, results, links, reads)


def _page(results: list[str]) -> Step:
    """Charts and pages of results, of all that is there, whether measured anew or not."""
    pages, charts = [f"{RESULTS}/{name}" for name in PAGES], f"{RESULTS}/charts"
    words = ("tools/chart", "--in", RESULTS, "--out", charts, "--page", *pages)
    products = ((charts, "charts"), *zip(pages, PAGES, strict=True))
    return Step("page", "page", words, products, reads=(*results, *(f"{page}.in" for page in pages)))
