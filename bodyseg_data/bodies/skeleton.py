"""Conversion of joint angles in degrees to a rotation for every bone of Anny's skeleton.

Angles are anatomical: zero is standing upright with the arms hanging, palms inwards. Every joint is computed for the
left side and reflected for the right, so that both sides always agree.

Rotations here are in the body frame (x to the subject's left, y up, z front) and relative to the skeleton's own
reference pose, in which the arms point 42 degrees down and outwards with bent elbows. Each applies in its parent's
frame, so a bone's turn in the world is the product of those from the root down to it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.meshes import Solid

Floats = NDArray[np.float64]
Matrix = Floats


@dataclass(frozen=True)
class _Angles:
    """Base of groups of angles, which are interpolated one by one."""

    def blend(self, other: Self, share: float) -> Self:
        """Interpolate linearly from this one, at share 0, to `other`, at share 1."""
        mixed: dict[str, Any] = {}
        for field in fields(self):
            a, b = getattr(self, field.name), getattr(other, field.name)
            mixed[field.name] = a.blend(b, share) if isinstance(a, _Angles) else (1 - share) * a + share * b
        return type(self)(**mixed)


@dataclass(frozen=True)
class Arm(_Angles):
    """One arm, degrees.

    flex: raised to the front, negative to the back. abduct: raised to the side; it comes first, so flex 90 with
    abduct 30 points to the front and 30 outwards. twist: outwards about the upper arm. elbow: 0 straight.
    supinate: thumb outwards. wrist: towards the palm. fist: 0 open to 1 closed.
    """

    flex: float = 0
    abduct: float = 8
    twist: float = 0
    elbow: float = 12
    supinate: float = 0
    wrist: float = 0
    fist: float = 0


@dataclass(frozen=True)
class Leg(_Angles):
    """One leg, degrees. flex: thigh raised to the front. abduct: to the side. twist: toes outwards. knee: 0 straight.
    planted: 1 keeps the sole level as far as an ankle can, 0 leaves the foot square to the shin. ankle: toes
    pointed downwards, on top of that. toes: bent up.
    """

    flex: float = 0
    abduct: float = -2
    twist: float = 5
    knee: float = 0
    planted: float = 1
    ankle: float = 0
    toes: float = 0


@dataclass(frozen=True)
class Trunk(_Angles):
    """Trunk and head, degrees.

    lean: the pelvis tilted to the front. roll: the pelvis tilted to the left. turn: the whole body turned to its
    left. bend, side, twist: the spine to the front, to the left, turning left. nod, tilt, look: the same of the head.
    """

    lean: float = 0
    roll: float = 0
    turn: float = 0
    bend: float = 0
    side: float = 0
    twist: float = 0
    nod: float = 0
    tilt: float = 0
    look: float = 0

    def mirrored(self) -> Trunk:
        """Return the same movement with left and right exchanged."""
        sideways = ("roll", "turn", "side", "twist", "tilt", "look")
        return replace(self, **{name: -getattr(self, name) for name in sideways})


@dataclass(frozen=True)
class Pose(_Angles):
    """Joint angles of a whole body."""

    trunk: Trunk = Trunk()
    left_arm: Arm = Arm()
    right_arm: Arm = Arm()
    left_leg: Leg = Leg()
    right_leg: Leg = Leg()

    def mirrored(self) -> Pose:
        """Return the mirror image: left and right exchanged."""
        return Pose(self.trunk.mirrored(), self.right_arm, self.left_arm, self.right_leg, self.left_leg)


def symmetric(trunk: Trunk, arms: Arm, legs: Leg) -> Pose:
    """Return the pose whose left and right limbs have the same angles."""
    return Pose(trunk, arms, arms, legs, legs)


def _unit(x: float, y: float, z: float) -> Matrix:
    return np.asarray(np.array([x, y, z]) / np.linalg.norm([x, y, z]), np.float64)


# Directions of the left limbs in the skeleton's reference pose.
_UPPER_ARM: Final = _unit(0.669, -0.743, 0.020)
_FOREARM: Final = _unit(0.511, -0.521, 0.684)
KNUCKLES: Final = _unit(0.385, -0.418, -0.823)
"""Axis of a wrist's bending: from the left index to the little finger in the skeleton's reference pose."""

_ELBOW_AXIS: Final = _unit(*np.cross(_UPPER_ARM, _FOREARM))
_ELBOW_AT_REST: Final = math.degrees(math.acos(float(_UPPER_ARM @ _FOREARM)))
_THIGH: Final = _unit(0.079, -0.994, 0.080)
_IDENTITY: Final = np.eye(3)
_X, _Y, _Z = _IDENTITY
_MIRROR: Final = np.diag([-1.0, 1.0, 1.0])

_SPINE: Final = {"spine05": 0.15, "spine04": 0.2, "spine03": 0.25, "spine02": 0.25, "spine01": 0.15}
_NECK: Final = {"neck01": 0.2, "neck02": 0.2, "neck03": 0.2, "head": 0.4}
_MOST_DORSIFLEXION: Final = 32
_MOST_PLANTARFLEXION: Final = 50


def bone_rotations(pose: Pose) -> dict[str, Matrix]:
    """Return rotations [3, 3] by bone name, body frame; other bones keep the reference pose."""
    rotations = trunk_rotations(pose.trunk)
    root = rotations["root"]
    for side, arm, leg in (("L", pose.left_arm, pose.left_leg), ("R", pose.right_arm, pose.right_leg)):
        # A right limb is a left limb seen in a mirror, and so is the pelvis that it hangs from.
        seen = mirrored if side == "R" else np.asarray
        own = arm_rotations(arm) | finger_rotations(arm) | leg_rotations(leg, seen(root))
        rotations |= {f"{bone}.{side}": seen(rotation) for bone, rotation in own.items()}
    return rotations


def trunk_rotations(trunk: Trunk) -> dict[str, Matrix]:
    """Return rotations [3, 3] of the bones of pelvis, spine, neck and head, by name."""
    rotations = {"root": root_rotation(trunk)}
    for shares, whole in (
        (_SPINE, _bent(trunk.bend, trunk.side, trunk.twist)),
        (_NECK, _bent(trunk.nod, trunk.tilt, trunk.look)),
    ):
        rotations |= {bone: _part_of(whole, share) for bone, share in shares.items()}
    return rotations


def root_rotation(trunk: Trunk) -> Matrix:
    """Return the rotation of the pelvis, [3, 3], body frame."""
    return _turn(_Y, trunk.turn) @ _bent(trunk.lean, trunk.roll, 0)


def arm_rotations(arm: Arm) -> dict[str, Matrix]:
    """Return rotations [3, 3] of the bones of a left arm without its fingers, by name without the side."""
    whole, swing, half = _thrown(True, arm.flex, arm.abduct, arm.twist)
    way = whole @ _UPPER_ARM
    # A raised arm lifts the shoulder and one reaching forward pulls it along, as the shoulder blade does.
    raised = max(0.0, math.degrees(math.acos(float(np.clip(-way[1], -1, 1)))) - 40)
    clavicle = _turn(_Y, -12 * float(way[2])) @ _turn(_Z, 0.12 * raised)
    shoulder = _turn(_Z, 0.15 * raised)
    third = _turn(-_FOREARM, arm.supinate / 3)
    return {
        "clavicle": clavicle,
        "shoulder01": shoulder,
        "upperarm01": (clavicle @ shoulder).T @ swing @ half,
        "upperarm02": half,
        "lowerarm01": _turn(_ELBOW_AXIS, arm.elbow - _ELBOW_AT_REST) @ third,
        "lowerarm02": third,
        "wrist": third @ _turn(KNUCKLES, arm.wrist),
    }


def finger_rotations(arm: Arm) -> dict[str, Matrix]:
    """Return rotations [3, 3] of the fingers' bones of a left hand, by name without the side."""
    rotations: dict[str, Matrix] = {}
    for fingers, bends in (((1,), (10, 25, 45)), ((2, 3, 4, 5), (62, 75, 45))):
        for joint, most in enumerate(bends, 1):
            names = [f"finger{finger}-{joint}" for finger in fingers]
            rotations |= dict.fromkeys(names, _turn(KNUCKLES, most * arm.fist))
    return rotations


