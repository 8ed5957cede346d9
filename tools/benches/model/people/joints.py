"""`bench joints`: fit joints to the labels of open bodies, whose joints are known, and measure them on other bodies.

`map` in the figures is the content of `bodyseg_model/weights/joints.json`. docs/how-to/robot.md says how to read
the results.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.measuring import counter
from benches.model.chosen import chosen_network
from benches.model.people.bodies import annotated_bodies
from bodyseg_data.bodies import open_source
from bodyseg_data.bodies.skeleton import bone_rotations
from bodyseg_data.core import Draws, ProgressCallback, silent
from bodyseg_data.labels import BACKGROUND, LANDMARKS, PART_COUNT, PARTS
from bodyseg_data.meshes import Mesh, Partition, partition
from bodyseg_data.rendering import RasterRenderer
from bodyseg_data.rigs import PlacedCamera, axes_at, load_sensor
from bodyseg_data.samples import Split
from bodyseg_model.networks import Trained
from bodyseg_model.segmentation import JOINTS, Background, Segmentation, Segmenter
from bodyseg_model.segmentation.joints import FORMAT, JointMap, behind, code_of, feature_points
from bodyseg_model.segmentation.joints import joint_map_from_json as from_json

BONES: Final = (
    "head",
    "neck01",
    *(f"{bone}.{side}" for bone in ("upperarm01", "lowerarm01", "wrist") for side in "RL"),
    "spine03",
    *(f"{bone}.{side}" for bone in ("upperleg01", "lowerleg01", "foot") for side in "RL"),
)
"""Bones of the open body that begin at `JOINTS`."""

FITTED: Final[tuple[tuple[str, Split], ...]] = (("wide", "train"), ("open", "train"))
HELD_OUT: Final[tuple[tuple[str, Split], ...]] = (("open", "test"), ("hard", "test"))
CODES: Final = np.array(
    [code_of(part) for part in range(PART_COUNT)] + [code_of(*pair) for pair in combinations(range(PART_COUNT), 2)]
)
_BODIES: Final = 30  # of each held-out source
_VIEWS: Final = 4  # of each body
_FEATURES: Final = 10  # of a joint
_POOL: Final = 36  # of which they are chosen
_JUDGES: Final = 160  # views that choose
_LEAST_SEEN: Final = 0.03  # share of views
_UNKNOWN_M: Final = 0.3  # error of a joint of which nothing is seen
_RARE: Final = 20  # views of two features together, by which their correlation is halved
_LEAST_SPREAD: Final = 0.02
_ROUNDING_M2: Final = 4e-4  # so that weights stay small

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Person:
    """A body, its joints, float64 [15, 3], and landmarks, float64 [33, 3], metres, in its own frame."""

    mesh: Mesh
    joints: Floats
    landmarks: Floats
    vertices: NDArray[np.int64]


def people_of(source: str, split: Split, count: int, seed: int) -> Iterator[Person]:
    """Bodies of a source's split, drawn by the seed, with their joints. Those of "wide" are undressed."""
    opened: Any = open_source(source)
    refs = [ref for ref in opened.bodies() if ref.split == split and (source != "wide" or ref.subset == source)]
    if source == "wide":
        refs = [ref for ref in refs if opened.figure(ref).outfit is None]
    for index in np.random.default_rng(seed).permutation(len(refs))[:count]:
        body, figure = opened.build(refs[index]), opened.figure(refs[index])
        posable = opened.model.posable(figure.who)
        turns, heads = posable.placed(bone_rotations(figure.pose))
        skin = posable.vertices(turns, heads)
        shift = np.median(body.mesh.vertices[: len(skin)] - skin, axis=0)  # clothes move some vertices
        joints = heads[[posable.numbers[bone] for bone in BONES]] + shift
        yield Person(body.mesh, joints, body.mesh.vertices[body.landmarks], body.landmarks)


