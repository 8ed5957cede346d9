"""A handstand: hands to the floor, one leg kicked up and then the other, a few seconds upside down, and back."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Final

import numpy as np

from bodyseg_data.bodies.motions.curves import (
    Build,
    PoseTrack,
    Sole,
    Track,
    Triple,
    Vector,
    pelvis_over,
    standing,
    wander,
)
from bodyseg_data.bodies.skeleton import KNUCKLES, Arm, Leg, Matrix, Pose, Trunk, arm_rotations, trunk_rotations

ARM_C: Final[tuple[tuple[str, Triple], ...]] = (
    ("spine05", (0, 0, 0)),
    ("spine04", (0, 0.0727, -0.0449)),
    ("spine03", (0, 0.067, 0.0208)),
    ("spine02", (0, 0.0922, 0.012)),
    ("spine01", (0, 0.1411, 0.0004)),
    ("clavicle.L", (0.024, 0.0827, 0.0132)),
    ("shoulder01.L", (0.0728, 0.0188, 0.0045)),
    ("upperarm01.L", (0.0647, -0.0356, -0.0044)),
    ("upperarm02.L", (0.0579, -0.0606, 0.0008)),
    ("lowerarm01.L", (0.1163, -0.1311, 0.0084)),
    ("lowerarm02.L", (0.0535, -0.0626, 0.0621)),
    ("wrist.L", (0.0583, -0.0589, 0.0724)),
)
"""Subject C's bones from the pelvis to the left hand, each with its offset in its parent's frame, metres."""

_HAND: Final = np.array([0.0425, -0.0539, 0.0736])
"""From her left wrist to her middle knuckle in the wrist's frame, metres."""

_WRIST_M: Final = 0.068  # height of the wrists above the floor when the hands are on it, metres
_SOLES: Final = (Sole(0.18, 0, 28), Sole(-0.18, 0, -28))
_END: Final = 7.2

_HANGING: Final = Arm(flex=4)
_DOWN: Final = Arm(flex=150, abduct=14, twist=-8, elbow=14, supinate=-62, fist=-0.1)
_UP: Final = Arm(flex=174, abduct=12, twist=-8, elbow=6, supinate=-66, fist=-0.1)
_AHEAD: Final = replace(_UP, flex=138)


def _free(flex: float, abduct: float, knee: float) -> Leg:
    return Leg(flex, abduct, 5, knee, planted=0, ankle=34)


def _posed(lean: float, bend: float, nod: float, arms: Arm, left: Leg, right: Leg) -> Pose:
    return Pose(Trunk(lean=lean, bend=bend, nod=nod), arms, arms, left, right)


_UPRIGHT: Final = _posed(1, 2, 0, _HANGING, Leg(4, knee=6), Leg(4, knee=6))
_ON_FLOOR: Final = _posed(82, 55, -16, _DOWN, Leg(110, knee=60, ankle=8), Leg(110, knee=60, ankle=8))
_UPWARDS: Final = (
    (0.0, _UPRIGHT),
    (0.3, _UPRIGHT),
    (0.95, _posed(4, 2, 0, _AHEAD, Leg(8, knee=10), Leg(8, knee=10))),
    (1.6, _ON_FLOOR),
    (1.75, _ON_FLOOR),
    (2.0, _posed(98, 45, -20, replace(_UP, flex=154), _free(52, 0, 68), _free(104, 14, 60))),
    (2.26, _posed(114, 32, -22, replace(_UP, flex=158), _free(-14, 0, 14), _free(108, 14, 50))),
    (2.66, _posed(154, 6, -26, _UP, _free(-22, 0, 8), _free(84, 2, 40))),
    (3.02, _posed(178, -4, -28, _UP, _free(-6, 0, 4), _free(16, 2, 20))),
    (3.25, _posed(180, -5, -26, _UP, _free(0, -2, 3), _free(4, -2, 6))),
)
_HELD: Final = (
    (3.5, _posed(178, -3, -28, _UP, _free(14, 4, 6), _free(-12, 4, 22))),
    (3.75, _posed(181, -6, -26, _UP, _free(-10, 8, 24), _free(12, 8, 8))),
)
_POSES: Final = PoseTrack([*_UPWARDS, *_HELD, *((_END - time, pose.mirrored()) for time, pose in _UPWARDS[::-1])])


