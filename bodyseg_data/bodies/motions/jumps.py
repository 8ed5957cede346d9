"""Jumping and bouncing: the body is in flight while the legs shorten faster than it falls."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.motions.curves import Build, PoseTrack, Sole, Track, about_y, pelvis_over, standing, wander
from bodyseg_data.bodies.skeleton import Arm, Leg, Pose, Trunk, symmetric

_GRAVITY: Final = 9.81
_STEPS: Final = 200  # steps of the simulation of flight in a second


class Flight:
    """Height of the feet above the floor over time; standing(time): height of the pelvis over the feet, metres.

    On the floor the pelvis is at that height. As soon as it would drop faster than a falling body, the pelvis follows a
    parabola until the legs reach the floor again.
    """

    def __init__(self, standing: Callable[[float], float], seconds: float) -> None:
        self._standing, self._seconds = standing, seconds

    @cached_property
    def _heights(self) -> NDArray[np.float64]:
        step = 1 / _STEPS
        heights = [0.0]
        held = pelvis = self._standing(0)
        speed = 0.0
        for index in range(1, math.ceil(self._seconds * _STEPS) + 1):
            before, held = held, self._standing(index * step)
            pelvis += speed * step - _GRAVITY * step**2 / 2
            speed -= _GRAVITY * step
            if pelvis <= held:
                pelvis, speed = held, (held - before) * _STEPS
            heights.append(pelvis - held)
        return np.array(heights)

    def height(self, time: float) -> float:
        """Return the distance of the feet from the floor, metres."""
        return float(np.interp(time * _STEPS, np.arange(len(self._heights)), self._heights))


_STANDS: Final = symmetric(Trunk(lean=1, bend=2), Arm(), Leg(flex=3, knee=4))
_CROUCHES: Final = symmetric(
    Trunk(lean=38, bend=18, nod=-24), Arm(flex=-38, abduct=12, elbow=14), Leg(flex=97, knee=81)
)
_SWINGING: Final = Arm(flex=-18, abduct=12, elbow=20)
_PUSHES: Final = symmetric(
    Trunk(lean=22, bend=8, nod=-16), Arm(flex=44, abduct=12, elbow=30), Leg(flex=58, knee=58, ankle=8)
)
_LEAVES: Final = symmetric(
    Trunk(lean=3, bend=-4, nod=-4), Arm(flex=106, abduct=14, elbow=24), Leg(flex=4, knee=7, ankle=38)
)
_FLIES: Final = symmetric(
    Trunk(lean=5, bend=2, nod=4), Arm(flex=144, abduct=20, elbow=18), Leg(flex=12, knee=16, ankle=36)
)
_SPREADS: Final = symmetric(
    Trunk(lean=2, bend=-2, nod=-2), Arm(flex=64, abduct=100, elbow=10), Leg(flex=17, knee=28, ankle=34)
)
_TUCKS: Final = symmetric(
    Trunk(lean=12, bend=12, nod=2), Arm(flex=96, abduct=24, elbow=26), Leg(flex=52, knee=66, ankle=24)
)
_LANDS: Final = symmetric(
    Trunk(lean=12, bend=6, nod=2), Arm(flex=70, abduct=34, elbow=24), Leg(flex=26, knee=22, ankle=26)
)
_CATCHES: Final = symmetric(Trunk(lean=32, bend=16, nod=-16), Arm(flex=34, abduct=30, elbow=30), Leg(flex=84, knee=78))


def _jump(start: float, crouch: float, flight: Pose, seconds: float, catch: float) -> list[tuple[float, Pose]]:
    """List the key poses of a jump that takes off about 0.74 s after `start` and is in flight for `seconds`."""
    land = start + 0.74 + seconds
    down = _STANDS.blend(_CROUCHES, crouch)
    return [
        (start, _STANDS),
        (start + 0.42, down),
        (start + 0.52, replace(down, left_arm=_SWINGING, right_arm=_SWINGING)),
        (start + 0.66, _PUSHES),
        (start + 0.78, _LEAVES),
        (start + 0.74 + seconds / 2, flight),
        (land, _LANDS),
        (land + 0.25, _STANDS.blend(_CATCHES, catch)),
        (land + 0.31, _STANDS.blend(_CATCHES, catch)),
    ]


_JUMPS: Final = PoseTrack(
    [
        (0.0, _STANDS),
        *_jump(0.1, 0.9, _FLIES, 0.42, 0.85),
        *_jump(2.05, 0.85, _SPREADS, 0.42, 0.75),
        *_jump(3.95, 0.95, _TUCKS, 0.36, 0.95),
        (6.0, _STANDS),
    ],
    blur=0.05,
)
_TURNING: Final = Track((0.9, 1.25, 2.85, 3.2, 4.75, 5.2), (0, 20, 20, 75, 75, 30), blur=0.03)
"""Direction that the jumper faces, degrees; it changes in the air."""

_SPREADING: Final = Track((2.85, 3.04, 3.22), (0.22, 0.62, 0.26), blur=0.03)  # distance between the feet, metres


class Jumps:
    """Three jumps: up, up with arms and legs spread, up with the knees tucked."""

    def __init__(self, build: Build) -> None:
        self._build = build
        self._flight = Flight(lambda time: float(pelvis_over(build, _JUMPS.at(time))[1]), seconds=6)

    def at(self, time: float) -> tuple[Pose, float]:
        """Return the pose at a time in seconds, and the feet's height above the floor in metres."""
        pose = _JUMPS.at(time)
        facing, apart = _TURNING.one(time), _SPREADING.one(time)
        trunk = replace(
            pose.trunk,
            turn=facing + 2 * wander(time, 1, 3.1),
            roll=1.2 * wander(time, 2, 2.3),
            side=2 * wander(time, 3, 2.9),
            twist=3 * wander(time, 4, 3.7),
            look=6 * wander(time, 5, 4.3),
        )
        arms = (_with_sway(pose.left_arm, time, 6), _with_sway(pose.right_arm, time, 7))
        pelvis = pelvis_over(self._build, pose)
        left = Sole(apart / 2, 0, 9, pose.left_leg.ankle)
        soles = (_turned(left, facing), _turned(left.mirrored(), facing))
        return standing(self._build, pelvis, trunk, arms, soles), self._flight.height(time)


