"""Proposed landmarks of people against annotated ones, by landmarks that are placed on the open body in four ways.

shipped: those of the open body as it ships. other people: placed by the annotations of all people but the one measured.
all people: placed by everybody's. same person: by those of the person measured, in all other poses, each side by
itself: what carrying landmarks over by fits costs.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.data.surface.areas import part_areas
from benches.landmarks.body_fit import fitted_points
from benches.landmarks.fitting_body import FittingBody
from benches.landmarks.proposal import NORMAL_REACH_M, FittedBody, fit_body
from benches.model.people.bodies import Annotated
from benches.model.people.intervals import interval, summed
from bodyseg_data.core import BadLandmarks
from bodyseg_data.labels import LANDMARKS, PARTS
from bodyseg_data.meshes import Partition, partition
from bodyseg_data.meshes.landmarks import nearest_corner

_MIRROR: Final = [part.mirror for part in PARTS]
_ACROSS: Final = np.array([-1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Fitted:
    """A body, and the open body fitted to it. true: its partition by annotations."""

    of: Annotated
    fitted: FittedBody
    true: Partition


def fitted_to(body: FittingBody, annotated: Annotated) -> Fitted:
    """Fit the open body to an annotated one, whose annotations the fit does not use. Raises as `fit_body`."""
    fitted = fit_body(body, annotated.mesh)
    landmarks, _ = nearest_corner(annotated.mesh.vertices, annotated.mesh.faces, annotated.points)
    return Fitted(annotated, fitted, partition(annotated.mesh, landmarks.astype(np.int64)))


def carried(fitted: FittedBody, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places of `points` [N, 3] on a mesh on the open body at rest, float64 [N, 3], body frame, metres.

    Each goes to the nearest vertex of the fitted body that faces the same way.
    """
    from scipy.spatial import KDTree

    body, mesh = fitted.body, fitted.mesh
    own, normals = fitted_points(body, fitted.fit, body.whole.at(body.skin))
    used = np.unique(mesh.faces)
    facing = mesh.vertex_normals[used[KDTree(mesh.vertices[used]).query(points)[1]]]
    tree = KDTree(np.concatenate([own, NORMAL_REACH_M * normals], axis=1))
    nearest = body.skin[tree.query(np.concatenate([points, NORMAL_REACH_M * facing], axis=1))[1]]
    rest: NDArray[np.float64] = body.mesh.vertices[nearest]
    return rest


def placed(bodies: Sequence[Fitted], mirrored: bool = True) -> NDArray[np.int64]:
    """Place the landmarks on the open body by annotated bodies fitted to it: vertices, int64 [33].

    Each annotation is carried over; the median of all bodies and, if `mirrored`, both sides, by coordinate, is snapped
    to the nearest vertex; then left and right are the same. Raises BadLandmarks if two landmarks fall on one.
    """
    from scipy.spatial import KDTree

    body = bodies[0].fitted.body
    points = np.stack([carried(one.fitted, one.of.points) for one in bodies])
    if mirrored:
        points = np.concatenate([points, points[:, _MIRROR] * _ACROSS])
    tree = KDTree(body.mesh.vertices[body.skin])
    vertices: NDArray[np.int64] = body.skin[tree.query(np.median(points, axis=0))[1]]
    for part in PARTS:
        if mirrored and part.landmark.startswith("Rt."):
            there = body.mesh.vertices[vertices[part.label]] * _ACROSS
            vertices[part.mirror] = body.skin[tree.query(there)[1]]
    shared = [name for name, vertex in zip(LANDMARKS, vertices, strict=True) if np.sum(vertices == vertex) > 1]
    if shared:
        raise BadLandmarks(
            f"landmarks placed by people's must be different vertices, found {', '.join(shared)} together"
        )
    return vertices


Ways = dict[str, list[tuple[NDArray[np.int64], list[Fitted]]]]
"""Name -> the landmarks placed on the open body, vertices int64 [33], and the bodies for which they are used."""


def ways_to_place(bodies: Sequence[Fitted], body: FittingBody) -> Ways:
    """The ways that the head of this module names; those by other people and other poses where all have some."""
    own = {who: [one for one in bodies if one.of.person == who] for who in people_of(bodies)}
    ways = {"shipped": [(body.landmark_vertices, list(bodies))], "all_people": [(placed(bodies), list(bodies))]}
    if len(own) > 1:
        ways["other_people"] = [
            (placed([one for one in bodies if one.of.person != who]), poses) for who, poses in own.items()
        ]
    if min(map(len, own.values())) > 1:
        ways["same_person"] = [
            (placed([other for other in poses if other is not one], mirrored=False), [one])
            for poses in own.values()
            for one in poses
        ]
    return ways


def people_of(bodies: Sequence[Fitted]) -> list[str]:
    """Names of the people, each once, in the bodies' order."""
    return list(dict.fromkeys(one.of.person for one in bodies))


def proposed(way: Sequence[tuple[NDArray[np.int64], Sequence[Fitted]]]) -> dict[str, Annotated]:
    """The bodies by name, with proposed landmarks in the place of annotated ones."""
    return {
        one.of.name: replace(
            one.of, points=one.of.mesh.vertices[one.fitted.proposal(vertices).landmarks.for_mesh(one.of.mesh)]
        )
        for vertices, several in way
        for one in several
    }


def measured(bodies: Sequence[Fitted], ways: Ways) -> dict[str, Any]:
    """The landmarks placed by all people and by each alone, and the errors of each way to place them."""
    ((all_people, _),) = ways["all_people"]
    return {
        "placed": _by_name(all_people),
        "placed_by": {
            who: _by_name(placed([one for one in bodies if one.of.person == who])) for who in people_of(bodies)
        },
        **{name: _errors([error for way in pairs for error in _compared(*way)]) for name, pairs in ways.items()},
    }


def _by_name(vertices: NDArray[np.int64]) -> dict[str, int]:
    return dict(zip(LANDMARKS, vertices.tolist(), strict=True))


@dataclass(frozen=True)
class _Compared:
    """Errors of one body. away: [33], metres, of its landmarks. wrong: share of its surface."""

    of: Annotated
    away: NDArray[np.float64]
    wrong: float


def _compared(vertices: NDArray[np.int64], bodies: Sequence[Fitted]) -> Iterator[_Compared]:
    for one in bodies:
        mesh = one.of.mesh
        found = one.fitted.proposal(vertices).landmarks.for_mesh(mesh)
        away = np.linalg.norm(mesh.vertices[found] - one.of.points, axis=1)
        differ = (partition(mesh, found).labels != one.true.labels).astype(np.uint8)
        yield _Compared(one.of, away, float(part_areas(mesh, differ)[1]))


def _errors(errors: Sequence[_Compared]) -> dict[str, Any]:
    away = 1000 * np.stack([one.away for one in errors])
    poses = summed({(n, one.of.pose): np.array([one.away.sum(), 33]) for n, one in enumerate(errors)}, _pose)
    return {
        "mean_mm": round(float(away.mean()), 1),
        "interval_mm": _interval_mm(list(poses.values())),
        "median_mm": round(float(np.median(away)), 1),
        "wrong_surface": round(float(np.mean([one.wrong for one in errors])), 4),
    }


def _pose(key: tuple[int, str]) -> str:
    return key[1]


def _interval_mm(poses: list[NDArray[np.float64]]) -> list[float] | None:
    found = interval(poses, lambda sums: 1000 * float(sums[0] / sums[1]))
    return None if found is None else [round(value, 1) for value in found]
