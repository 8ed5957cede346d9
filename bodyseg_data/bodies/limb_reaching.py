"""Inverse kinematics of one limb: joint angles that bring points of its skin to goals, within the joints' ranges.

Damped least squares (Levenberg-Marquardt) on the residuals of goals, of points that would go into the body or below the
floor, and, weakly, of the distance from a preferred posture, which settles what the goals leave open.
The skin is an obstacle: distances of points from it tell how deep limbs go into the rest of the body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.anny_model import Posable
from bodyseg_data.bodies.skeleton import Arm, Floats, Leg, arm_rotations, finger_rotations, leg_rotations, mirrored

Choice = TypeVar("Choice")

Ranges = dict[str, tuple[float, float]]
"""Least and most of an angle in degrees, or of a length in metres, by its name."""

ARM: Final[Ranges] = {
    "flex": (-60, 175), "abduct": (-30, 150), "twist": (-70, 90), "elbow": (0, 148), "supinate": (-80, 80),
    "wrist": (-60, 65),
}  # fmt: skip
LOADED_WRIST: Final = (-88.0, 65.0)
"""Of a hand that carries weight on the floor."""

LEG: Final[Ranges] = {
    "flex": (-25, 128), "abduct": (-28, 45), "twist": (-40, 45), "knee": (0, 135), "ankle": (-25, 48),
}  # fmt: skip
"""With those of the arm: ranges of healthy adults (docs/reference/open_bodies.md), a little narrower."""

CROSSED_TWIST: Final = (-40.0, 75.0)
"""Outward turn of the hips of people who sit with crossed legs, which goes beyond that of a straight leg."""

MOST_RAISED: Final = 185.0
"""Sum of an arm's flexion and abduction beyond which the shoulder would have to turn over."""

Side = Literal["L", "R"]

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

_REACH_M: Final = 0.2  # beyond this, a point's distance is of no interest

GAP_M: Final = 0.004
"""Gap between skin and skin that touch, and between skin and floor, metres."""

ALL_AXES: Final = np.ones(3)
"""Axes of a goal that matters alike in all directions."""

_NEAR_M: Final = 0.01  # a point this far from its goal counts as much as one residual
_FACING: Final = 1.2  # weight of skin that lies flat on its goal
_PREFERRED_DEG: Final = 90.0  # so far from the preferred posture counts as much as a point 1 cm from its goal
_RAISED_DEG: Final = 10.0
_RESTING: Final = 0.7  # weight of the height above the floor of what rests on it, as flesh gives way there
_ROUNDS: Final = 14
_STEP_DEG: Final = 0.5
_DONE: Final = 1e-3  # relative gain of a round below which the search ends


def within(ranges: Ranges, draws: np.random.Generator) -> dict[str, Any]:
    """Draw every value uniformly within its range."""
    return {name: uniform(draws, low, high) for name, (low, high) in ranges.items()}


def mostly_middle(ranges: Ranges, draws: np.random.Generator) -> dict[str, Any]:
    """Draw every value within its range, from a triangular distribution: the middle most often, the ends least."""
    return {name: uniform(draws, low, high) / 2 + uniform(draws, low, high) / 2 for name, (low, high) in ranges.items()}


def uniform(draws: np.random.Generator, low: float, high: float) -> float:
    """Draw a number from `low` to `high`."""
    return float(low + (high - low) * draws.random())


def one_of(vertices: NDArray[np.int64], draws: np.random.Generator) -> int:
    """Draw one of some vertices, each as likely."""
    return int(vertices[int(draws.random() * len(vertices))])


def chosen(weights: dict[Choice, float], draws: np.random.Generator) -> Choice:
    """Draw one of some choices with a chance in proportion to its weight."""
    sums = np.cumsum([*weights.values()])
    return [*weights][int(np.searchsorted(sums, draws.random() * sums[-1], side="right"))]


@dataclass(frozen=True)
class Base:
    """The bone that a limb hangs from. turn: [3, 3], head: [3], body frame. root: [3, 3], the pelvis's turn."""

    turn: Floats
    head: Floats
    root: Floats