def _with_sway(arm: Arm, time: float, number: int) -> Arm:
    return replace(
        arm, flex=arm.flex + 5 * wander(time, number, 2.7), abduct=arm.abduct + 2 * wander(time, number, 2.1)
    )


def _turned(sole: Sole, facing: float) -> Sole:
    """Turn a sole with the whole body, to its left, by degrees."""
    position = about_y(facing) @ (sole.x, 0, sole.z)
    return replace(sole, x=float(position[0]), z=float(position[2]), yaw=sole.yaw + facing)


_BEAT_S: Final = 0.47
_VIGOUR: Final = Track(
    (0, 0.6, 1.6, 2.6, 3.2, 3.8, 4.6, 5.6, 6.3, 7.0), (0.3, 0.8, 1.2, 1.45, 0.8, 0.6, 1.1, 1.5, 1.0, 0.4), blur=0.2
)
"""Strength of the bouncing over time."""


class Bounces:
    """Bouncing on the balls of the feet as boxers do, with loose arms and the weight shifting from foot to foot."""

    def __init__(self, build: Build) -> None:
        self._build = build
        self._flight = Flight(lambda time: float(pelvis_over(build, _bounced(time))[1]), seconds=7)

    def at(self, time: float) -> tuple[Pose, float]:
        """Return the pose at a time in seconds, and the feet's height above the floor in metres."""
        pose = _bounced(time)
        slow = math.pi * time / _BEAT_S  # the weight shifts over two beats
        vigour, facing = _VIGOUR.one(time), 45 * wander(time, 1, 6.1)
        trunk = replace(
            pose.trunk,
            turn=facing + 5 * vigour * math.sin(slow + 0.6),
            roll=2.5 * vigour * math.sin(slow),
            side=-4 * vigour * math.sin(slow),
            twist=-8 * vigour * math.sin(slow + 0.3) + 5 * wander(time, 2, 3.3),
            tilt=4 * math.sin(slow - 0.5),
            look=10 * wander(time, 3, 4.9),
        )
        arms = tuple(_shaken(time, vigour, side, number) for side, number in ((0.0, 4), (1.0, 5)))
        pelvis = pelvis_over(self._build, pose)
        pelvis[0] = 0.02 * vigour * math.sin(slow)
        pelvis = about_y(facing) @ pelvis
        soles = tuple(
            _turned(Sole(side * 0.11, 0, side * 8, pose.left_leg.ankle - 5 * side * vigour * math.sin(slow)), facing)
            for side in (1, -1)
        )
        return standing(self._build, pelvis, trunk, (arms[0], arms[1]), (soles[0], soles[1])), self._flight.height(time)


def _bounced(time: float) -> Pose:
    """Return the pose of trunk and legs, lowest on each beat."""
    down = _VIGOUR.one(time) * math.cos(2 * math.pi * time / _BEAT_S + 0.3 * wander(time, 6, 5.5))
    leg = Leg(flex=23 + 13 * down, knee=31 + 18 * down, ankle=22 - 13 * down)
    return symmetric(Trunk(lean=4 + 2.5 * down, bend=5 + 3 * down, nod=-3 - 4 * down), Arm(), leg)


def _shaken(time: float, vigour: float, behind: float, number: int) -> Arm:
    """Return a loosely shaken arm; behind: its lag in beats."""
    beat = 2 * math.pi * (time / _BEAT_S - 0.15)
    slow = math.pi * (time / _BEAT_S - behind)
    shake = math.sin(2.5 * beat) * max(0.0, wander(time, 9, 4.2))
    return Arm(
        flex=14 + 9 * vigour * math.sin(slow) + 8 * wander(time, number, 4.4),
        abduct=16 + 5 * vigour * math.cos(beat) + 6 * wander(time, number + 2, 5.2),
        twist=-4 + 8 * wander(time, number + 4, 3.9),
        elbow=58 + 12 * vigour * math.cos(beat - 0.6) + 18 * wander(time, number, 3.4) + 8 * shake,
        supinate=10 * shake,
        wrist=8 - 14 * vigour * math.cos(beat - 1.1) + 8 * shake,
        fist=0.45 + 0.2 * wander(time, number + 1, 4.0),
    )
