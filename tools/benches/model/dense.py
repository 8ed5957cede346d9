"""`bench dense`: how far along the body's surface a network's points of the template are from the true ones.

On rendered views, every pixel's true point is known (the column `template`). On real people it is known where a
landmark was annotated that the open body has, too: as far as both were placed alike. For landmarks without a place on
the template, the answers to two views of one body are compared with each other.
"""

from __future__ import annotations

import itertools
import json
import tempfile
import time
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

from benches.landmarks.fitting_body import fitting_body
from benches.measuring import Figures, counter
from benches.model.chosen import chosen_network
from benches.model.people.bodies import TABLE_SUFFIX, Annotated, annotated_bodies
from benches.model.people.scores import packed_views
from bodyseg_data import RangeImages, load_template
from bodyseg_data.bodies import open_source
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.labels import BACKGROUND, LANDMARKS, NOWHERE, TEMPLATE
from bodyseg_data.meshes import vertex_normals
from bodyseg_data.rigs import load_rig
from bodyseg_data.samples import View, split_key
from bodyseg_model.evaluation import ConfusionMatrix
from bodyseg_model.networks import Network, load_network, predict
from bodyseg_model.networks.registry import Prediction, predict_dense

VARIANTS: Final = ("all", "none")
FAR_MM: Final = 100
"""Errors beyond are on another part of the body."""

_REACH_M: Final = 0.03  # of the graph of points, of which each has then some 20 neighbours
_SAME_SIDE: Final = 0.3  # least cosine between normals of neighbours: else a path leaps from finger to finger
_PIXELS: Final = 50  # of an image that are measured
_SEEN_M: Final = 0.02  # a landmark is seen where the image's range is its own within so much
_SHOWN: Final = 3
_TIMED: Final = 40
_POSES: Final = 10
_TOGETHER: Final = 256  # sources of one search


class Shown(NamedTuple):
    """An image to draw: range, metres, and points of the template, true ones None where unknown, all [H, W]."""

    where: str
    range_m: NDArray[np.float32]
    truth: NDArray[np.uint16] | None
    found: NDArray[np.uint16]


def bench_dense(
    data: str,
    runs: Sequence[Path] = (),
    images: int = 150,
    hard: str | None = None,
    people: Path | None = None,
    views: int = 6,
    progress: ProgressCallback = silent,
) -> Figures:
    """Measure networks, of which some tell places on the template, on test images with the column `template`.

    data, hard: sets with that column; images: of each, evenly; hard: None for none. people: folder of annotated bodies
    (`annotated_bodies`), None for none; views: of each. runs: trainings; without, the shipped network. Errors are
    distances along the template between true and found points, mm. Raises BadConfig for sets without the column, and
    as `load_network` and `pack`. Shown: images to draw, with the answers of the last network that gives any.
    """
    networks = dict(chosen_network([run]) for run in runs) if runs else {"shipped": load_network(dense=True)}
    sets = {name: address for name, address in (("open", data), ("hard", hard)) if address is not None}
    opened = {
        (name, variant): RangeImages(address, variant, "test", planes=[TEMPLATE])
        for name, address in sets.items()
        for variant in VARIANTS
    }
    rows_of: dict[str, dict[str, Any]] = {name: {} for name in networks}
    pictures: list[Shown] = []
    with tempfile.TemporaryDirectory() as folder:
        bodies = annotated_bodies(people, _POSES) if people else []
        tick = counter(progress, len(networks) * (len(opened) * images + len(VARIANTS) * views * len(bodies)))
        seen = _landmark_views(bodies, views, Path(folder)) if bodies else {}
        for name, trained in networks.items():
            rows = rows_of[name]
            if trained.network.on_template:
                pictures = []
            for (of_set, variant), shown in opened.items():
                rows.setdefault(of_set, {})[variant] = _on_set(trained.network, shown, images, of_set, pictures, tick)
            if trained.network.on_template:
                rows["times_as_long"] = _times_as_long(trained.network, next(iter(opened.values())))
            for variant, found in seen.items():
                rows.setdefault("people", {})[variant] = _on_people(trained.network, found, pictures, tick)
    return Figures({"networks": rows_of}, pictures)