class Limb:
    """An arm or a leg. vertices: bool [V], its skin. far: bool [V], the skin from a little above elbow or knee on.
    probes: int [N], a few of the far vertices, evenly spread.
    """

    def __init__(self, person: Posable, kind: Literal["arm", "leg"], side: Side) -> None:
        self.kind, self._seen = kind, mirrored if side == "R" else np.asarray
        upper, ends = (_ARM_BONES, _FINGERS) if kind == "arm" else (_LEG_BONES, _TOES)
        self._person = person
        self._names = [bone for bone in (*upper, *ends) if f"{bone}.{side}" in person.numbers]
        self._bones = np.array([person.numbers[f"{bone}.{side}"] for bone in self._names])
        self._local = np.full(len(person.bones), -1)
        self._local[self._bones] = np.arange(len(self._bones))
        self._parents = self._local[person.parents[self._bones]]
        self._upper = len(upper)
        self._bone_offsets = person.heads[self._bones] - person.heads[person.parents[self._bones]]
        self._ends: dict[float, tuple[Floats, Floats]] = {}
        self.base_bone = int(person.parents[self._bones[0]])
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
        groups = np.flatnonzero(self.far & ~end), np.flatnonzero(end)
        self.probes = np.concatenate([group[farthest(person.modelled[group], _PROBES)] for group in groups])

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
        rotations = arm_rotations(angles) if isinstance(angles, Arm) else leg_rotations(angles, self._seen(base.root))
        turns, heads = np.empty((len(self._names), 3, 3)), np.empty((len(self._names), 3))
        for index in range(self._upper):
            above, at = (base.turn, base.head) if index == 0 else (turns[index - 1], heads[index - 1])
            own = rotations.get(self._names[index], np.eye(3))
            heads[index] = at + above @ self._bone_offsets[index]
            turns[index] = above @ self._seen(own)
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
                turns[index] = turns[parent] @ self._seen(own)
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


def farthest(points: Floats, count: int) -> NDArray[np.int64]:
    """Return indices of at most `count` of `points` [N, 3], each farthest from those before it (Gonzalez 1985)."""
    chosen = np.zeros(min(count, len(points)), np.int64)
    away = np.full(len(points), np.inf)
    x, y, z = np.ascontiguousarray(points.T)  # a sum along rows of three would take most of the time
    for number in range(1, len(chosen)):
        last = chosen[number - 1]
        away = np.minimum(away, (x - x[last]) ** 2 + (y - y[last]) ** 2 + (z - z[last]) ** 2)
        chosen[number] = away.argmax()
    return chosen


def other(side: Side) -> Side:
    """Return the opposite side."""
    return "R" if side == "L" else "L"


class PosedSkin:
    """Part of a posed surface. Distances are those to the tangent plane at the nearest vertex."""

    def __init__(self, vertices: Floats, normals: Floats, of: NDArray[np.bool_]) -> None:
        """vertices, normals: [V, 3] of the whole body. of: bool [V], the part."""
        from scipy.spatial import cKDTree

        self._points, self._normals = vertices[of], normals[of]
        self._tree = cKDTree(self._points)

    def heights(self, points: Floats) -> Floats:
        """Return signed distances [N] of points [N, 3] above the skin, metres: below 0 inside, inf far away."""
        distance, nearest = self._tree.query(points, distance_upper_bound=_REACH_M)
        near = np.isfinite(distance)
        found = np.full(len(points), np.inf)
        offset = points[near] - self._points[nearest[near]]
        side = np.einsum("ij,ij->i", offset, self._normals[nearest[near]])
        # Outside, the distance to the vertex: its plane goes on beyond the rim of the part, where there is no skin.
        found[near] = np.where(side < 0, side, distance[near])
        return found


def deepest_m(vertices: Floats, normals: Floats, limbs: list[Limb], solid: NDArray[np.bool_]) -> float:
    """Return the depth in metres to which far ends of limbs go into the rest of the body, 0 if none does.

    vertices, normals: [V, 3]. solid: bool [V], vertices that can be gone into: not those of eyes and mouth.
    """
    deepest = 0.0
    for limb in limbs:
        heights = PosedSkin(vertices, normals, solid & ~limb.vertices).heights(vertices[limb.far])
        deepest = max(deepest, -float(heights.min()))
    return deepest


@dataclass(frozen=True)
class Goal:
    """Place for one point of a limb's skin. vertex: the point. place: [3], metres. axes: [3], weights of the
    directions in which it matters. facing: [3], unit vector that the skin there should look along, or None.
    """

    vertex: int
    place: Floats
    axes: Floats
    facing: Floats | None = None


@dataclass(frozen=True)
class Reached:
    """Result of a search. angles: the limb's. miss_m: the largest distance of a point from its goal, metres."""

    angles: Arm | Leg
    miss_m: float