def views_of(
    trained: Trained, person: Person, count: int, seed: int, parts: Partition | None = None
) -> Iterator[tuple[Segmentation, Segmentation | None, Floats]]:
    """Frames of a body from anywhere, a third of them partly hidden: the network's answer, that with the true labels if
    `parts` are given, and the joints in the camera's frame, float64 [15, 3].
    """
    middle = (person.mesh.vertices.min(axis=0) + person.mesh.vertices.max(axis=0)) / 2
    for number in range(count):
        draws = Draws(seed, 0, person.mesh.name).generator(f"view {number}")
        camera = load_sensor(("kinect_v1", "kinect_v2")[int(2 * draws.random())]).camera
        axes, away = axes_at(int(draws.uniform(-180, 180)), draws.uniform(-30, 8)), draws.uniform(1.2, 4.2)
        aside, up = draws.uniform(-0.2, 0.2) * away, draws.uniform(-0.4, 0.4)
        placed = PlacedCamera(camera, axes, middle + np.array([0, up, 0]) - away * axes[2] + aside * axes[0])
        seen = RasterRenderer(person.mesh).render(placed)
        body = seen.face >= 0
        noisy = Draws(seed, 0, person.mesh.name).generator(f"noise {number}")
        range_m = _measured(np.where(body, seen.range, np.inf).astype(np.float32), noisy)
        _hide(range_m, body, draws)
        body &= range_m > 0
        if np.count_nonzero(body) < 400:
            continue
        answer = Segmenter(trained.network, camera, Background("keep"), rig=trained.rig)(range_m)
        true = None
        if parts is not None:
            points = placed.to_body(camera.pixel_rays()[body] * seen.range[body][:, None])
            labels = np.full(body.shape, BACKGROUND, np.uint8)
            labels[body] = parts.labels_at(person.mesh, seen.face[body], points)
            true = replace(answer, labels=labels)
        yield answer, true, placed.to_local(person.joints)


def _measured(nearest: NDArray[np.float32], draws: np.random.Generator) -> NDArray[np.float32]:
    """Ranges with a Kinect's noise, in whole millimetres; two pixels in a hundred are lost, and steep edges are.

    The noise: equation 6 of Nguyen, Izadi and Lovell, "Modeling Kinect sensor noise for improved 3D reconstruction and
    tracking", 3DIMPVT 2012, on surfaces that face the sensor.
    """
    nearest = np.where(np.isfinite(nearest), nearest, 0.0)
    sigma = 0.0012 + 0.0019 * (nearest - 0.4) ** 2
    noisy = nearest + draws.normal(0.0, 1.0, nearest.shape) * sigma
    lost = (nearest == 0) | (draws.random(nearest.shape) < 0.02)
    lost[:, 1:] |= np.abs(np.diff(nearest, axis=1)) > 0.25
    return np.where(lost, 0.0, np.maximum(np.rint(1000 * noisy), 0) / 1000).astype(np.float32)


def _hide(range_m: NDArray[np.float32], body: NDArray[np.bool_], draws: np.random.Generator) -> None:
    """Hide what is below, across, right or left of a line through the body, in one of three frames."""
    kind, rows, columns = draws.random(), *np.nonzero(body)
    if kind >= 0.35 or not len(rows):
        return
    cut = int(np.quantile(rows if kind < 0.2 else columns, draws.uniform(0.25, 0.9)))
    if kind < 0.12:
        range_m[cut:] = 0
    elif kind < 0.2:
        range_m[cut : cut + int(draws.uniform(0.05, 0.25) * np.ptp(rows))] = 0
    elif kind < 0.28:
        range_m[:, cut:] = 0
    else:
        range_m[:, : int(np.quantile(columns, 0.4 * draws.random()))] = 0


