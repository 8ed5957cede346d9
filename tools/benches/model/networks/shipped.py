"""`bench shipped`: the networks that ship, with and without flip averaging: accuracy on people against time.

Between them stands averaging where it may help: of the half of the images that a network is less sure of.
"""

from __future__ import annotations

import statistics
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from benches.model.chosen import parameters
from benches.model.networks.network_frames import typical_frames
from benches.model.networks.network_times import Cell, Precision, timed
from benches.model.people.bodies import annotated_bodies
from benches.model.people.scores import accuracy, answer_to, packed_views, together
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.machine import processors
from bodyseg_model.evaluation import GrossErrors, evaluate, open_images
from bodyseg_model.evaluation.evaluation import PredictedImage
from bodyseg_model.networks import SHIPPED, FlipAverage, Network, load_network
from bodyseg_model.networks.checkpoints import LARGE
from bodyseg_model.runtimes import on_backend

FLIP: Final = ", flip average"
UNSURE: Final = ", flip average where unsure"
_PEOPLE_VIEWS: Final = 6
_POSES: Final = 10
_FRAMES: Final = 3


class Answer(NamedTuple):
    """To one image: int64 [33, 33] true and predicted parts of its pixels, gross errors, mean confidence."""

    counts: NDArray[np.int64]
    errors: GrossErrors
    confidence: float


def bench_shipped(
    data: str, hard: str, people: Path, images: int | None = None, progress: ProgressCallback = silent
) -> dict[str, Any]:
    """Score and time both networks, plain, with the flip average, and with it where they are unsure.

    data, hard: sets whose test images are taken, in variant `all`; images: the first so many of each, None for all.
    people: folder of annotated meshes, as of `bench_people`. ms: of all of `predict` on a whole frame of the paper's
    rig, all threads, float32 and bfloat16; of what averages where it is unsure, by the share of people's images that
    it averages. Raises as `bench_people`, `open_images` and `typical_frames`.
    """
    plain: dict[str, Network] = {file.stem: load_network(file).network for file in (SHIPPED, LARGE)}
    networks = plain | {name + FLIP: FlipAverage(network) for name, network in plain.items()}
    with tempfile.TemporaryDirectory() as folder:
        packed_views(annotated_bodies(people, _POSES), _PEOPLE_VIEWS, Path(folder))
        sets = {"open": data, "hard": hard, "people": str(Path(folder) / "set")}
        answers: dict[str, dict[str, list[Answer]]] = {}
        for done, (name, network) in enumerate(networks.items()):
            answers[name] = {test: _answers(network, path, images) for test, path in sets.items()}
            progress(done + 1, len(networks) + 1)
    times = _times(networks)
    ms = {name: {precision: found[name]["ms"] for precision, found in times.items()} for name in networks}
    rows: dict[str, Any] = {}
    for name, network in plain.items():
        least = statistics.median(one.confidence for one in answers[name]["open"])
        once, twice = answers[name], answers[name + FLIP]
        chosen = {test: where_unsure(once[test], twice[test], least) for test in sets}
        shares = {test: statistics.fmean(one.confidence < least for one in once[test]) for test in sets}
        facts = {"parameters": parameters(network)}
        rows[name] = {"default": name == SHIPPED.stem, **facts, "ms": ms[name], **_scores(once)}
        between = {
            precision: round(one + shares["people"] * (ms[name + FLIP][precision] - one), 3)
            for precision, one in ms[name].items()
        }
        averaged = {test: round(share, 4) for test, share in shares.items()}
        rows[name + UNSURE] = {"default": False, **facts, "ms": between, **_scores(chosen), "averaged": averaged}
        rows[name + FLIP] = {"default": False, **facts, "ms": ms[name + FLIP], **_scores(twice)}
    return {"networks": rows, "times": times, "images": {test: len(one) for test, one in answers[SHIPPED.stem].items()}}


def _answers(network: Network, path: str, count: int | None) -> list[Answer]:
    found: list[Answer] = []

    def watch(image: PredictedImage, _: float) -> None:
        found.append(Answer(*answer_to(image), float(image.confidence[image.range_m > 0].mean())))

    evaluate(network, open_images(path, "all"), count, watch=watch)
    return found


def where_unsure(once: Sequence[Answer], twice: Sequence[Answer], least: float) -> list[Answer]:
    """Answers to images, those of `twice` where the mean confidence of `once` is below `least`."""
    return [second if first.confidence < least else first for first, second in zip(once, twice, strict=True)]


def _scores(by_test: Mapping[str, Sequence[Answer]]) -> dict[str, Any]:
    """Average per-class accuracy and gross errors of each test."""
    found = {}
    for test, answers in by_test.items():
        counts = np.sum([one.counts for one in answers], axis=0)
        errors = together(one.errors for one in answers)
        found[test] = {"accuracy": round(accuracy(counts), 4), "gross_errors": errors}
    return found


def _times(networks: Mapping[str, Network]) -> dict[str, dict[str, Any]]:
    """Precision -> network -> its times."""
    frames, quick = typical_frames(_FRAMES), {name: on_backend(network) for name, network in networks.items()}
    cells = {precision: Cell("typical", "labels", "cpu", processors(), precision) for precision in get_args(Precision)}
    return {name: timed(cell, quick, frames, SHIPPED.stem)["networks"] for name, cell in cells.items()}