class Reach:
    """One search: a limb on its base, among obstacles."""

    def __init__(
        self,
        limb: Limb,
        base: Base,
        normals: Floats,
        goals: Sequence[Goal],
        obstacles: PosedSkin,
        floor: float,
        resting: Sequence[NDArray[np.int64]] = (),
    ) -> None:
        """normals: [V, 3], of the modelled surface. floor: its height, metres. resting: groups of the limb's vertices,
        of each of which the lowest touches the floor.
        """
        self._limb, self._base, self._obstacles, self._floor = limb, base, obstacles, floor
        self._resting = [limb.points(group, normals[group]) for group in resting]
        vertices = np.array([goal.vertex for goal in goals], np.int64)
        self._points = limb.points(vertices, normals[vertices])
        self._probes: LimbPoints = limb.points(limb.probes, normals[limb.probes])
        self._places = np.array([goal.place for goal in goals]).reshape(-1, 3)
        self._axes = np.array([goal.axes for goal in goals]).reshape(-1, 3)
        self._looks = [(index, goal.facing) for index, goal in enumerate(goals) if goal.facing is not None]

    def __call__(self, start: Arm | Leg, ranges: Ranges) -> Reached:
        """Search from `start`, which is the preferred posture as well; ranges: of the angles that may change."""
        names = [*ranges]
        low, high = np.array([*ranges.values()]).T
        preferred = np.array([getattr(start, name) for name in names])
        values = np.clip(preferred, low, high)

        def residuals(at: Floats) -> Floats:
            angles = replace(start, **dict(zip(names, at.tolist(), strict=True)))
            return np.concatenate([self._residuals(angles), (at - preferred) / _PREFERRED_DEG])

        now = residuals(values)
        damping = 0.05
        for _ in range(_ROUNDS):
            steps = np.where(values + _STEP_DEG > high, -_STEP_DEG, _STEP_DEG)
            units = np.eye(len(names))
            slopes = np.stack(
                [(residuals(values + step * unit) - now) / step for step, unit in zip(steps, units, strict=True)],
                axis=1,
            )
            gained = 0.0
            for _ in range(4):
                square = slopes.T @ slopes
                move = np.linalg.solve(square + damping * np.diag(np.diag(square) + 1e-6), -slopes.T @ now)
                tried = np.clip(values + np.clip(move, -40, 40), low, high)
                then = residuals(tried)
                gained = 1 - float(then @ then) / max(float(now @ now), 1e-12)
                if gained > 0:
                    values, now, damping = tried, then, damping / 4
                    break
                damping *= 6
            if gained < _DONE:
                break
        angles = replace(start, **dict(zip(names, np.round(values, 1).tolist(), strict=True)))
        return Reached(angles, self.miss_m(angles))

    def miss_m(self, angles: Arm | Leg) -> float:
        """Return the largest distance of a point from its goal, metres, weighted by the goal's axes."""
        turns, heads = self._limb.bones(angles, self._base)
        off = (self._points.moved(turns, heads) - self._places) * self._axes
        above = _RESTING * np.abs(self._above_floor(turns, heads))
        return max(float(np.linalg.norm(off, axis=1).max(initial=0)), float(above.max(initial=0)))

    def depth_m(self, angles: Arm | Leg) -> float:
        """Return the depth to which a limb goes into the body, metres, 0 if it does not."""
        heights = self._obstacles.heights(self._probes.moved(*self._limb.bones(angles, self._base)))
        return max(0.0, -float(heights.min()))

    def _above_floor(self, turns: Floats, heads: Floats) -> Floats:
        """Return the height of the lowest point of each resting group above the floor, metres."""
        return np.array([points.moved(turns, heads)[:, 1].min() - self._floor for points in self._resting])

    def _residuals(self, angles: Arm | Leg) -> Floats:
        turns, heads = self._limb.bones(angles, self._base)
        off = (self._points.moved(turns, heads) - self._places) * self._axes
        parts = [off.ravel() / _NEAR_M]
        if self._looks:
            facing = self._points.facing(turns)
            parts.append(np.array([_FACING * (1 - float(facing[index] @ look)) for index, look in self._looks]))
        probes = self._probes.moved(turns, heads)
        parts.append(np.maximum(GAP_M - self._obstacles.heights(probes), 0) / _NEAR_M)
        parts.append(np.maximum(self._floor - probes[:, 1], 0) / _NEAR_M)
        parts.append(self._above_floor(turns, heads) / _NEAR_M)
        if isinstance(angles, Arm):
            parts.append(np.array([max(angles.flex + max(angles.abduct, 0) - MOST_RAISED, 0) / _RAISED_DEG]))
        return np.concatenate(parts)
