"""Sampler of everyday poses of one person: a stance, then each arm sent to a place, rejected where skin meets skin."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.anny.posable import Posable
from bodyseg_data.bodies.anny.skeleton import Arm, Leg, Pose, Trunk, bone_rotations
from bodyseg_data.bodies.contacts import arms
from bodyseg_data.bodies.contacts.limbs import Base, Limb, Side
from bodyseg_data.bodies.contacts.places import Places
from bodyseg_data.bodies.contacts.ranges import CROSSED_TWIST, LEG, uniform, within
from bodyseg_data.bodies.contacts.reaching import Goal, Reach
from bodyseg_data.bodies.contacts.stances import STANCES, LegTask, Stance
from bodyseg_data.bodies.contacts.surface import Skin, deepest_m, vertex_normals

Floats = NDArray[np.float64]

DEEPEST_M: Final = 0.012
"""Depth of skin in skin beyond which a pose is rejected."""

_MISS_M: Final = 0.02  # of a foot or hand from its place
_GAP_M: Final = 0.004
_PRESSED_M: Final = 0.01  # by which flesh gives way on the floor
_BELOW_M: Final = 0.015  # below the floor, beyond which a pose is rejected
_ATTEMPTS: Final = 40
_ARM_TRIES: Final = 5
_ALL: Final = np.ones(3)
_HEIGHT: Final = np.array([0.0, 1.0, 0.0])
_UP: Final = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Drawn:
    """Result of a search for a pose. contacts: what each arm does, left first. attempts: poses drawn until this one was
    accepted. deepest_m: of skin in skin.
    """

    pose: Pose
    contacts: tuple[str, str]
    attempts: int
    deepest_m: float


class Sampler:
    """Poses of one person."""

    def __init__(self, person: Posable) -> None:
        self._person = person
        self._places = Places(person)
        self._normals = vertex_normals(person.modelled, person.faces)
        self._legs: dict[Side, Limb] = {"L": Limb(person, "leg", "L"), "R": Limb(person, "leg", "R")}
        self._arms: dict[Side, Limb] = {"L": Limb(person, "arm", "L"), "R": Limb(person, "arm", "R")}
        limbs = [*self._legs.values(), *self._arms.values()]
        self._trunk = self._places.solid & ~np.any([limb.vertices for limb in limbs], axis=0)
        lifted = np.any(
            [*(leg.far for leg in self._legs.values()), *(arm.vertices for arm in self._arms.values())], axis=0
        )
        self._resting = self._places.solid & ~lifted
        turns, heads = person.placed(bone_rotations(Pose()))
        self._leg_m = float(heads[0, 1] - person.vertices(turns, heads)[self._places.solid, 1].min())

    def draw(self, stance: str, draws: np.random.Generator) -> Drawn:
        """Draw a pose. Of many rejected ones, in the end, the one with the least depth is returned."""
        best: Drawn | None = None
        for attempt in range(1, _ATTEMPTS + 1):
            found = self._attempt(STANCES[stance], draws)
            if found is None:
                continue
            pose, contacts, deepest = found
            if best is None or deepest < best.deepest_m:
                best = Drawn(pose, contacts, attempt, deepest)
            if deepest <= DEEPEST_M:
                break
        return best or Drawn(Pose(), ("hanging", "hanging"), _ATTEMPTS, 0.0)

    def _attempt(self, stance: Stance, draws: np.random.Generator) -> tuple[Pose, tuple[str, str], float] | None:
        legs = self._with_legs(stance, draws)
        if legs is None:
            return None
        pose, floor = legs
        contacts: dict[Side, str] = {}
        first: Side = "L" if draws.random() < 0.5 else "R"
        for side in (first, _other(first)):
            pose, contacts[side] = self._with_arm(pose, side, stance, floor, side != first, draws)
        vertices, normals = self._posed(pose)
        if vertices[self._places.solid, 1].min() < floor - _BELOW_M:
            return None
        limbs = [*self._legs.values(), *self._arms.values()]
        return pose, (contacts["L"], contacts["R"]), deepest_m(vertices, normals, limbs, self._places.solid)

    def _with_legs(self, stance: Stance, draws: np.random.Generator) -> tuple[Pose, float] | None:
        """Return a pose with hanging arms and the floor's height, or None if a leg does not reach."""
        trunk = Trunk(**within(stance.trunk, draws))
        first: Side = "L" if draws.random() < 0.5 else "R"
        if trunk.roll:  # the leg on top lies on the other
            first = "R" if trunk.roll > 0 else "L"
        pair = stance.legs[int(draws.random() * len(stance.legs))]
        tasks: dict[Side, LegTask] = {first: pair[0], _other(first): pair[1]}
        starts = {side: Leg(**within(task.start, draws)) for side, task in tasks.items()}
        pose = Pose(trunk, Arm(), Arm(), starts["L"], starts["R"])
        turns, heads = self._person.placed(bone_rotations(pose))
        vertices = self._person.vertices(turns, heads)
        if stance.pelvis is not None:
            floor = float(heads[0, 1]) - uniform(draws, *stance.pelvis) * self._leg_m
        else:
            floor = float(vertices[self._resting, 1].min()) + _PRESSED_M
        chest = heads[self._person.numbers["spine02"]] - heads[0]
        under = 0.8 * chest[[0, 2]] if stance.balanced else np.zeros(2)
        done = self._trunk.copy()
        for side in (_other(first), first):  # the first one may touch the other
            limb, task = self._legs[side], tasks[side]
            vertices, normals = self._posed(pose)
            goals = self._leg_goals(task, side, heads, under, floor, vertices, normals, draws)
            base = Base(turns[limb.base_bone], heads[limb.base_bone], turns[0])
            ranges = {name: LEG[name] for name in ("flex", "abduct", "twist", "knee")}
            if "planted" in task.start:
                ranges["ankle"] = LEG["ankle"]
            if task.start.get("twist", (0, 0))[1] > LEG["twist"][1]:
                ranges["twist"] = CROSSED_TWIST
            obstacles = Skin(vertices, normals, done & self._places.solid)
            reached = Reach(limb, base, self._normals, goals, obstacles, floor)(starts[side], ranges)
            if reached.miss_m > _MISS_M:
                return None
            pose = replace(pose, **{"left_leg" if side == "L" else "right_leg": reached.angles})
            done |= limb.vertices
        return pose, floor

    def _leg_goals(
        self,
        task: LegTask,
        side: Side,
        heads: Floats,
        under: Floats,
        floor: float,
        vertices: Floats,
        normals: Floats,
        draws: np.random.Generator,
    ) -> list[Goal]:
        goals = []
        if task.out is not None:
            hip = heads[self._person.numbers[f"upperleg01.{side}"]]
            sign = 1 if side == "L" else -1
            x = hip[0] + under[0] + sign * uniform(draws, *task.out)
            z = hip[2] + under[1] + uniform(draws, *task.ahead)
            sole = self._places.on("sole", side)
            middle = sole[len(sole) // 2]
            goals.append(Goal(int(middle), np.array([x, floor, z]), _ALL))
        for name in task.floor:
            vertex = _one_of(self._places.on(name, side), draws)
            goals.append(Goal(vertex, np.array([0, floor, 0]), _HEIGHT, -_UP))
        if task.by:
            vertex = _one_of(self._places.on(task.by, side), draws)
            name = task.touch[int(draws.random() * len(task.touch))]
            at = _one_of(self._places.on(name, _other(side)), draws)
            goals.append(Goal(vertex, vertices[at] + _GAP_M * normals[at], _ALL, -normals[at]))
        return goals

    def _with_arm(
        self, pose: Pose, side: Side, stance: Stance, floor: float, other_placed: bool, draws: np.random.Generator
    ) -> tuple[Pose, str]:
        """Return the pose with one arm sent to a place, and the place; hanging if five places cannot be reached."""
        limb, other = self._arms[side], self._arms[_other(side)]
        turns, heads = self._person.placed(bone_rotations(pose))
        vertices = self._person.vertices(turns, heads)
        normals = vertex_normals(vertices, self._person.faces)
        solid = self._places.solid & ~limb.vertices
        if not other_placed:
            solid &= ~other.vertices
        obstacles = Skin(vertices, normals, solid)
        base = Base(turns[limb.base_bone], heads[limb.base_bone], turns[0])
        chest = self._person.numbers["spine02"]
        body = arms.Body(
            side, self._places, vertices, normals, heads, turns[chest], floor, stance.seat, other_placed,
            heads[self._person.numbers[f"upperarm01.{side}"]], heads[chest],
        )  # fmt: skip
        for _ in range(_ARM_TRIES):
            task = arms.drawn(body, stance.floor_hands, draws)
            reach = Reach(limb, base, self._normals, task.goals, obstacles, floor)
            start = min((task.begun(preset, draws) for preset in task.presets), key=reach.miss_m)
            reached = reach(start, task.ranges)
            if reached.miss_m <= _MISS_M and reach.depth_m(reached.angles) <= DEEPEST_M:
                return replace(pose, **{"left_arm" if side == "L" else "right_arm": reached.angles}), task.name
        return pose, "hanging"

    def _posed(self, pose: Pose) -> tuple[Floats, Floats]:
        vertices = self._person.vertices(*self._person.placed(bone_rotations(pose)))
        return vertices, vertex_normals(vertices, self._person.faces)


def _other(side: Side) -> Side:
    return "R" if side == "L" else "L"


def _one_of(vertices: NDArray[np.int64], draws: np.random.Generator) -> int:
    return int(vertices[int(draws.random() * len(vertices))])