def _on_set(
    network: Network, images: RangeImages, count: int, where: str, pictures: list[Shown], tick: Any
) -> dict[str, Any]:
    """Accuracy of labels, and errors of points, on test images spread evenly over a set."""
    matrix, pairs = ConfusionMatrix(network.classes), []
    chosen = images.evenly_sampled(count)
    for index in chosen.tolist():
        item = images[0, index]
        prediction, numbers = _answer(network, item["range"])
        labels, true = item["labels"].numpy(), item["planes"][TEMPLATE].numpy()
        body = labels < BACKGROUND - 1
        matrix.add(labels, np.where(body, prediction.labels[0].numpy(), BACKGROUND))
        if numbers is not None:
            at = np.flatnonzero(body & (true != NOWHERE) & (numbers != NOWHERE))
            at = at[np.linspace(0, len(at) - 1, min(len(at), _PIXELS)).astype(np.intp)]
            pairs.append(np.stack([true.ravel()[at], numbers.ravel()[at]]))
            if images.variant == VARIANTS[0] and index in chosen[:: -(-len(chosen) // _SHOWN)]:
                _keep(pictures, Shown(where, item["range"][0].numpy(), np.where(body, true, NOWHERE), numbers))
        tick()
    found = {"images": len(chosen), "accuracy": round(matrix.average_per_class_accuracy(), 4)}
    return found | ({"geodesic_mm": summary(along_template(*np.concatenate(pairs, axis=1)))} if pairs else {})


def _keep(pictures: list[Shown], shown: Shown) -> None:
    if sum(each.where == shown.where for each in pictures) < _SHOWN:
        pictures.append(shown)


def _answer(network: Network, range_m: torch.Tensor) -> tuple[Prediction, NDArray[np.uint16] | None]:
    if not network.on_template:
        return predict(network, range_m[None]), None
    prediction, numbers = predict_dense(network, range_m[None], by_part=True)
    return prediction, numbers[0]


def _times_as_long(network: Network, images: RangeImages) -> float:
    """Processor time of labels and points over that of labels alone, median over test images; of a frame, in which
    people are found, it is less.
    """
    shares = []
    for index in [*images.evenly_sampled(_TIMED).tolist()] * 2:  # the first pass loads compiled loops
        range_m = images[0, index]["range"][None]
        times = []
        for answer in (predict, partial(predict_dense, by_part=True)):
            start = time.process_time()
            answer(network, range_m)
            times.append(time.process_time() - start)
        shares.append(times[1] / times[0])
    return round(float(np.median(shares[len(shares) // 2 :])), 2)


class _Seen(NamedTuple):
    """A view of an annotated body: which of the body's landmarks are seen, by name, at which pixel."""

    body: Annotated
    range_m: torch.Tensor
    labels: NDArray[np.uint8]
    pixels: dict[str, int]


def _landmark_views(bodies: Sequence[Annotated], views: int, folder: Path) -> dict[str, list[_Seen]]:
    """Views of annotated bodies with all landmarks that are seen in each, those of the file beyond the 33, too."""
    by_key, rig = packed_views(bodies, views, folder), load_rig()
    source = open_source("folder", folder / "meshes", None, "m", "y")
    meshes = {ref.subject: source.build(ref).mesh for ref in source.bodies()}
    seen: dict[str, list[_Seen]] = {}
    for variant, images in ((name, RangeImages(folder / "set", name, "test")) for name in VARIANTS):
        for index, key in enumerate(images.keys):
            item, facts = images[0, index], images.describe(index)
            body, mesh = by_key[split_key(key)[0]], meshes[facts["subject"]]
            table = _landmarks(body)
            camera, _ = rig.placed(mesh.centre, View(facts["distance_cm"], facts["azimuth_deg"]))
            moved = mesh.vertices.mean(axis=0) - body.mesh.vertices.mean(axis=0)
            places, ranges = camera.project(np.array([*table.values()]) + moved)
            stored, pixels = images.clean(index).range * images.step_m, {}
            for landmark, (x, y), far in zip(table, places, ranges, strict=True):
                at = int(y), int(x)
                inside = 0 <= at[0] < stored.shape[0] and 0 <= at[1] < stored.shape[1]
                if inside and abs(stored[at] - far) < _SEEN_M and item["range"][0][at] > 0:
                    pixels[landmark] = at[0] * stored.shape[1] + at[1]
            labels = item["labels"].numpy()
            seen.setdefault(variant, []).append(_Seen(body, item["range"], labels, pixels))
    return seen


def _landmarks(body: Annotated) -> dict[str, Any]:
    """All landmarks of a body's table of coordinates, or the 33 of a file of another kind: name -> [3], metres."""
    table = body.path.parent / f"{body.name}{TABLE_SUFFIX}"
    if table.is_file():
        return dict(json.loads(table.read_text(encoding="utf-8-sig")))
    return dict(zip(LANDMARKS, body.points, strict=True))


def _on_people(network: Network, views: Sequence[_Seen], pictures: list[Shown], tick: Any) -> dict[str, Any]:
    """Accuracy of labels, errors at the landmarks that the open body has, and how far apart the answers are for one
    landmark in two views of a body.
    """
    matrix, pairs = ConfusionMatrix(network.classes), []
    answers: dict[tuple[str, str], list[Any]] = {}
    placed = load_template().vertices[fitting_body().landmark_vertices]
    own = dict(zip(LANDMARKS, load_template().nearest(placed), strict=True))
    for view in views:
        prediction, numbers = _answer(network, view.range_m)
        matrix.add(view.labels, np.where(view.labels < BACKGROUND - 1, prediction.labels[0].numpy(), BACKGROUND))
        if numbers is not None:
            found = {name: numbers.ravel()[pixel] for name, pixel in view.pixels.items()}
            pairs += [(own[name], number) for name, number in found.items() if name in own]
            for name, number in found.items():
                answers.setdefault((view.body.name, name), []).append(number)
            _keep(pictures, Shown("people", view.range_m[0].numpy(), None, numbers))
        tick()
    result: dict[str, Any] = {"images": len(views), "accuracy": round(matrix.average_per_class_accuracy(), 4)}
    if pairs:
        twice = [pair for several in answers.values() for pair in itertools.combinations(several, 2)]
        result["geodesic_mm"] = summary(along_template(*np.array(pairs).T))
        result["between_views_mm"] = summary(along_template(*np.array(twice).T)) if twice else None
    return result


def summary(errors_mm: NDArray[np.float64]) -> dict[str, Any]:
    """Count, mean, median, 90th percentile and share beyond `FAR_MM` of errors [N], mm."""
    return {
        "pairs": len(errors_mm),
        "mean": round(float(errors_mm.mean()), 1),
        "median": round(float(np.median(errors_mm)), 1),
        "p90": round(float(np.percentile(errors_mm, 90)), 1),
        "far": round(float((errors_mm > FAR_MM).mean()), 4),
    }


def along_template(first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.float64]:
    """Distances along the template between points of it, [N] each by number: float64 [N], mm."""
    away, known = _distances()
    wanted = np.unique(first)
    for sources in np.array_split(wanted[~known[wanted]].astype(np.intp), 1 + len(wanted) // _TOGETHER):
        if len(sources):
            away[sources] = 1000 * dijkstra(_graph(), directed=False, indices=sources)
            known[sources] = True
    found: NDArray[np.float64] = away[first, second].astype(np.float64)
    return found


@cache
def _distances() -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Distances from each point to each, mm, filled as they are asked for; and of which points they are known."""
    count = len(load_template().points)
    return np.empty((count, count), np.float32), np.zeros(count, np.bool_)


@cache
def _graph() -> Any:
    """Paths between near points of the template on one side of it; eyes and mouth are joined to the face."""
    template = load_template()
    points, tree = template.points, KDTree(template.points)
    normals = vertex_normals(template.vertices, template.faces)[template.corners]
    pairs = tree.query_pairs(_REACH_M, output_type="ndarray")
    pairs = pairs[np.einsum("ni,ni->n", *normals[pairs.T]) > _SAME_SIDE]
    while True:
        lengths = np.linalg.norm(np.diff(points[pairs], axis=1)[:, 0], axis=1)
        graph = csr_array((lengths, tuple(pairs.T)), shape=(len(points), len(points)))
        count, piece = connected_components(graph, directed=False)
        if count == 1:
            return graph
        least = piece == np.bincount(piece).argmin()
        away, nearest = KDTree(points[~least]).query(points[least])
        link = np.flatnonzero(least)[away.argmin()], np.flatnonzero(~least)[nearest[away.argmin()]]
        pairs = np.concatenate([pairs, [link]])
