"""Differentiable model of the open body: a few parameters to points, normals and landmarks, with gradients.

Anny's own forward pass would take a hundred times as long. Here shapes are principal components of people, with a
standard deviation of 1 each, and lengths of limbs and trunk, in which people differ more than the open body's do: what
hangs from a segment, from the head of one bone to that of another, moves along with its end. Joints turn as in
`skeleton`; skin follows bones as in Anny (linear blend skinning). All in the body frame, metres, float64.

Surfaces are matched by points with their normals and mean geodesic distances.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.bodies import load_anny
from bodyseg_data.bodies.anny_model import BODY_FROM_ANNY
from bodyseg_data.bodies.anny_people import person
from bodyseg_data.bodies.limb_reaching import farthest
from bodyseg_data.bodies.skeleton import Pose, bone_rotations
from bodyseg_data.meshes import Mesh, load_landmarks

_CELL_M: Final = 0.01  # finer details change no distance across a body, and doubled vertices and cracks close
_SOURCES: Final = 24

Tensor = torch.Tensor

_SEGMENTS: Final = (
    ("spine05", "neck01", 0.05), ("neck01", "head", 0.15), ("clavicle", "upperarm01", 0.08),
    ("upperarm01", "lowerarm01", 0.06), ("lowerarm01", "wrist", 0.06), ("wrist", "finger3-3", 0.08),
    ("upperleg01", "lowerleg01", 0.05), ("lowerleg01", "foot", 0.05), ("foot", "toe3-1", 0.08),
)  # fmt: skip
"""First bone, bone at the end, both without the side, and the standard deviation as a share of the length."""

_PEOPLE: Final = 96
_SHAPES: Final = 14
_POINTS: Final = 2400

_CURL: Final = ((1, 1.08), (2, 1.31), (3, 0.79))  # as in a fist, radians


@dataclass(frozen=True)
class SurfacePoints:
    """Points of a surface. positions: float64 [N, 3], metres; normals: [N, 3], outwards; mean_geodesic: [N]."""

    positions: NDArray[np.float64]
    normals: NDArray[np.float64]
    mean_geodesic: NDArray[np.float64]

    def thinned(self, count: int) -> SurfacePoints:
        """Return every n-th point, at least `count` of them if there are as many."""
        step = max(1, len(self.positions) // count)
        return SurfacePoints(self.positions[::step], self.normals[::step], self.mean_geodesic[::step])

    def first(self, count: int) -> SurfacePoints:
        """Return the first `count` points."""
        return SurfacePoints(self.positions[:count], self.normals[:count], self.mean_geodesic[:count])


def sample_surface(mesh: Mesh, count: int) -> SurfacePoints:
    """Sample `count` points evenly by area, the same ones for the same mesh."""
    double_areas = np.linalg.norm(mesh.normals, axis=1)
    filled = np.cumsum(double_areas)
    faces = np.searchsorted(filled, (np.arange(count) + 0.5) / count * filled[-1])
    # Positions within the triangles: a sequence that fills the square evenly (Roberts 2018), folded into a triangle.
    u, v = (np.arange(count)[:, None] * (0.7548776662466927, 0.5698402909980532) % 1).T
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[faces]], 1, 0)
    positions = a + u[:, None] * (b - a) + v[:, None] * (c - a)
    normals = mesh.normals[faces] / double_areas[faces, None]
    return SurfacePoints(positions, normals, mean_geodesic(mesh)[mesh.faces[faces, 0]])


def mean_geodesic(mesh: Mesh) -> NDArray[np.float64]:
    """Mean geodesic distance of every vertex to points all over the body, divided by its mean, float64 [V].

    About 0.8 on the trunk and 1.7 at hands and feet, in any posture (Hilaga et al., Topology matching for fully
    automatic similarity estimation of 3D shapes, SIGGRAPH 2001). Distances run along the edges between cells of a
    centimetre; pieces other than the largest take the value of its nearest point.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components, dijkstra
    from scipy.spatial import KDTree

    cells = np.floor(mesh.vertices / _CELL_M).astype(np.int64)
    cell = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    positions = np.stack([np.bincount(cell, axis) for axis in mesh.vertices.T], axis=1) / np.bincount(cell)[:, None]
    ends = cell[mesh.faces[:, [0, 1, 1, 2, 2, 0]]].reshape(-1, 2)
    ends = np.unique(np.sort(ends[ends[:, 0] != ends[:, 1]], axis=1), axis=0)
    lengths = np.linalg.norm(positions[ends[:, 0]] - positions[ends[:, 1]], axis=1)
    graph = coo_array((lengths, ends.T), shape=(len(positions), len(positions))).tocsr()
    piece = connected_components(graph, directed=False)[1]
    area = np.bincount(cell[mesh.faces[:, 0]], np.linalg.norm(mesh.normals, axis=1), len(positions))
    main = np.flatnonzero(piece == np.bincount(piece, area).argmax())
    away = np.zeros(len(positions))
    away[main] = dijkstra(graph, directed=False, indices=main[farthest(positions[main], _SOURCES)]).mean(axis=0)[main]
    away /= np.average(away[main], weights=area[main])
    nearest: NDArray[np.int64] = main[KDTree(positions[main]).query(positions)[1]]
    return away[nearest[cell]]