def fitted(points: Floats, joints: Floats, codes: NDArray[np.int64], ray: bool = True) -> dict[str, Any]:
    """Fit a map, as plain JSON. points: features, float64 [N, F, 3], NaN where unseen; joints: [N, 15, 3], metres.

    ray: joints lie behind the features; otherwise these are no points of a surface before a camera. Views count with
    their mirror images, so that both sides have the same map.
    """
    points, joints = _with_mirror_images(points, joints, codes)
    share = (~np.isnan(points[..., 0])).mean(axis=0)
    found: list[dict[str, Any]] = []
    usual = np.flatnonzero(share >= _LEAST_SEEN)
    points, codes, share = points[:, usual], codes[usual], share[usual]
    units = points / np.linalg.norm(points, axis=-1, keepdims=True)
    judges = np.random.default_rng(0).permutation(len(points))[:_JUDGES]
    for joint, name in enumerate(JOINTS):
        if name.startswith("left"):
            of_right = [
                [LANDMARKS[PARTS[LANDMARKS.index(part)].mirror] for part in each] for each in found[-1]["features"]
            ]
            found.append({**found[-1], "joint": name, "features": of_right})
            continue
        away = joints[:, joint, None] - points
        lengths = np.nanmedian((away * units).sum(axis=-1), axis=0) if ray else np.zeros(len(codes))
        misses = np.linalg.norm(away - lengths[:, None] * units, axis=-1)
        rms = np.sqrt(np.nanmean(np.minimum(misses, 0.5) ** 2, axis=0))
        pool = np.argsort(rms + 0.1 * (1 - share))[:_POOL]
        moments, seen = _moments(behind(points[:, pool], lengths[pool]) - joints[:, joint, None])
        best = _chosen(moments, seen[judges])
        known, upper = pool[best], moments[np.ix_(best, best)][np.triu_indices(len(best))]
        found.append(
            {
                "joint": name,
                "features": [[LANDMARKS[part] for part in sorted({*divmod(int(codes[each]), 256)})] for each in known],
                "behind_mm": np.rint(1e3 * lengths[known]).astype(int).tolist(),
                "moments_mm2": np.rint(1e6 * upper).astype(int).tolist(),
            }
        )
    return {"format": FORMAT, "joints": found}


def _other_side(joint: str) -> str:
    side, _, rest = joint.partition("_")
    return f"{'left' if side == 'right' else 'right'}_{rest}" if rest else joint


