"""Inverse kinematics of one limb: joint angles that bring points of its skin to goals, within the joints' ranges.

Damped least squares (Levenberg-Marquardt) on the residuals of goals, of points that would go into the body or below the
floor, and, weakly, of the distance from a preferred posture, which settles what the goals leave open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.anny.skeleton import Arm, Leg
from bodyseg_data.bodies.contacts.limbs import Base, Limb, LimbPoints
from bodyseg_data.bodies.contacts.ranges import MOST_RAISED, Ranges
from bodyseg_data.bodies.contacts.surface import PosedSkin

Floats = NDArray[np.float64]

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