def length_shapes(
    bones: Mapping[str, int], parents: Sequence[int], heads: Tensor, weights: Tensor, rest: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the shift of points [segments, N, 3] and of heads [segments, bones, 3] for one standard deviation each.

    bones: index by name. parents: index of each bone's parent, which comes before it; -1 for the root. heads: [bones,
    3]; weights: [N, bones]; rest: [N, 3]. Both sides lengthen alike.
    """
    moved = torch.zeros((len(_SEGMENTS), *rest.shape), dtype=rest.dtype)
    moved_heads = torch.zeros((len(_SEGMENTS), *heads.shape), dtype=rest.dtype)
    for number, (first, end, share) in enumerate(_SEGMENTS):
        for side in ("",) if first in bones else (".L", ".R"):
            begin, last = bones[first + side], bones.get(end + side, bones.get(end, -1))
            axis = heads[last] - heads[begin]

            def along(points: Tensor, start: Tensor = heads[begin], axis: Tensor = axis) -> Tensor:
                return (((points - start) @ axis) / (axis @ axis)).clip(0, 1)

            chain = _between(parents, begin, last)
            shares = along(rest)
            # A bone that hangs from the segment keeps the share of the place where it leaves it.
            hanging: dict[int, Tensor] = {}
            whole = torch.zeros(len(rest), dtype=rest.dtype)
            for bone, parent in enumerate(parents):
                if bone in chain:
                    whole += weights[:, bone] * shares
                    moved_heads[number, bone] = share * along(heads[bone]) * axis
                elif parent in chain or parent in hanging:
                    hanging[bone] = along(heads[bone]) if parent in chain else hanging[parent]
                    whole += weights[:, bone] * hanging[bone]
                    moved_heads[number, bone] = share * hanging[bone] * axis
            moved[number] += share * whole[:, None] * axis
    return moved, moved_heads


def _between(parents: Sequence[int], first: int, last: int) -> set[int]:
    """Return the bones from `first` to the parent of `last`."""
    chain = set()
    bone = last
    while bone != first:
        bone = parents[bone]
        chain.add(bone)
    return chain


@dataclass(frozen=True)
class Skin:
    """Points of the body that follow the bones. weights: [N, bones]; rest, normals: [N, 3] of the mean person.

    shapes: [shapes, N, 3], shift of the points at rest for one unit of each shape parameter.
    """

    weights: Tensor
    rest: Tensor
    normals: Tensor
    shapes: Tensor

    def first(self, count: int) -> Skin:
        """Return the first `count` points."""
        return Skin(self.weights[:count], self.rest[:count], self.normals[:count], self.shapes[:, :count])

    def at(self, indices: NDArray[np.int64]) -> Skin:
        """Return the points at `indices` [N]."""
        at = torch.from_numpy(indices)
        return Skin(self.weights[at], self.rest[at], self.normals[at], self.shapes[:, at].contiguous())


@dataclass(frozen=True)
class FittingBody:
    """Bones, joints, points spread over the surface, and the places of `parts.LANDMARKS`, in their order.

    bones: index of each by name, the root first and then by depth. levels: for each depth below the root, the slice of
    the bones one level above, and for each bone of that depth the index of its parent within the slice. heads:
    [bones, 3], positions at which bones begin; head_shapes: [shapes, bones, 3]. turns: [movements, bones, 3], rotation
    about each axis for one unit of a movement of the joints, radians; deviation: [movements], its standard deviation,
    in units. surface: ordered so that its first
    points, however many, cover the body too. mean_geodesic: [N], of the surface's points. mesh: the mean person at
    rest, with all its vertices as points in `whole`; skin: int64 [N], those on its largest piece. landmark_vertices:
    int64 [33], where the landmarks are.
    """

    bones: Mapping[str, int]
    levels: Sequence[tuple[slice, Tensor]]
    heads: Tensor
    head_shapes: Tensor
    turns: Tensor
    deviation: Tensor
    surface: Skin
    landmark_vertices: NDArray[np.int64]
    mean_geodesic: NDArray[np.float64]
    mesh: Mesh
    skin: NDArray[np.int64]
    whole: Skin

    @property
    def landmarks(self) -> Skin:
        """The points at `landmark_vertices`."""
        return self.whole.at(self.landmark_vertices)

    def start(self, pose: Pose) -> Tensor:
        """Return the rotations [bones, 3, 3] of a pose."""
        turns = torch.eye(3, dtype=torch.float64).repeat(len(self.bones), 1, 1)
        for bone, rotation in bone_rotations(pose).items():
            turns[self.bones[bone]] = torch.from_numpy(np.ascontiguousarray(rotation))
        return turns

    def bone_motions(self, turns: Tensor, shape: Tensor) -> Tensor:
        """Return each bone's transform of points at rest for P poses, [P, bones, 3, 4].

        turns: [P, bones, 3, 3]. shape: [P, shapes].
        """
        heads = self.heads + torch.einsum("ps,sbd->pbd", shape, self.head_shapes)
        whole, positions = [turns[:, :1]], [heads[:, :1]]
        first = 1
        for above, parents in self.levels:
            own = slice(first, first + len(parents))
            lever = heads[:, own] - heads[:, above][:, parents]
            turned = whole[-1][:, parents]
            positions.append(positions[-1][:, parents] + (turned @ lever[..., None])[..., 0])
            whole.append(turned @ turns[:, own])
            first = own.stop
        rotations = torch.cat(whole, dim=1)
        shift = torch.cat(positions, dim=1)[..., None] - rotations @ heads[..., None]
        return torch.cat([rotations, shift], dim=3)

    def posed(self, skin: Skin, motions: Tensor, shape: Tensor) -> tuple[Tensor, Tensor]:
        """Return points and normals [P, N, 3] of `skin`, moved by `bone_motions`; shape: [P, shapes]."""
        rest = skin.rest + torch.einsum("ps,snd->pnd", shape, skin.shapes)
        blend = (skin.weights @ motions.flatten(2)).reshape(len(motions), -1, 3, 4)
        points = (blend[..., :3] @ rest[..., None])[..., 0] + blend[..., 3]
        normals = (blend[..., :3] @ skin.normals[..., None])[..., 0]
        return points, torch.nn.functional.normalize(normals, dim=2)


def fitting_body() -> FittingBody:
    """Build the model in some seconds. Raises MissingLibrary without Anny, BadConfig if its cache cannot be used."""
    with torch.inference_mode():
        anny = load_anny()
        who = [person(index).phenotype() for index in range(_PEOPLE)]
        table = {name: torch.tensor([one[name] for one in who], dtype=torch.float64) for name in who[0]}
        table["height"] = torch.arange(_PEOPLE, dtype=torch.float64) * 0.618034 % 1
        shapes = anny.get_phenotype_blendshape_coefficients(**table)
        vertices = _people(anny.template_vertices, anny.blendshapes, shapes)
        heads = _people(anny.template_bone_heads, anny.bone_heads_blendshapes, shapes)
        mean, shape_vertices, shape_heads = _main_shapes(vertices, heads)
        weights, faces = anny.dense_vertex_bone_weights.clone(), anny.faces.numpy().astype(np.int32)
        parents = [int(parent) for parent in anny.bone_parents]
    order, levels = _by_depth(parents)
    bones = {anny.bone_labels[bone]: index for index, bone in enumerate(order)}
    mesh = Mesh("the open body", mean[0].numpy(), faces)
    normals = torch.from_numpy(mesh.vertex_normals)

    mean_heads, weights = mean[1][order], weights[:, order]
    above = [order.index(parents[bone]) if parents[bone] >= 0 else -1 for bone in order]
    lengths, head_lengths = length_shapes(bones, above, mean_heads, weights, mean[0])
    everywhere = Skin(weights, mean[0], normals, torch.cat([shape_vertices, lengths]))
    landmarks = load_landmarks("open").for_mesh(mesh)
    body = mesh.pieces()
    skin_vertices = np.flatnonzero(body == np.bincount(body[landmarks]).argmax())
    sampled = skin_vertices[farthest(mesh.vertices[skin_vertices], _POINTS)]
    return FittingBody(
        bones,
        levels,
        mean_heads,
        torch.cat([shape_heads[:, order], head_lengths]),
        *_joints(bones, mean_heads),
        everywhere.at(sampled),
        landmarks,
        mean_geodesic(mesh)[sampled],
        mesh,
        skin_vertices,
        everywhere,
    )


def _by_depth(parents: Sequence[int]) -> tuple[list[int], list[tuple[slice, Tensor]]]:
    """Sort bones by depth below the root, the only one without a parent (-1); returns also `FittingBody.levels`."""
    depth: list[int] = []
    for parent in parents:  # which comes before its children
        depth.append(0 if parent < 0 else depth[parent] + 1)
    order = sorted(range(len(parents)), key=lambda bone: (depth[bone], bone))
    levels = []
    first = 0
    for level in range(1, max(depth) + 1):
        above = [bone for bone in order if depth[bone] == level - 1]
        own = [bone for bone in order if depth[bone] == level]
        indices = torch.tensor([above.index(parents[bone]) for bone in own])
        levels.append((slice(first, first + len(above)), indices))
        first += len(above)
    return order, levels


def _people(template: Tensor, shapes: Tensor, coefficients: Tensor) -> Tensor:
    """Return points [people, N, 3] in the body frame, metres."""
    return (template + torch.einsum("ps,snd->pnd", coefficients, shapes)) @ torch.from_numpy(BODY_FROM_ANNY.T)


def _main_shapes(vertices: Tensor, heads: Tensor) -> tuple[tuple[Tensor, Tensor], Tensor, Tensor]:
    """Compute the mean person and the principal components of people, scaled to a standard deviation each.

    Returns (mean vertices [V, 3], mean heads [B, 3]), components [shapes, V, 3] and [shapes, B, 3].
    """
    mean = vertices.mean(dim=0), heads.mean(dim=0)
    away, away_heads = vertices - mean[0], heads - mean[1]
    flat = away.reshape(len(away), -1)
    vectors = torch.linalg.eigh(flat @ flat.T).eigenvectors
    # A component times its standard deviation is the deviations' mean, weighted by the eigenvector.
    mix = vectors.flip(1)[:, :_SHAPES].T / len(away) ** 0.5
    return mean, torch.einsum("sp,pnd->snd", mix, away), torch.einsum("sp,pbd->sbd", mix, away_heads)


def _joints(bones: Mapping[str, int], heads: Tensor) -> tuple[Tensor, Tensor]:
    """Return turns and deviations of the movements, in each of which bones turn together about one axis."""
    turns: list[Tensor] = []
    deviation: list[float] = []
    eye = torch.eye(3, dtype=torch.float64)

    def movement(shares: Mapping[str, float], axis: Tensor, usual: float) -> None:
        turn = torch.zeros((len(bones), 3), dtype=torch.float64)
        for bone, share in shares.items():
            turn[bones[bone]] = axis * share
        turns.append(turn)
        deviation.append(usual)

    def free(shares: Mapping[str, float], usual: float, axes: Iterable[Tensor] = eye) -> None:
        for axis in axes:
            movement(shares, axis, usual)

    free({"root": 1}, 0.3)
    free({"spine05": 0.3, "spine04": 0.3, "spine03": 0.4}, 0.25)
    free({"spine02": 0.6, "spine01": 0.4}, 0.2)
    free({"neck01": 0.2, "neck02": 0.2, "neck03": 0.2, "head": 0.4}, 0.35)
    for side in ("L", "R"):
        at = {bone.removesuffix(f".{side}"): heads[index] for bone, index in bones.items() if bone.endswith(f".{side}")}
        upper, fore = (
            _unit(at["lowerarm01"] - at["upperarm01"]),
            _unit(at["wrist"] - at["lowerarm01"]),
        )
        elbow, knuckles = _unit(torch.linalg.cross(upper, fore)), _unit(at["finger5-1"] - at["finger2-1"])
        free({f"clavicle.{side}": 1}, 0.12)
        free({f"upperarm01.{side}": 1}, 0.5)
        movement({f"upperarm02.{side}": 1}, upper, 0.3)
        movement({f"lowerarm01.{side}": 1}, elbow, 0.6)
        movement({f"lowerarm01.{side}": 1}, torch.linalg.cross(elbow, fore), 0.06)
        movement({f"lowerarm01.{side}": 1 / 3, f"lowerarm02.{side}": 1 / 3, f"wrist.{side}": 1 / 3}, fore, 0.6)
        free({f"wrist.{side}": 1}, 0.3, (knuckles, _unit(torch.linalg.cross(knuckles, fore))))
        bend = {f"finger{finger}-{joint}.{side}": share for finger in (2, 3, 4, 5) for joint, share in _CURL}
        movement(bend, knuckles if side == "L" else -knuckles, 0.4)
        free({f"upperleg01.{side}": 1}, 0.4)
        movement({f"lowerleg01.{side}": 1}, eye[0], 0.6)
        free({f"lowerleg01.{side}": 1}, 0.06, eye[1:])
        free({f"foot.{side}": 1}, 0.25)
    return torch.stack(turns), torch.tensor(deviation, dtype=torch.float64)


def _unit(vector: Tensor) -> Tensor:
    return torch.nn.functional.normalize(vector, dim=0)