def _with_mirror_images(points: Floats, joints: Floats, codes: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Features and joints of views, followed by those of their mirror images."""
    mirror = [part.mirror for part in PARTS]
    places = {code: place for place, code in enumerate(codes.tolist())}
    swapped = [places[code_of(*(mirror[part] for part in divmod(code, 256)))] for code in codes.tolist()]
    sides = [JOINTS.index(_other_side(name)) for name in JOINTS]
    flip = np.array([-1.0, 1.0, 1.0])
    return np.concatenate([points, flip * points[:, swapped]]), np.concatenate([joints, flip * joints[:, sides]])


def _moments(errors: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Means of the products of errors, float64 [F, F], from [N, F, 3] with NaN where unseen; and what is seen [N, F].

    Correlations of features that are seldom seen together are taken for smaller, and their matrix is made positive.
    """
    seen, errors = ~np.isnan(errors[..., 0]), np.nan_to_num(errors)
    together = seen.T.astype(np.float64) @ seen
    products = np.einsum("nad,nbd->ab", errors, errors)
    spread = np.sqrt(np.diag(products) / np.diag(together))
    alike = products / np.maximum(together, 1) / np.outer(spread, spread) * together / (together + _RARE)
    np.fill_diagonal(alike, 1)
    values, vectors = np.linalg.eigh(alike)
    alike = (vectors * np.maximum(values, _LEAST_SPREAD)) @ vectors.T
    alike *= np.outer(spread, spread) / np.sqrt(np.outer(np.diag(alike), np.diag(alike)))
    return alike + _ROUNDING_M2 * np.eye(len(alike)), seen


def _chosen(moments: Floats, seen: NDArray[np.bool_]) -> list[int]:
    """Features, one after the other, each the one by which the expected error of views falls most. seen: [N, F]."""
    chosen: list[int] = []
    while len(chosen) < min(_FEATURES, len(moments)):
        left = [each for each in range(len(moments)) if each not in chosen]
        tried = np.array([[*chosen, each] for each in left])
        there = seen[:, tried].transpose(1, 0, 2)
        some = moments[tried[:, :, None], tried[:, None]][:, None] * (there[..., :, None] & there[..., None, :])
        some = some + 1e6 * np.eye(tried.shape[1]) * ~there[..., None, :]
        weights = (np.linalg.solve(some, there[..., None].astype(np.float64))[..., 0] * there).sum(axis=-1)
        chosen.append(left[np.minimum(1 / np.maximum(weights, 1e-9), _UNKNOWN_M**2).mean(axis=1).argmin()])
    return chosen


def errors_of(joint_map: JointMap, points: Floats, joints: Floats) -> dict[str, Any]:
    """Errors of a map, millimetres, and the share of joints that it gives, of each joint and of all."""
    places, _, _ = joint_map(points)
    errors = 1e3 * np.linalg.norm(places - joints, axis=-1)
    table = {}
    for name, some in [*zip(JOINTS, errors.T, strict=True), ("all", errors)]:
        given = some[~np.isnan(some)]
        table[name] = {
            "median_mm": round(float(np.median(given)), 1),
            "p90_mm": round(float(np.quantile(given, 0.9)), 1),
            "given": round(len(given) / some.size, 3),
        }
    return table


Seen = tuple[Floats, Floats, Floats]
"""Features by the network's labels and by the true ones, float64 [N, F, 3], and joints, float64 [N, 15, 3]."""


def seen_of(trained: Trained, people: Sequence[Person], views: int, seed: int, true: bool, step: Any) -> Seen:
    """Features and joints of `views` frames of every body."""
    rows = []
    for person in people:
        parts = partition(person.mesh, person.vertices, "edges") if true else None
        for answer, right, joints in views_of(trained, person, views, seed, parts):
            points = [
                np.empty((1, len(CODES), 3)) if each is None else feature_points(each, CODES)
                for each in (answer, right)
            ]
            rows.append((points[0][0], points[1][0], joints))
        step()
    predicted, known, joints = (np.array(each) for each in zip(*rows, strict=True))
    return predicted, known, joints


def annotated_people(folder: Path, skeleton: JointMap) -> list[Person]:
    """Bodies with annotated landmarks, from which the skeleton's map tells the joints."""
    people = []
    for body in annotated_bodies(folder, 10):
        joints = skeleton(body.points[None])[0][0]
        vertices = np.array([np.linalg.norm(body.mesh.vertices - point, axis=1).argmin() for point in body.points])
        people.append(Person(body.mesh, joints, body.points, vertices))
    return people


def bench_joints(
    data: str, views: int = 240, runs: Sequence[Path] = (), progress: ProgressCallback = silent
) -> dict[str, Any]:
    """Fit joints to four frames of each of `views` open bodies, and measure them on bodies that no fit has seen.

    data: folder of bodies with annotated landmarks (`annotated_bodies`); joints of theirs are told from landmarks by a
    map that is fitted to the same open bodies. runs: the network is in the first of them; without, it is the one that
    ships. Raises as `annotated_bodies`.
    """
    name, trained = chosen_network(runs)
    shares = (views - views // 4, views // 4)
    fitted_to = [each for (s, t), n in zip(FITTED, shares, strict=True) for each in people_of(s, t, n, 1)]
    held_out = {source: list(people_of(source, split, _BODIES, 2)) for source, split in HELD_OUT}
    skeleton = landmark_skeleton(fitted_to)
    sets = {**held_out, "annotated": annotated_people(Path(data), skeleton)}
    step = counter(progress, views + sum(map(len, sets.values())))
    points, _, joints = seen_of(trained, fitted_to, _VIEWS, 1, False, step)
    seen = {source: seen_of(trained, people, _VIEWS, 2, True, step) for source, people in sets.items()}
    return {"network": name, "bodies": views, "views": _VIEWS} | measured(points, joints, seen, skeleton, held_out)


def landmark_skeleton(people: Sequence[Person]) -> JointMap:
    """The map from landmarks to joints, fitted to bodies whose joints are known."""
    points, joints = (np.array([getattr(each, name) for each in people]) for name in ("landmarks", "joints"))
    return from_json(fitted(points, joints, CODES[:PART_COUNT], ray=False))


def measured(
    points: Floats, joints: Floats, seen: dict[str, Seen], skeleton: JointMap, held_out: dict[str, list[Person]]
) -> dict[str, Any]:
    """The fitted map, its errors by predicted and by true labels, and those of the skeleton from landmarks."""
    tree = fitted(points, joints, CODES)
    joint_map = from_json(tree)
    at = np.searchsorted(CODES, joint_map.codes, sorter=np.argsort(CODES))
    at = np.argsort(CODES)[at]
    errors = {}
    for source, (predicted, known, where) in seen.items():
        by_labels = {"predicted": predicted, "true": known}
        errors[source] = {label: errors_of(joint_map, some[:, at], where) for label, some in by_labels.items()}
    bodies = [each for people in held_out.values() for each in people]
    marks, places = (np.array([getattr(each, name) for each in bodies]) for name in ("landmarks", "joints"))
    return {"errors": errors, "skeleton_from_landmarks": errors_of(skeleton, marks, places), "map": tree}
