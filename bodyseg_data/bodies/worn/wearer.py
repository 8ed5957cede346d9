"""The posed person that garments, hair, shoes and things are made for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.anny.posable import Posable
from bodyseg_data.bodies.anny.skeleton import Pose, bone_rotations
from bodyseg_data.bodies.contacts.limbs import Side
from bodyseg_data.bodies.contacts.places import Places
from bodyseg_data.bodies.contacts.surface import vertex_normals
from bodyseg_data.core.parts import LANDMARKS
from bodyseg_data.meshes.landmarks.by_vertex import load_landmarks

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ARM: Final = ("upperarm", "lowerarm", "wrist", "metacarpal", "finger")


@dataclass(frozen=True)
class MovedPart:
    """A part of the body that moved as a whole from rest to the pose: posed = turn @ rest + shift."""

    turn: Floats
    shift: Floats

    def __call__(self, rest: Floats) -> Floats:
        """Move points [..., 3] from the person at rest to the pose."""
        return np.asarray(rest @ self.turn.T + self.shift, np.float64)


class Wearer:
    """A person in a pose. points: float64 [V, 3], metres, the open body's own vertices, dressed as far as clothes are
    its surface. rest: the same person standing straight, bare. normals: [V, 3] of `points`. floor: height of the lowest
    point. solid: bool [V], skin, which leaves out eyes and mouth.
    """

    def __init__(self, person: Posable, points: Floats, places: Places) -> None:
        self.points, self.places = points, places
        self.rest = person.vertices(*person.placed(bone_rotations(Pose())))
        self.normals = vertex_normals(points, person.faces)
        self.floor = float(points[np.unique(person.faces), 1].min())
        self.solid = places.solid
        self._bones = np.array([person.bones[bone] for bone in person.owner])
        self._at = dict(zip(LANDMARKS, load_landmarks("open").vertices, strict=True))

    def of(self, *bones: str, side: Side | None = None) -> Mask:
        """Mark the skin that bones whose names begin like this move most, of one side or all, bool [V]."""
        named = np.any([np.char.startswith(self._bones, bone) for bone in bones], axis=0)
        if side is not None:
            named &= np.char.endswith(self._bones, f".{side}")
        return np.asarray(self.solid & named, np.bool_)

    @cached_property
    def arms(self) -> Mask:
        """Both arms and hands, bool [V]."""
        return self.of(*_ARM)

    def landmark(self, name: str) -> Floats:
        """A landmark at rest, [3], metres."""
        return np.asarray(self.rest[self._at[name]], np.float64)

    def frame(self, of: Mask) -> MovedPart:
        """The rigid motion from rest to the pose that fits vertices best (Kabsch 1976)."""
        rest, posed = self.rest[of], self.points[of]
        u, _, v = np.linalg.svd((rest - rest.mean(axis=0)).T @ (posed - posed.mean(axis=0)))
        turn = v.T @ np.diag([1.0, 1.0, np.linalg.det(v.T @ u.T)]) @ u.T
        return MovedPart(turn, posed.mean(axis=0) - turn @ rest.mean(axis=0))

    @cached_property
    def head(self) -> MovedPart:
        """The head's motion."""
        return self.frame(self.of("head"))
