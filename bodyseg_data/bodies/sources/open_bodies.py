"""The default bodies, made from the open model Anny: one person in 71 postures, two in motion, 583 people standing.

Anny (PyPI, Apache-2.0) carries its mesh data in the package, so nothing is downloaded. The first use on a machine
parses that data for about 12 seconds and keeps the result in ~/.cache/anny (or ANNY_CACHE_DIR); later ones take two.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.anny.library import BODY_FROM_ANNY, load_anny, no_anny, one_thread
from bodyseg_data.bodies.anny.people import PEOPLE, SUBJECT_A, Person, person, standing_pose
from bodyseg_data.bodies.anny.postures import POSTURES
from bodyseg_data.bodies.anny.skeleton import Pose, bone_rotations
from bodyseg_data.bodies.clothes.outfits import OUTFITS, Outfit
from bodyseg_data.bodies.motions.catalogue import MOTIONS, SUBJECTS, Motion
from bodyseg_data.bodies.source import Body, BodyRef, ListedBodies
from bodyseg_data.core.splits import split_by_motion, split_by_order
from bodyseg_data.meshes.mesh import Mesh

if TYPE_CHECKING:
    import torch

    from bodyseg_data.bodies.clothes.refining import Refinement
    from bodyseg_data.bodies.clothes.wardrobe import Wardrobe

_DECIMALS: Final = 6
_CROWN_M: Final = 0.06  # generous: the highest and lowest vertices of people differ by far less in height


@dataclass(frozen=True)
class Figure:
    """Complete description of one body. height_m: of its lowest point above the floor. outfit: None for no clothes."""

    who: Person
    pose: Pose
    height_m: float = 0.0
    outfit: Outfit | None = None


class MadeBodies(ListedBodies[Callable[[], Figure]]):
    """Bodies that are made on demand, each from its figure."""

    def __init__(self, name: str, figures: Mapping[BodyRef, Callable[[], Figure]]) -> None:
        """figures: called for one body at a time, so that listing bodies computes no pose."""
        super().__init__(figures)
        self.name = name
        self._model: _Model | None = None

    def figure(self, body: BodyRef) -> Figure:
        """Return the description of one of `bodies()`. Raises BadConfig for a body of another source."""
        return self.entry(body)()

    def fingerprint(self, bodies: Sequence[BodyRef]) -> str:
        """Return a digest of persons, poses, outfits, landmarks and the version of Anny. Raises MissingLibrary."""
        from bodyseg_data.meshes.landmarks.by_vertex import load_landmarks

        try:
            version = importlib.metadata.version("anny")
        except importlib.metadata.PackageNotFoundError as error:
            raise no_anny(error) from error
        figures = [self.figure(body) for body in bodies]
        return hashlib.sha256(repr((version, load_landmarks("open").vertices, figures)).encode()).hexdigest()

    def build(self, body: BodyRef, dressed: bool = True) -> Body:
        """Build a mesh of 13 718 vertices and 27 420 triangles over the origin, its lowest point at y = height_m.

        A dressed body has smaller triangles where its outfit folds, about 22 000 vertices; the first 13 718 are those
        of all bodies. dressed: False takes the outfit off and leaves the triangles. The same bits in every process.
        Raises BadConfig for a body of another source or if Anny's cache cannot be used, MissingLibrary without Anny.
        """
        from bodyseg_data.meshes.landmarks.by_vertex import load_landmarks

        figure = self.figure(body)
        if self._model is None:
            self._model = _Model()
        vertices, faces = self._model.surface(figure, dressed)
        return Body(Mesh(body.mesh, vertices, faces), np.array(load_landmarks("open").vertices, np.int64))


class OpenBodies(MadeBodies):
    """Open bodies in place of the paper's subsets, 2 329 in all.

    A: one man in 71 postures. B and C: a man and a woman, dressed, in four motions each. people: 583 people standing
    with their arms a little off.
    """

    def __init__(self) -> None:
        super().__init__("open", _figures(dressed=True))


class BareBodies(MadeBodies):
    """The bodies of `OpenBodies`, B and C without clothes, to measure the effect of clothes."""

    def __init__(self) -> None:
        super().__init__("bare", _figures(dressed=False))


def _figures(dressed: bool) -> dict[BodyRef, Callable[[], Figure]]:
    moving = (each for subject in MOTIONS for each in _moving(subject, dressed))
    return dict([*_postures(), *moving, *_people()])


_Listed = Iterator[tuple[BodyRef, Callable[[], Figure]]]


def _postures() -> _Listed:
    for index, (name, pose) in enumerate(POSTURES):
        ref = BodyRef("A", "A", f"posture-{index:02d}", name, split_by_order("A", index))
        yield ref, partial(Figure, SUBJECT_A, pose)


def _moving(subject: Literal["B", "C"], dressed: bool) -> _Listed:
    for name, motion in MOTIONS[subject].items():
        split = split_by_motion(subject, name)
        for index in range(motion.frames):
            ref = BodyRef(subject, subject, f"{subject}-{name}-{index:03d}", name, split)
            yield ref, partial(_moved, subject, motion, index, OUTFITS[subject] if dressed else None)


def _moved(subject: Literal["B", "C"], motion: Motion, index: int, outfit: Outfit | None) -> Figure:
    frame = motion.frame(index)
    return Figure(SUBJECTS[subject], frame.pose, frame.height_m, outfit)


def _people() -> _Listed:
    for index in range(PEOPLE):
        ref = BodyRef("people", f"P{index:03d}", f"person-{index:03d}", "standing", split_by_order("people", index))
        yield ref, partial(_person, index)


def _person(index: int) -> Figure:
    return Figure(person(index), standing_pose(index))


class _Model:
    """The body model Anny, evaluated for one body at a time."""

    def __init__(self) -> None:
        self._anny = load_anny()
        import torch

        self._torch = torch
        self._faces: NDArray[np.int32] = self._anny.faces.numpy().astype(np.int32)
        self._heights, self._height_shapes = self._crown_and_soles()
        self._wardrobe = lru_cache(maxsize=4)(self._cut)
        self._bones = {bone: index for index, bone in enumerate(self._anny.bone_labels)}

    def surface(self, figure: Figure, dressed: bool) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Return vertices [V, 3], metres, body frame, and faces [F, 3] of a figure, with its outfit or without."""
        vertices, faces = self._posed(figure.who, figure.pose), self._faces
        if figure.outfit is not None:
            finer, wardrobe = self._wardrobe(figure.who, figure.outfit)
            vertices, faces = finer(vertices), finer.faces
            if dressed:
                vertices = wardrobe.worn(vertices)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        offset = np.array([(low[0] + high[0]) / 2, low[1] - figure.height_m, (low[2] + high[2]) / 2])
        # To the micrometre, which hides nearly all differences between processors in the last bits.
        rounded: NDArray[np.float64] = np.round(vertices - offset, _DECIMALS) + 0.0  # which makes -0 into 0
        return rounded, faces

    def _posed(self, who: Person, pose: Pose) -> NDArray[np.float64]:
        with one_thread(), self._torch.inference_mode():
            shape = who.phenotype() | {"height": self._height(who)}
            output = self._anny(self._pose_parameters(pose), shape)
            vertices: NDArray[np.float64] = output["vertices"][0].numpy() @ BODY_FROM_ANNY.T
        return vertices

    def _cut(self, who: Person, outfit: Outfit) -> tuple[Refinement, Wardrobe]:
        """Refine the triangles for an outfit's folds and cut it, both for one person; takes about a second."""
        from bodyseg_data.bodies.clothes.refining import Refinement
        from bodyseg_data.bodies.clothes.wardrobe import FINE_M, Wardrobe

        rest = self._posed(who, Pose())
        finer = Refinement(rest, self._faces, FINE_M)
        return finer, Wardrobe(finer(rest), finer.faces, outfit)

    def _crown_and_soles(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return heights [N] of possibly highest or lowest vertices, and each shape's shift of them [shapes, N]."""
        heights = self._anny.template_vertices[:, 2]
        extreme = (heights > heights.max() - _CROWN_M) | (heights < heights.min() + _CROWN_M)
        return heights[extreme], self._anny.blendshapes[:, extreme, 2].clone()

    def _height(self, who: Person) -> float:
        """Return the height parameter that gives a person's stature, which is linear in it."""
        ends = self._torch.tensor([0.0, 1.0], dtype=self._torch.float64)
        shapes = self._anny.get_phenotype_blendshape_coefficients(**who.phenotype(), height=ends)
        rest = (self._heights + shapes @ self._height_shapes).numpy()
        short, tall = (rest.max(axis=1) - rest.min(axis=1)).tolist()
        return float(np.clip((who.stature_m - short) / (tall - short), 0, 1))

    def _pose_parameters(self, pose: Pose) -> torch.Tensor:
        """Return Anny's pose [1, bones, 4, 4]: rotations in axes aligned with the world, each in its parent's frame."""
        turns = np.tile(np.eye(4), (1, len(self._bones), 1, 1))
        for bone, rotation in bone_rotations(pose).items():
            turns[0, self._bones[bone], :3, :3] = BODY_FROM_ANNY.T @ rotation @ BODY_FROM_ANNY
        return self._torch.from_numpy(turns)
