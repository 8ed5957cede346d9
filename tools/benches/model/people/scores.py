"""Scores of a network on views of people, by person and pose, with intervals."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.model.people.bodies import Annotated
from benches.model.people.intervals import interval, summed
from bodyseg_data.bodies import open_source
from bodyseg_data.core import ProgressCallback
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.meshes.landmarks import LANDMARKS_FORMAT
from bodyseg_data.packing import Packing, pack
from bodyseg_data.packing.sampler import body_key
from bodyseg_data.rigs import Rig, load_rig
from bodyseg_data.samples import ViewGrid, split_key
from bodyseg_model.evaluation import ConfusionMatrix, GrossErrors, count_pairs, evaluate, open_images, pairs_of
from bodyseg_model.evaluation.evaluation import PredictedImage
from bodyseg_model.networks import Network

VARIANTS: Final = ("all", "none")

_SOURCE: Final = "folder"
_SPAN_DEG: Final = 360
_AZIMUTHS: Final = 36

Counts = NDArray[np.int64]
Key = tuple[str, str, str]
"""Person, pose and key of an image."""


def packed_views(bodies: Sequence[Annotated], views: int, folder: Path, rig: Rig | None = None) -> dict[str, Annotated]:
    """Pack test images of the bodies, from all round, into `folder`/set; returns the beginning of keys -> body.

    rig: by default the paper's. Raises the errors of `pack`.
    """
    meshes = folder / "meshes"
    by_file: dict[str, Annotated] = {}
    for number, body in enumerate(bodies):
        home = meshes / "test" / f"p{number:03d}"
        home.mkdir(parents=True)
        suffixes = "".join(body.path.suffixes[-2:] if body.path.suffix == ".gz" else body.path.suffixes[-1:])
        (home / f"body{suffixes}").symlink_to(body.path.resolve())
        points = dict(zip(LANDMARKS, body.points.tolist(), strict=True))
        table = {"format": LANDMARKS_FORMAT, "units": "m", "points": points}
        (home / "body.json").write_text(json.dumps(table), encoding="utf-8")
        by_file[home.name] = body
    grid = ViewGrid(azimuths=_AZIMUTHS, span_deg=_SPAN_DEG, count=views)
    packing = Packing(_SOURCE, path=meshes, units="m", up="y", views=grid, rig=rig or load_rig())
    with ThreadPoolExecutor(1) as executor:
        pack(packing, folder / "set", executor, 1)
    listed = open_source(_SOURCE, meshes, None, "m", "y").bodies()
    return {body_key(_SOURCE, ref): by_file[ref.subject] for ref in listed}


@dataclass(frozen=True)
class Counted:
    """Answers of a network. counts: int64 [33, 33] of each image; errors: its gross errors.

    calibration_error: of all images; None: unknown.
    """

    counts: dict[Key, Counts]
    errors: dict[Key, GrossErrors]
    calibration_error: float | None = None

    def of(self, people: Collection[str]) -> Counted:
        """The images of some people."""
        return Counted(
            {key: one for key, one in self.counts.items() if key[0] in people},
            {key: one for key, one in self.errors.items() if key[0] in people},
        )

    def to_json(self) -> dict[str, Any]:
        """Scores of all images."""
        errors = {"calibration_error": self.calibration_error, "gross_errors": gross_errors([self])}
        return summary(self.counts) | errors


def gross_errors(several: Iterable[Counted]) -> dict[str, float] | None:
    """Gross errors of all images together, as `GrossErrors.to_json`."""
    return together(one for counted in several for one in counted.errors.values())


def together(several: Iterable[GrossErrors]) -> dict[str, float] | None:
    """Gross errors of images, of all together, as `GrossErrors.to_json`."""
    total = GrossErrors()
    for errors in several:
        total.merge(errors)
    return total.to_json()


def answer_to(image: PredictedImage) -> tuple[Counts, GrossErrors]:
    """True and predicted parts of an image's pixels, int64 [33, 33], and its gross errors, if its surface is known."""
    counts, errors = count_pairs(pairs_of(image.labels, image.predicted)), GrossErrors()
    if image.away is not None:
        errors.add(image.away, int(counts.trace()))
    return counts, errors


def counted(
    network: Network, folder: Path, bodies: Mapping[str, Annotated], variant: str, progress: ProgressCallback
) -> Counted:
    """Count a network's answers to one variant of the packed views."""
    counts: dict[Key, Counts] = {}
    errors: dict[Key, GrossErrors] = {}

    def watch(image: PredictedImage, accuracy: float) -> None:
        if not math.isnan(accuracy):
            body = bodies[split_key(image.key)[0]]
            key = body.person, body.pose, image.key
            counts[key], errors[key] = answer_to(image)

    images = open_images(str(folder / "set"), variant)
    total = evaluate(network, images, progress=progress, watch=watch).total()
    calibration = None if total.confidences is None else _rounded(total.confidences.ece())
    return Counted(counts, errors, calibration)


def scored(
    network: Network, folder: Path, bodies: Mapping[str, Annotated], progress: ProgressCallback
) -> dict[str, Any]:
    """Scores of every variant of the packed views."""
    results: dict[str, Any] = {}
    for number, variant in enumerate(VARIANTS):

        def show(done: int, total: int, before: int = number) -> None:
            progress(before * total + done, len(VARIANTS) * total)

        results[variant] = counted(network, folder, bodies, variant, show).to_json()
    return results


def agreement(true: Path, other: Path, bodies: dict[str, Annotated]) -> dict[str, Any]:
    """Scores of the labels of one folder's views by those of another's, which show the same pixels (`packed_views`)."""
    truth, found = (open_images(str(folder / "set"), "none") for folder in (true, other))
    counts: dict[Key, Counts] = {}
    for index, key in enumerate(truth.keys):
        body = bodies[split_key(key)[0]]
        labels, others = (images.clean(index).labels for images in (truth, found))
        counts[body.person, body.pose, key] = count_pairs(pairs_of(labels, others))
    return summary(counts)


def summary(counts: Mapping[Key, Counts]) -> dict[str, Any]:
    """Average per-class accuracy of all images, with the interval that drawing poses gives, with all who took them.

    counts: int64 [33, 33] of each image.
    """
    poses = list(summed(counts, lambda key: str(key[1])).values())
    total = accuracy(np.sum(poses, axis=0)) if poses else float("nan")
    return {"images": len(counts), "accuracy": _rounded(total), "interval": interval(poses, accuracy)}


def accuracy(counts: NDArray[Any]) -> float:
    """Average per-class accuracy of counts [33, 33]."""
    matrix = ConfusionMatrix()
    matrix.counts = counts
    return matrix.average_per_class_accuracy()


def _rounded(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 4)