def _track(keys: Sequence[tuple[float, float]], back: Sequence[tuple[float, float]] = ()) -> Track:
    """Return a track through `keys` on the way up and through `back`, else `keys`, in reverse, on the way down."""
    all_keys = [*keys, *((_END - time, value) for time, value in reversed(back or keys))]
    return Track([time for time, _ in all_keys], [value for _, value in all_keys], blur=0.03)


_HANDS: Final = _track(((1.6, 0.0), (1.78, 1.0)))
"""Support of the pelvis: 0 by the feet on the floor, 1 by the hands on the floor."""

_PALMS: Final = _track(((1.0, 0.0), (1.5, 1.0)))  # share to which the palms are level, 0 to 1
_PITCH: Final = _track(((1.0, 0.0), (1.6, 8.0), (1.75, 8.0), (2.3, 52.0)))  # of soles on the floor, degrees
_FIRST: Final = ((1.8, 0.0), (2.06, 1.0))
_SECOND: Final = ((2.12, 0.0), (2.42, 1.0))
_LEFT_FREE: Final = _track(_FIRST, _SECOND)
_RIGHT_FREE: Final = _track(_SECOND, _FIRST)
"""Share to which a leg has left the floor, 0 to 1: the left one goes up first, so the right one comes down first."""


def handstand(build: Build, time: float) -> Pose:
    """Return the pose at a time in seconds."""
    pose, palms = _with_sway(_POSES.at(time), time), _PALMS.one(time)
    left, right = _levelled(pose, palms), _levelled(pose.mirrored(), palms)
    pose = replace(pose, left_arm=left, right_arm=right)
    share = _HANDS.one(time)
    on_feet = pelvis_over(build, pose)
    pelvis = (1 - share) * on_feet + share * (_spot(build) - _hands(pose))
    pitch = _PITCH.one(time)
    soles = (replace(_SOLES[0], pitch=pitch), replace(_SOLES[1], pitch=pitch))
    grounded = standing(build, pelvis, pose.trunk, (left, right), soles)
    return replace(
        grounded,
        left_leg=grounded.left_leg.blend(pose.left_leg, _LEFT_FREE.one(time)),
        right_leg=grounded.right_leg.blend(pose.right_leg, _RIGHT_FREE.one(time)),
    )


def _with_sway(pose: Pose, time: float) -> Pose:
    """Add the small movements of keeping balance to a pose."""
    trunk = replace(
        pose.trunk,
        roll=pose.trunk.roll + 1.2 * wander(time, 1, 2.1),
        turn=3 * wander(time, 2, 5.3),
        side=pose.trunk.side + 2 * wander(time, 3, 1.9),
        bend=pose.trunk.bend + 1.5 * wander(time, 4, 1.7),
        look=4 * wander(time, 5, 3.9),
    )
    return replace(pose, trunk=trunk)


@cache
def _spot(build: Build) -> Vector:
    """Return the middle between the wrists while the hands are on the floor, [3], metres."""
    arm = _levelled(_ON_FLOOR, 1)
    position = pelvis_over(build, _ON_FLOOR) + _hands(replace(_ON_FLOOR, left_arm=arm, right_arm=arm))
    return position * (0, 0, 1) + (0, _WRIST_M, 0)


def _hands(pose: Pose) -> Vector:
    """Return the vector from the pelvis to the middle between both wrists, [3], metres."""
    left, right = _wrist(pose)[1], _wrist(pose.mirrored())[1]
    return (left + right * (-1, 1, 1)) / 2


def _wrist(pose: Pose) -> tuple[Matrix, Vector]:
    """Return the left wrist's rotation in the world, [3, 3], and its offset from the pelvis, [3], metres."""
    rotations = trunk_rotations(pose.trunk) | arm_rotations(pose.left_arm)
    turned, position = rotations["root"], np.zeros(3)
    for bone, offset in ARM_C:
        position = position + turned @ offset
        turned = turned @ rotations[bone.removesuffix(".L")]
    return turned, position


def _levelled(pose: Pose, share: float) -> Arm:
    """Return the left arm with its wrist bent until the hand is level, or a share of the way."""
    arm = pose.left_arm
    turned, _ = _wrist(replace(pose, left_arm=replace(arm, wrist=0)))
    along, axis = turned @ _HAND, turned @ KNUCKLES
    across = np.cross(axis, along)
    level = math.degrees(math.atan2(-along[1], across[1]))
    level = (level + 120) % 180 - 120  # of the two solutions the one with the hand bent back
    return replace(arm, wrist=(1 - share) * arm.wrist + share * level)
