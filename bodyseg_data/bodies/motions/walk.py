"""Walking in a circle: footprints on the floor, a pelvis that moves over them, and legs that connect the two.

A foot strikes with its heel, lies flat, turns over its ball, and swings to its next footprint; timing, heights and
angles are those of normal gait (Perry and Burnfield 2010, Gait Analysis, chapters 2 to 7).
"""

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Final

import numpy as np

from bodyseg_data.bodies.motions.curves import Build, Sole, Track, Vector, about_y, reach, wander
from bodyseg_data.bodies.skeleton import Arm, Leg, Pose, Trunk, root_rotation

STANCE: Final = 0.62
"""Share of a stride for which a foot is on the floor; a stride is two steps."""

_MIDDLE: Final = 0.235  # phase of the stride at which the pelvis passes over the ankle of the standing foot
_ROLLING: Final = Track((0.0, 0.09, 0.35, 0.50, 0.62), (-15, 0, 0, 19, 48), blur=0.05)
"""A sole's pitch over a stride from its heel's strike, degrees."""

_INSTANT: Final = 1e-3

_SWING: Final = {"flex": (0.62, 25.0), "knee": (0.36, 63.0), "ankle": (0.5, -5.0)}
"""Extremes of the angles of a swinging leg: (share of the swing, degrees)."""


@dataclass(frozen=True)
class Gait:
    """Parameters of one person's gait. Lengths in metres, angles in degrees; a stride is two steps.

    turn: of the path in a stride. apart: distance of the feet. pelvis: its height over a standing leg. bob, sway, list,
    sweep: amplitudes of the pelvis up and down, sideways, in tilt and in rotation. arms: amplitude of their swing.
    arms_out: their angle from the body. hip: largest flexion of a swinging thigh. first: phase at the start.
    """

    stride: float
    seconds: float
    turn: float
    apart: float
    pelvis: float
    bob: float
    sway: float
    list: float
    sweep: float
    arms: float
    arms_out: float
    elbow: float
    lean: float
    toe_out: float
    hip: float
    first: float


def walking(build: Build, gait: Gait, time: float) -> Pose:
    """Return the pose at a time in seconds."""
    phase = gait.first + time / gait.seconds
    trunk = _trunk(gait, phase)
    arms = (_arm(gait, phase + 0.5, 7), _arm(gait, phase, 8))
    return Pose(trunk, *arms, _leg(build, gait, phase, 0.0, 1), _leg(build, gait, phase, 0.5, -1))


def _path(gait: Gait, phase: float) -> Vector:
    """Return the walker's position on a circle, [3], metres."""
    angle = math.radians(gait.turn * phase)
    radius = gait.stride / math.radians(gait.turn)
    return np.array([radius * (1 - math.cos(angle)), 0.0, radius * math.sin(angle)])


def _pelvis(gait: Gait, phase: float) -> Vector:
    """Return the pelvis, [3], metres: highest and farthest to the side over the middle of each stance."""
    over = 2 * math.pi * (phase - _MIDDLE)
    axes = about_y(gait.turn * phase)
    high = gait.pelvis + gait.bob * (math.cos(2 * over) - 1)
    return _path(gait, phase) + axes @ [gait.sway * math.cos(over), high, 0.008 * math.sin(2 * over)]


def _trunk(gait: Gait, phase: float) -> Trunk:
    over = 2 * math.pi * (phase - _MIDDLE)
    sweep = -gait.sweep * math.cos(2 * math.pi * phase - 0.3) * _liveliness(phase)
    listing = gait.list * math.cos(over + 0.5)
    return Trunk(
        lean=gait.lean + 1.2 * math.cos(2 * over),
        roll=-listing,
        turn=gait.turn * phase + sweep,
        bend=2 + wander(phase, 3, 5.3),
        side=0.8 * listing,
        twist=-1.9 * sweep + 2 * wander(phase, 4, 7.7),
        nod=-gait.lean + 3 * wander(phase, 5, 6.7),
        look=0.8 * sweep + 8 * wander(phase, 6, 8.3) + math.copysign(6, gait.turn),
    )


def _liveliness(phase: float) -> float:
    return 1 + 0.12 * wander(phase, 2, 6.1)


def _arm(gait: Gait, phase: float, number: int) -> Arm:
    """Return an arm that is forward when the other side's foot strikes."""
    swing = math.cos(2 * math.pi * phase - 0.25)
    return Arm(
        flex=gait.arms * (0.1 + swing * _liveliness(phase)),
        abduct=gait.arms_out + 2 * wander(phase, number, 5.9),
        twist=-6 - 4 * swing,
        elbow=gait.elbow + 0.45 * gait.arms * (1 + swing) + 3 * wander(phase, number + 2, 4.3),
        supinate=-12,
        wrist=4 - 5 * math.sin(2 * math.pi * phase),
        fist=0.3,
    )


def _leg(build: Build, gait: Gait, phase: float, strike: float, side: int) -> Leg:
    """Return the leg that strikes at phase `strike` of every stride, on the floor or swinging to the next strike."""
    from scipy.interpolate import CubicHermiteSpline

    step = strike + math.floor(phase - strike)
    share = (phase - step - STANCE) / (1 - STANCE)
    if share < 0:
        return _stance(build, gait, step, phase, side)
    lift, land = step + STANCE, step + 1
    speed = (1 - STANCE) / _INSTANT
    start, end = _stance(build, gait, step, lift, side), _stance(build, gait, land, land, side)
    before = _stance(build, gait, step, lift - _INSTANT, side)
    after = _stance(build, gait, land, land + _INSTANT, side)
    swung: dict[str, float] = {}
    for field in fields(Leg):
        a, b, c, d = (getattr(leg, field.name) for leg in (start, end, before, after))
        knots = [(0.0, a, (a - c) * speed), (1.0, b, (d - b) * speed)]  # share, value, slope
        if field.name in _SWING:
            turning, value = _SWING[field.name]
            knots.insert(1, (turning, gait.hip if field.name == "flex" else value, 0.0))
        swung[field.name] = float(CubicHermiteSpline(*zip(*knots, strict=True))(share))
    return Leg(**swung)


@lru_cache(maxsize=16)  # all frames of a leg's swing lie between the same four
def _stance(build: Build, gait: Gait, step: float, phase: float, side: int) -> Leg:
    """Return a leg at a phase of its stance, whose foot struck at phase `step`; side: 1 left, -1 right."""
    middle = step + _MIDDLE
    heading = gait.turn * middle
    position = _path(gait, middle) + side * gait.apart / 2 * about_y(heading)[:, 0]
    sole = Sole(position[0], position[2], heading + side * gait.toe_out, _ROLLING.one(phase - step))
    return reach(build, root_rotation(_trunk(gait, phase)), _pelvis(gait, phase), sole, side)