def leg_rotations(leg: Leg, root: Matrix) -> dict[str, Matrix]:
    """Return rotations [3, 3] of the bones of a left leg, by name without the side, below a pelvis turned by `root`."""
    whole, swing, half = _thrown(False, leg.flex, leg.abduct, leg.twist)
    knee = _turn(_X, leg.knee)
    foot = _part_of(_levelling(root @ whole @ knee), leg.planted) @ _turn(_X, leg.ankle)
    rotations = {"upperleg01": swing @ half, "upperleg02": half, "lowerleg01": knee, "foot": foot}
    return rotations | dict.fromkeys([f"toe{toe}-1" for toe in (1, 2, 3, 4, 5)], _turn(_X, -leg.toes))


@lru_cache(maxsize=8)  # a search for angles of a limb asks for many others at the same ones of these
def _thrown(arm: bool, flex: float, abduct: float, twist: float) -> tuple[Matrix, Matrix, Matrix]:
    """Return a left upper arm's or thigh's rotation, its swing and half of its twist [3, 3], which nobody changes."""
    whole, along = _turn(_X, -flex) @ _turn(_Z, abduct) @ _turn(_Y, twist), _THIGH
    if arm:
        whole, along = whole @ _turn(_Z, -math.degrees(math.atan2(_UPPER_ARM[0], -_UPPER_ARM[1]))), _UPPER_ARM
    swing, about_limb = _swing_and_twist(whole, along)
    return whole, swing, _turn(along, about_limb / 2)  # spread, or the skin would wring at the shoulder


