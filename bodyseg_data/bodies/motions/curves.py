"""Parts of every motion: smooth curves through key values in time, and inverse kinematics of the legs.

Joint angles of the legs follow from the positions of pelvis and soles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import islice
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.skeleton import Arm, Leg, Matrix, Pose, Trunk, about, mirrored, root_rotation

Vector = NDArray[np.float64]

_SPREAD: Final = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16

Triple = tuple[float, float, float]

_FLAT_DEG: Final = 16  # a sole pitched by more than this is no longer laid flat by its ankle
_ROUNDS: Final = 4


class Track:
    """Key values in time, joined smoothly and never overshooting: each value stays between its neighbouring keys.

    Monotone cubics (Fritsch and Butland 1984), averaged over `blur` seconds to both sides, so that acceleration hardly
    jumps at a key. Before the first key and after the last one the values are constant.
    """

    def __init__(self, times: Sequence[float], values: Sequence[Any], blur: float = 0.09) -> None:
        self._around = np.linspace(-blur, blur, len(_SPREAD))
        self._times = np.asarray(times, np.float64)
        self._values = np.asarray(values, np.float64).reshape(len(times), -1)
        steps = np.diff(self._times)[:, None]
        slopes = np.diff(self._values, axis=0) / steps
        before, after = slopes[:-1], slopes[1:]
        # The weighted harmonic mean, or 0 at an extreme.
        share = (1 + steps[1:] / (steps[:-1] + steps[1:])) / 3
        same = before * after > 0
        mean = np.where(same, before * after / np.where(same, share * after + (1 - share) * before, 1), 0)
        self._slopes = np.concatenate([np.zeros((1, mean.shape[1])), mean, np.zeros((1, mean.shape[1]))])

    def at(self, time: float) -> Vector:
        """Return the values [N] at a time in seconds."""
        return np.asarray(_SPREAD @ self._cubic(time + self._around))

    def one(self, time: float) -> float:
        """Return the value of a track of single values at a time in seconds."""
        return float(self.at(time)[0])

    def _cubic(self, times: Vector) -> Vector:
        times = np.clip(times, self._times[0], self._times[-1])
        left = np.clip(np.searchsorted(self._times, times, "right") - 1, 0, len(self._times) - 2)
        step = (self._times[left + 1] - self._times[left])[:, None]
        s = (times - self._times[left])[:, None] / step
        hermite: Vector = (
            (1 + 2 * s) * (1 - s) ** 2 * self._values[left]
            + s * (1 - s) ** 2 * step * self._slopes[left]
            + s * s * (3 - 2 * s) * self._values[left + 1]
            - s * s * (1 - s) * step * self._slopes[left + 1]
        )
        return hermite


class PoseTrack:
    """Key poses in time."""

    def __init__(self, keys: Sequence[tuple[float, Pose]], blur: float = 0.09) -> None:
        self._track = Track([time for time, _ in keys], [angles(pose) for _, pose in keys], blur)

    def at(self, time: float) -> Pose:
        """Return the pose at a time in seconds."""
        return from_angles(self._track.at(time))


def angles(pose: Pose) -> Vector:
    """Return all joint angles [37] of a pose: trunk, left and right arm, left and right leg."""
    return np.array([angle for part in vars(pose).values() for angle in vars(part).values()], np.float64)


def from_angles(values: Vector, decimals: int | None = None) -> Pose:
    """Return the pose of joint angles [37], rounded to `decimals` if given."""
    numbers = (float(value) if decimals is None else round(float(value), decimals) + 0.0 for value in values)
    parts: Any = (kind(*islice(numbers, len(fields(kind)))) for kind in (Trunk, Arm, Arm, Leg, Leg))
    return Pose(*parts)


def wander(time: float, number: int, seconds: float) -> float:
    """Return a slow oscillation between -1 and 1 that does not repeat; `number` selects its phases."""
    first, second = 2 * math.pi * time / seconds, 2 * math.pi * time / (seconds * 0.618)
    return 0.6 * math.sin(first + 2.4 * number) + 0.4 * math.sin(second + 1.1 * number * number)


@dataclass(frozen=True)
class Build:
    """Joint offsets of a person's left leg, metres, body frame, standing in the skeleton's reference pose.

    hip: from the pelvis. thigh: hip to knee. shin: knee to ankle. ball, heel: from the ankle to the points about which
    the sole turns on the floor.
    """

    hip: Triple
    thigh: Triple
    shin: Triple
    ball: Triple
    heel: Triple


@dataclass(frozen=True)
class Sole:
    """Position of a foot. x, z: of its ankle when the sole is flat, metres. yaw: toes to the left, degrees.

    pitch: toes pointed down, degrees, turning about the ball of the foot; toes up, negative, about the heel.
    """

    x: float
    z: float
    yaw: float = 0
    pitch: float = 0

    def mirrored(self) -> Sole:
        return replace(self, x=-self.x, yaw=-self.yaw)

    def ankle(self, build: Build) -> Vector:
        """Return the position of the ankle, [3], metres."""
        pivot = np.array(build.ball if self.pitch > 0 else build.heel)
        raised = pivot - about_x(self.pitch) @ pivot
        ankle: Vector = [self.x, -build.ball[1], self.z] + about_y(self.yaw) @ raised
        return ankle


def _about(axis: int, degrees: float) -> Matrix:
    return about(math.radians(degrees), axis)


about_x, about_y, about_z = (partial(_about, axis) for axis in range(3))


def standing(build: Build, pelvis: Vector, trunk: Trunk, arms: tuple[Arm, Arm], soles: tuple[Sole, Sole]) -> Pose:
    """Return the pose whose legs lead from a pelvis at [3] to both soles; left first."""
    root = root_rotation(trunk)
    left, right = (reach(build, root, pelvis, sole, side) for sole, side in zip(soles, (1, -1), strict=True))
    return Pose(trunk, *arms, left, right)


def reach(build: Build, root: Matrix, pelvis: Vector, sole: Sole, side: int) -> Leg:
    """Return the leg that leads from a pelvis at [3], rotated by `root`, to a sole; straight if that is too far.

    side: 1 for the left leg, -1 for the right one, which is computed as a mirrored left one.
    """
    if side < 0:
        return reach(build, mirrored(root), pelvis * (-1, 1, 1), sole.mirrored(), 1)
    thigh, shin = np.array(build.thigh), np.array(build.shin)
    way = root.T @ (sole.ankle(build) - pelvis) - build.hip
    knee = _knee(thigh, shin, float(way @ way))
    leg = thigh + about_x(knee) @ shin
    twist = off = 0.0
    for _ in range(_ROUNDS):  # turning the thigh moves the ankle, which flexion and abduction put back
        twist = min(max(twist + off, -45.0), 45.0)
        at = about_y(twist) @ leg
        across = math.hypot(at[0], at[1])
        share = min(max(float(way[0]) / across, -1.0), 1.0)
        abduct = math.degrees(-math.acos(share) - math.atan2(at[1], at[0]))
        flex = math.degrees(math.atan2(at[2], -across * math.sqrt(1 - share * share)) - math.atan2(way[2], way[1]))
        turned = root @ about_x(-flex) @ about_z(abduct) @ about_y(twist) @ about_x(knee)
        off = _wrapped(sole.yaw - math.degrees(math.atan2(-turned[2, 0], turned[0, 0])))
    tilt = math.degrees(math.atan2(float(turned[:, 1] @ about_y(sole.yaw)[:, 2]), float(turned[1, 1])))
    flat = 1 - min(abs(sole.pitch) / _FLAT_DEG, 1.0)
    planted = flat * flat * (3 - 2 * flat)
    toes = min(max(sole.pitch, 0.0), 45.0)
    return Leg(_wrapped(flex), abduct, twist, knee, planted, sole.pitch - (1 - planted) * tilt, toes)


def _wrapped(degrees: float) -> float:
    return (degrees + 180) % 360 - 180


def _knee(thigh: Vector, shin: Vector, reach_squared: float) -> float:
    """Return the knee's angle, degrees, for a distance of hip and ankle: law of cosines for bones that are askew."""
    along = thigh[1] * shin[1] + thigh[2] * shin[2]
    across = thigh[2] * shin[1] - thigh[1] * shin[2]
    wanted = (reach_squared - float(thigh @ thigh + shin @ shin)) / 2 - thigh[0] * shin[0]
    cosine = min(max(wanted / math.hypot(along, across), -1.0), 1.0)
    return math.degrees(math.atan2(across, along) + math.acos(cosine))


def pelvis_over(build: Build, pose: Pose) -> Vector:
    """Return the pelvis, [3], over the middle of two flat soles if both legs bend as a pose's left one."""
    leg, lean = pose.left_leg, pose.trunk.lean
    thigh = lean - leg.flex
    below = about_x(thigh + leg.knee) @ build.shin + about_x(thigh) @ build.thigh + about_x(lean) @ build.hip
    return (Sole(0, 0, 0, leg.ankle).ankle(build) - below) * (0, 1, 1)
