"""Search for the 33 landmarks of a new body, by fitting the open body to it.

Every posture, turned to face every direction, is placed on the surface by centre and size; the best starts of each
direction are refined, then tried with other arms and legs; the best fit is refined once more and its landmarks are
returned. No random numbers.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from benches.landmarks.body_fit import (
    FINE_REACH_M,
    LIMB_POSES,
    Fit,
    Matcher,
    Stage,
    fitted_points,
    fitted_surface,
    refine,
    surface_distance,
)
from benches.landmarks.fitting_body import FittingBody, SurfacePoints, Tensor, fitting_body, sample_surface
from bodyseg_data.bodies.anny_people import POSTURES
from bodyseg_data.bodies.motions.curves import about_y
from bodyseg_data.core import BadMesh
from bodyseg_data.labels import PART_COUNT
from bodyseg_data.machine import torch_threads
from bodyseg_data.meshes import LandmarkSet, Mesh, welded

POOR_M: Final = 0.045
"""Gap of a fit above which it is poor, metres: of bare bodies 3 to 4 cm with every limb in place, 4 to 6 without."""

_GAP_SHARE: Final = 0.99
NORMAL_REACH_M: Final = 0.06
"""A surface turned by a right angle counts as 1.4 times this away from a landmark, metres."""

UPRIGHT: Final = (np.eye(3),)
"""Tilts of the body's frame to try for a mesh that is upright: none."""

_TURNS: Final = 12  # directions to face that are tried, evenly around
_STARTS: Final = 16
_STARTS_FACING: Final = 2  # at most so many that face one direction
_CANDIDATES: Final = 3
_CANDIDATE_SHARE: Final = 1.25  # of the best one's distance: worse candidates are dropped
_FINALISTS: Final = 2
_APART_DEG: Final = 60.0  # smallest angle between the trunks of two candidates
_LIMB_TRIES: Final = 2
_LIMB_APART_M: Final = 0.15  # smallest distance between the hands or feet of two tries
_FINE_POINTS: Final = 4000
_POINTS: Final = 1000
_ROUGH_POINTS: Final = 500
_CLOSE_IN: Final[tuple[Stage, ...]] = ((40, 0.20, 0.03), (40, 0.10, 0.02))
_SETTLE: Final[tuple[Stage, ...]] = ((40, 0.10, 0.02), (40, 0.05, 0.012))
_TRY: Final[tuple[Stage, ...]] = ((30, 0.20, 0.03), (30, 0.10, 0.02))
_FINISH: Final[tuple[Stage, ...]] = ((60, 0.10, 0.015), (80, 0.05, 0.012))

_LIMBS: Final = (("leg", "L"), ("leg", "R"), ("arm", "LR"), ("arm", "L"), ("arm", "R"))
"""Limbs to try others for, in turn; hands before the body may be crossed in a fit, and only both arms undo that."""

_BONES: Final = {
    "arm": ("clavicle", "shoulder", "upperarm", "lowerarm", "wrist", "finger", "metacarpal"),
    "leg": ("upperleg", "lowerleg", "foot", "toe"),
}


@dataclass(frozen=True)
class Proposal:
    """Landmarks for a person to check. distance_m: float64 [33], from the fitted body's landmark to the vertex.

    gap_m: the fit's, see `FittedBody`.
    """

    landmarks: LandmarkSet
    distance_m: NDArray[np.float64]
    gap_m: float = 0.0

    @property
    def poor(self) -> bool:
        """True if the fitted body is so far from the surface in places that limbs may be in the wrong place."""
        return self.gap_m > POOR_M


@dataclass(frozen=True)
class FittedBody:
    """The open body fitted to `mesh`. gap_m: the distance to the mesh that 99 % of the fitted body's points keep."""

    mesh: Mesh
    body: FittingBody
    fit: Fit
    gap_m: float

    def proposal(self, vertices: NDArray[np.int64]) -> Proposal:
        """Return the landmarks of the mesh, those of the open body being at its `vertices` [33].

        Raises BadMesh for a mesh whose largest piece has fewer than 33 vertices.
        """
        positions, normals = fitted_points(self.body, self.fit, self.body.whole.at(vertices))
        found, distance = _on_surface(self.mesh, largest_piece(self.mesh), positions, normals)
        topology = f"meshes numbered like {self.mesh.name}; proposed, to be checked"
        counts = len(self.mesh.vertices), len(self.mesh.faces)
        landmarks = LandmarkSet("proposed", topology, *counts, tuple(found.tolist()))
        return Proposal(landmarks, distance, self.gap_m)


def gap_m(target: SurfacePoints, own: SurfacePoints) -> float:
    """Return the distance to the points of `target` that 99 % of the points of the fitted body keep, metres."""
    from scipy.spatial import KDTree

    return float(np.quantile(KDTree(target.positions).query(own.positions)[0], _GAP_SHARE))