def _levelling(shin: Matrix) -> Matrix:
    """Return the ankle's rotation that makes the sole level below a shin rotated by `shin`, within an ankle's range."""
    ahead = shin @ _Z
    up = shin @ _Y
    if abs(ahead[1]) > abs(up[1]):  # a shin nearer to lying than standing: its toes are where its front points
        ahead = ahead - up * np.sign(ahead[1])
    flat = _turn(_Y, math.degrees(math.atan2(ahead[0], ahead[2])))
    angles = _rotation_vector(shin.T @ flat)
    low = np.radians([-_MOST_DORSIFLEXION, -15, -20])
    high = np.radians([_MOST_PLANTARFLEXION, 15, 20])
    return from_rotation_vector(np.clip(angles, low, high))


def _bent(forward: float, left: float, turned: float) -> Matrix:
    """Return the rotation that bends to the front, to the left, and turns to the left, in degrees, about one axis."""
    return from_rotation_vector(np.radians([forward, turned, -left]))


def _turn(axis: Matrix, degrees: float) -> Matrix:
    return from_rotation_vector(np.asarray(axis) * math.radians(degrees))


def mirrored(rotation: Matrix) -> Matrix:
    """Return the rotation [3, 3] that a mirror at x = 0 shows."""
    return _MIRROR @ rotation @ _MIRROR


def about(angle_rad: float, axis: int = 1) -> Matrix:
    """Rotation about an axis, [3, 3]: about y, it turns z towards x."""
    one, two, matrix = (axis + 1) % 3, (axis + 2) % 3, _IDENTITY.copy()
    matrix[one, one] = matrix[two, two] = math.cos(angle_rad)
    matrix[two, one], matrix[one, two] = math.sin(angle_rad), -math.sin(angle_rad)
    return matrix


@dataclass(frozen=True)
class RigidMotion:
    """A rotation, [3, 3], then a shift, [3], metres."""

    turn: Floats
    shift: Floats

    def __call__(self, points: Floats) -> Floats:
        """Move points [..., 3]."""
        return np.asarray(points @ self.turn.T + self.shift, np.float64)

    def back(self, points: Floats) -> Floats:
        """Undo the motion of points [..., 3]."""
        return (points - self.shift) @ self.turn

    def of(self, solid: Solid) -> Solid:
        """Move a solid."""
        return Solid(self(solid.vertices), solid.faces)


def from_rotation_vector(vector: Matrix) -> Matrix:
    """Return the rotation [3, 3] about a vector [3] by its length in radians (Rodrigues' formula)."""
    angle = math.sqrt(vector @ vector)
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = (vector / angle).tolist()
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation: Matrix = _IDENTITY + math.sin(angle) * cross + (1 - math.cos(angle)) * (cross @ cross)
    return rotation


def _rotation_vector(rotation: Matrix) -> Matrix:
    """Return axis times angle in radians, for rotations of less than half a revolution."""
    skew = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    length = math.sqrt(skew @ skew)
    if length < 1e-12:
        return np.zeros(3)
    return skew / length * math.atan2(length, float(np.trace(rotation)) - 1)


def _part_of(rotation: Matrix, share: float) -> Matrix:
    return from_rotation_vector(share * _rotation_vector(rotation))


def _swing_and_twist(rotation: Matrix, axis: Matrix) -> tuple[Matrix, float]:
    """Split the rotation of a limb along `axis` into the shortest swing [3, 3] @ a twist about the limb (degrees)."""
    way = rotation @ axis
    across = axis[[1, 2, 0]] * way[[2, 0, 1]] - axis[[2, 0, 1]] * way[[1, 2, 0]]
    sine = math.sqrt(across @ across)
    swing = _turn(across / sine, math.degrees(math.atan2(sine, float(axis @ way)))) if sine > 1e-9 else np.eye(3)
    twist = swing.T @ rotation
    return swing, math.degrees(float(_rotation_vector(twist) @ axis))
