"""One arm or leg of a person: the positions of points of its skin as functions of its joint angles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.anny.posable import Posable
from bodyseg_data.bodies.anny.skeleton import Arm, Leg, arm_rotations, finger_rotations, leg_rotations

Floats = NDArray[np.float64]
Side = Literal["L", "R"]

_MIRROR: Final = np.diag([-1.0, 1.0, 1.0])
_ARM_BONES: Final = ("clavicle", "shoulder01", "upperarm01", "upperarm02", "lowerarm01", "lowerarm02", "wrist")
_FINGERS: Final = tuple(
    bone
    for finger in range(1, 6)
    for bone in (f"metacarpal{finger}", *(f"finger{finger}-{part}" for part in (1, 2, 3)))
)
_LEG_BONES: Final = ("upperleg01", "upperleg02", "lowerleg01", "lowerleg02", "foot")
_TOES: Final = tuple(f"toe{toe}-{part}" for toe in range(1, 6) for part in (1, 2, 3))
_TORSO_BONES: Final = 2  # clavicle and shoulder01, whose skin is the trunk's
_PROBES: Final = 40


@dataclass(frozen=True)
class Base:
    """The bone that a limb hangs from. turn: [3, 3], head: [3], body frame. root: [3, 3], the pelvis's turn."""

    turn: Floats
    head: Floats
    root: Floats


class Limb:
    """An arm or a leg.

    vertices: bool [V], its skin. far: bool [V], the skin from a little above elbow or knee on. probes: int [N], a few
    of the far vertices, evenly spread.
    """

    def __init__(self, person: Posable, kind: Literal["arm", "leg"], side: Side) -> None:
        self.kind, self.side = kind, side
        upper, ends = (_ARM_BONES, _FINGERS) if kind == "arm" else (_LEG_BONES, _TOES)
        self._person = person
        self._names = [bone for bone in (*upper, *ends) if f"{bone}.{side}" in person.numbers]
        self._bones = np.array([person.numbers[f"{bone}.{side}"] for bone in self._names])
        local = {bone: index for index, bone in enumerate(self._bones)}
        self._parents = [local.get(person.parents[bone], -1) for bone in self._bones]
        self._upper = len(upper)
        self._bone_offsets = person.heads[self._bones] - person.heads[person.parents[self._bones]]
        self._ends: dict[float, tuple[Floats, Floats]] = {}
        self.base_bone = int(person.parents[self._bones[0]])
        self._local = np.full(len(person.bones), -1)
        self._local[self._bones] = np.arange(len(self._bones))
        skinned = self._bones[_TORSO_BONES if kind == "arm" else 0 :]
        self.vertices: NDArray[np.bool_] = np.isin(person.owner, skinned)
        joint = upper.index("lowerarm01" if kind == "arm" else "lowerleg01")
        beyond = np.isin(person.owner, self._bones[joint:])
        middle = person.owner == self._bones[joint - 1]
        bone = person.heads[self._bones[joint]] - person.heads[self._bones[joint - 1]]
        along = self._offsets(np.flatnonzero(middle)) @ bone / (bone @ bone)
        self.far: NDArray[np.bool_] = beyond.copy()
        self.far[np.flatnonzero(middle)[along > 0.6]] = True
        end = np.isin(person.owner, self._bones[upper.index("wrist" if kind == "arm" else "foot") :])
        self.probes = np.concatenate(
            [_spread(person.modelled, np.flatnonzero(of), _PROBES) for of in (self.far & ~end, end)]
        )

    def _offsets(self, vertices: NDArray[np.int64]) -> Floats:
        person, own = self._person, self._person.owner[vertices]
        offsets = person.modelled[vertices] - person.modelled_heads[own]
        return np.asarray(np.einsum("nij,nj->ni", person.reference[own], offsets), np.float64)

    def points(self, vertices: NDArray[np.int64], normals: Floats) -> LimbPoints:
        """Return points of this limb's skin, to be moved with it. normals: [N, 3], of the modelled surface."""
        own = self._person.owner[vertices]
        turned = np.einsum("nij,nj->ni", self._person.reference[own], normals)
        return LimbPoints(self._local[own], self._offsets(vertices), turned)

    def bones(self, angles: Arm | Leg, base: Base) -> tuple[Floats, Floats]:
        """Return turns [B, 3, 3] and heads [B, 3] of this limb's bones in the body frame."""
        mirrored = self.side == "R"
        if isinstance(angles, Arm):
            rotations = arm_rotations(angles)
        else:
            rotations = leg_rotations(angles, _MIRROR @ base.root @ _MIRROR if mirrored else base.root)
        turns, heads = np.empty((len(self._names), 3, 3)), np.empty((len(self._names), 3))
        for index in range(self._upper):
            above, at = (base.turn, base.head) if index == 0 else (turns[index - 1], heads[index - 1])
            own = rotations[self._names[index]] if self._names[index] in rotations else np.eye(3)
            heads[index] = at + above @ self._bone_offsets[index]
            turns[index] = above @ (_MIRROR @ own @ _MIRROR if mirrored else own)
        end_turns, end_heads = self._end(angles.fist if isinstance(angles, Arm) else angles.toes)
        last = turns[self._upper - 1]
        turns[self._upper :] = last @ end_turns
        heads[self._upper :] = heads[self._upper - 1] + end_heads @ last.T
        return turns, heads

    def _end(self, bend: float) -> tuple[Floats, Floats]:
        """Return turns and heads of the fingers or toes relative to hand or foot. bend: fist or toes."""
        if bend not in self._ends:
            arm = self.kind == "arm"
            rotations = finger_rotations(Arm(fist=bend)) if arm else leg_rotations(Leg(toes=bend), np.eye(3))
            turns, heads = np.empty((len(self._names), 3, 3)), np.empty((len(self._names), 3))
            turns[self._upper - 1], heads[self._upper - 1] = np.eye(3), 0
            for index in range(self._upper, len(self._names)):
                parent, own = self._parents[index], rotations.get(self._names[index], np.eye(3))
                heads[index] = heads[parent] + turns[parent] @ self._bone_offsets[index]
                turns[index] = turns[parent] @ (_MIRROR @ own @ _MIRROR if self.side == "R" else own)
            self._ends[bend] = turns[self._upper :], heads[self._upper :]
        return self._ends[bend]


@dataclass(frozen=True)
class LimbPoints:
    """Points fixed to bones of a limb. bones: int [N], within the limb. offsets, normals: [N, 3], reference pose."""

    bones: NDArray[np.int64]
    offsets: Floats
    normals: Floats

    def moved(self, turns: Floats, heads: Floats) -> Floats:
        """Return positions [N, 3], metres."""
        return np.asarray(heads[self.bones] + np.einsum("nij,nj->ni", turns[self.bones], self.offsets), np.float64)

    def facing(self, turns: Floats) -> Floats:
        """Return normals [N, 3]."""
        return np.asarray(np.einsum("nij,nj->ni", turns[self.bones], self.normals), np.float64)


def _spread(points: Floats, among: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Choose `count` vertices far from each other, the farthest from those before it one by one."""
    chosen = [int(among[0])]
    nearest = np.linalg.norm(points[among] - points[chosen[0]], axis=1)
    for _ in range(count - 1):
        chosen.append(int(among[nearest.argmax()]))
        nearest = np.minimum(nearest, np.linalg.norm(points[among] - points[chosen[-1]], axis=1))
    return np.array(chosen)


def other(side: Side) -> Side:
    """Return the opposite side."""
    return "R" if side == "L" else "L"