def largest_piece(mesh: Mesh) -> NDArray[np.int64]:
    """Return the vertices of the piece with the largest area. Raises BadMesh for fewer than 33."""
    piece = mesh.pieces()
    area = np.bincount(piece[mesh.faces[:, 0]], np.linalg.norm(mesh.normals, axis=1))
    used = np.unique(mesh.faces).astype(np.int64)
    largest: NDArray[np.int64] = used[piece[used] == area.argmax()]
    if len(largest) < PART_COUNT:
        raise BadMesh(f"mesh {mesh.name}: its largest piece must have {PART_COUNT} vertices, found {len(largest)}")
    return largest


def _on_surface(
    mesh: Mesh, among: NDArray[np.int64], positions: NDArray[np.float64], normals: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return for each of 33 positions and normals [33, 3] a different vertex of `among`, and its distance, metres."""
    from scipy.spatial import KDTree

    facing = mesh.vertex_normals[among]
    tree = KDTree(np.concatenate([mesh.vertices[among], NORMAL_REACH_M * facing], axis=1))
    # As many candidates as there are landmarks: one is always left.
    nearest = tree.query(np.concatenate([positions, NORMAL_REACH_M * normals], axis=1), PART_COUNT)[1]
    chosen: list[int] = []
    for candidates in among[nearest].tolist():
        chosen.append(next(vertex for vertex in candidates if vertex not in chosen))
    vertices = np.array(chosen, np.int64)
    return vertices, np.linalg.norm(mesh.vertices[vertices] - positions, axis=1)


def propose(mesh: Mesh, tilts: Sequence[NDArray[np.float64]] = UPRIGHT) -> Proposal:
    """Propose landmarks for `mesh`, a whole body in metres, standing or in any of many postures, facing any direction.

    tilts: rotations [3, 3] that may take the upright body frame to the mesh's axes; the best one is chosen. Takes about
    ten seconds of one processor. The same mesh gets the same landmarks. Raises BadMesh for a surface whose largest
    piece has fewer than 33 vertices, MissingLibrary without Anny or scipy, BadConfig if Anny's cache cannot be used.
    """
    whole, kept = joined(mesh)
    largest_piece(whole)  # before the work, not after it
    with torch_threads(1):
        body = fitting_body()
        proposal = fit_body(body, whole, tilts).proposal(body.landmark_vertices)
    vertices = tuple(kept[list(proposal.landmarks.vertices)].tolist())
    counts = len(mesh.vertices), len(mesh.faces)
    own = replace(proposal.landmarks, vertices=vertices, vertex_count=counts[0], face_count=counts[1])
    return replace(proposal, landmarks=own)


def joined(mesh: Mesh) -> tuple[Mesh, NDArray[np.int64]]:
    """Return a mesh in one piece, as it is if most of it is, else with vertices in one place joined, as of loose
    triangles; and the vertex of `mesh` that each of its vertices is, [V].
    """
    same = np.arange(len(mesh.vertices))
    if 2 * np.bincount(mesh.pieces()[np.unique(mesh.faces)]).max() > len(np.unique(mesh.faces)):
        return mesh, same
    kept, place = welded(mesh.vertices)
    try:
        return Mesh(mesh.name, mesh.vertices[kept], place[mesh.faces].astype(np.int32)), kept
    except BadMesh:  # no surface without its gaps
        return mesh, same


def fit_body(body: FittingBody, mesh: Mesh, tilts: Sequence[NDArray[np.float64]] = UPRIGHT) -> FittedBody:
    """Fit the open body to a mesh; see `propose`, which does this for one mesh alone."""
    with torch_threads(1):
        target = sample_surface(mesh, _FINE_POINTS)
        fit = _fit_to(body, target, tilts)
        return FittedBody(mesh, body, fit, gap_m(target, fitted_surface(body, fit)))


def _fit_to(body: FittingBody, target: SurfacePoints, tilts: Sequence[NDArray[np.float64]]) -> Fit:
    poses = [body.start(pose) for _, pose in POSTURES]
    limbs = {kind: [body.start(pose) for pose in poses] for kind, poses in LIMB_POSES.items()}
    some, few = target.thinned(_POINTS), target.thinned(_ROUGH_POINTS)

    def distance(fit: Fit) -> float:
        return surface_distance(target, fitted_surface(body, fit))

    begun = _best_starts(_starts(body, few, poses, tilts))
    closer = sorted(refine(body, few, begun, _CLOSE_IN, _ROUGH_POINTS), key=distance)
    turned = ((fit.turns(body)[0], fit) for fit in closer)
    different = _apart(turned, _CANDIDATES, lambda a, b: _angle_deg(a @ b.T) > _APART_DEG)
    candidates = sorted(refine(body, some, different, _SETTLE, _POINTS), key=distance)
    candidates = [fit for fit in candidates if distance(fit) <= _CANDIDATE_SHARE * distance(candidates[0])]
    for limb in _LIMBS:
        others = [_other_limbs(body, few, fit, limb, limbs[limb[0]]) for fit in candidates]
        tried = iter(refine(body, some, [other for each in others for other in each], _TRY, _POINTS))
        candidates = [
            min([fit, *itertools.islice(tried, len(each))], key=distance)
            for fit, each in zip(candidates, others, strict=True)
        ]
    best = sorted(candidates, key=distance)[:_FINALISTS]
    return min(refine(body, target, best, _FINISH, len(body.mean_geodesic), FINE_REACH_M), key=distance)


def _starts(
    body: FittingBody, target: SurfacePoints, poses: Sequence[Tensor], tilts: Sequence[NDArray[np.float64]]
) -> list[tuple[float, int, Fit]]:
    """List (distance, direction number, fit) of every pose, tilted and turned every way, by centre and size."""
    centre, size = _centre_and_size(target.positions)
    matcher = Matcher(target)
    shape, angles = torch.zeros(len(body.head_shapes)).double(), torch.zeros(len(body.deviation)).double()
    root = body.heads[0].numpy()
    found = []
    for pose in poses:
        own = fitted_surface(body, Fit(pose, torch.zeros(3).double(), torch.tensor(1.0).double(), angles, shape))
        middle, own_size = _centre_and_size(own.positions)
        scale = size / own_size
        own = SurfacePoints((own.positions - middle) * scale, own.normals, own.mean_geodesic).first(_ROUGH_POINTS)
        own_matcher = Matcher(own)
        for way, (tilt, turn) in enumerate((tilt, turn) for tilt in tilts for turn in range(_TURNS)):
            rotation = tilt @ about_y(360 * turn / _TURNS)
            turned = SurfacePoints(own.positions @ rotation.T + centre, own.normals @ rotation.T, own.mean_geodesic)
            back = SurfacePoints(
                (target.positions - centre) @ rotation, target.normals @ rotation, target.mean_geodesic
            )
            start = pose.clone()
            start[0] = torch.from_numpy(rotation) @ start[0]
            # Turning the root does not move the root itself.
            move = torch.from_numpy(centre - scale * (rotation @ (middle - root) + root))
            fit = Fit(start, move, torch.tensor(scale).double(), angles, shape)
            found.append((matcher.distance(turned) + own_matcher.distance(back), way, fit))
    return found


def _best_starts(starts: Sequence[tuple[float, int, Fit]]) -> list[Fit]:
    """Return the best starts, not too many of them facing one direction."""
    best: list[tuple[int, Fit]] = []
    for _, way, fit in sorted(starts, key=lambda start: start[0]):
        if [before for before, _ in best].count(way) < _STARTS_FACING:
            best.append((way, fit))
    return [fit for _, fit in best[:_STARTS]]


def _apart(ranked: Iterable[tuple[Any, Fit]], most: int, differ: Callable[[Any, Any], bool]) -> list[Fit]:
    """Return the first few fits, at most `most`, of which what stands beside each differs from that of all before."""
    chosen: list[tuple[Any, Fit]] = []
    for place, fit in ranked:
        if len(chosen) < most and all(differ(place, before) for before, _ in chosen):
            chosen.append((place, fit))
    return [fit for _, fit in chosen]


def _other_limbs(
    body: FittingBody, target: SurfacePoints, fit: Fit, limb: tuple[str, str], poses: Sequence[Tensor]
) -> list[Fit]:
    """List fits with an arm, a leg or both arms of another pose: those nearest to the target, with the hand or foot, or
    one of the hands, in different places.
    """
    kind, sides = limb
    ends = tuple(f".{side}" for side in sides)
    own = [bone for bone in body.bones if bone.endswith(ends) and bone.startswith(_BONES[kind])]
    bones = torch.tensor([body.bones[bone] for bone in own])
    still = 1 - body.turns[:, bones].abs().amax(dim=(1, 2)).gt(0).double()
    farthest_out = body.surface.weights[:, bones].sum(dim=1).numpy() * body.mean_geodesic
    end = int(farthest_out[:_POINTS].argmax())
    matcher = Matcher(target)
    found = []
    for pose in poses:
        start = fit.start.clone()
        start[bones] = pose[bones]
        other = replace(fit, start=start, angles=fit.angles * still)
        points = fitted_surface(body, other, _POINTS)
        found.append((matcher.distance(points) + Matcher(points).distance(target), points.positions[end], other))
    ranked = (each[1:] for each in sorted(found, key=lambda one: one[0]))
    return _apart(ranked, _LIMB_TRIES, lambda a, b: bool(np.linalg.norm(a - b) > _LIMB_APART_M))


def _centre_and_size(positions: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    centre = positions.mean(axis=0)
    return centre, float(np.sqrt(((positions - centre) ** 2).sum(axis=1).mean()))


def _angle_deg(rotation: Tensor) -> float:
    return math.degrees(math.acos(max(-1.0, min(1.0, (float(rotation.trace()) - 1) / 2))))
