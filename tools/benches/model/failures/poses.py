"""Kinds of poses by name, and the distance of a pose from every pose that a network was trained on.

Only bodies that are made (the sources `open` and `hard`) have joint angles; of bodies from files only the names count.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache, partial, reduce
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies import BodyRef, open_source
from bodyseg_data.bodies.skeleton import Arm, Leg, Pose, Trunk, bone_rotations
from bodyseg_data.bodies.sources.open_bodies import MadeBodies
from bodyseg_data.samples import split_key

POSE_KINDS: Final[dict[str, tuple[str, ...]]] = {
    "arms_crossed": ("arms_crossed", "hugging_oneself"),
    "lying": ("lying", "curled_up"),
    "sitting": ("sitting", "hugging_knees"),
    "kneeling": ("kneeling", "on_all_fours"),
    "bent_double": ("forward_bend", "hanging_forward", "touching_toes", "hands_on_knees", "looking_under"),
    "upside_down": ("handstand",),
    "crouching": ("squat", "lunge"),
    "hand_at_the_head": ("at_head", "behind_head", "at_face", "at_ear", "scratching_head"),
    "hand_on_the_trunk": ("on_hip", "clasped", "praying", "behind_back", "in_front", "on_shoulder"),
    "jumping": ("jumping", "bouncing"),
    "on_one_leg": ("crane", "kick", "arabesque"),
    "stepping": ("walk", "march", "run", "step_up"),
    "arms_raised": ("arms_up", "arm_raised", "surrender", "wave", "star", "reach_up", "tiptoe"),
    "arms_spread": ("t_pose", "a_pose", "arms_forward", "arms_back", "throw", "punch", "archer", "fencing", "twist"),
    "standing": ("standing", "turned", "arched_back", "side_bend"),
}
"""Kind -> words in the names of its poses. The first kind that fits is a pose's: blends have two names in one."""

OTHER: Final = "other"

_DOWN: Final = np.array([0.0, -1.0, 0.0])
_FRONT: Final = np.array([0.0, 0.0, 1.0])
_SPINE: Final = ("spine05", "spine04", "spine03", "spine02", "spine01")
_NECK: Final = ("neck01", "neck02", "neck03", "head")
_UPPER_ARM: Final = ("clavicle", "shoulder01", "upperarm01", "upperarm02")
_FOREARM: Final = ("lowerarm01", "lowerarm02")
_THIGH: Final = ("upperleg01", "upperleg02")
_HANGING: Final = Pose(
    Trunk(), Arm(abduct=0, elbow=0), Arm(abduct=0, elbow=0), Leg(abduct=0, twist=0), Leg(abduct=0, twist=0)
)
_SEGMENTS: Final = ("pelvis", "chest", "head", *(f"{limb}.{side}" for side in "LR" for limb in ("arm", "forearm")))
_LEGS: Final = tuple(f"{limb}.{side}" for side in "LR" for limb in ("thigh", "shin"))
SEGMENTS: Final = (*_SEGMENTS, *_LEGS, *(f"{name}'s front" for name in _SEGMENTS[:3]))
_MIRRORED: Final = [
    SEGMENTS.index(name.replace(".L", ".?").replace(".R", ".L").replace(".?", ".R")) for name in SEGMENTS
]

Matrix = NDArray[np.float64]


def kind_of_pose(pose: str) -> str:
    """The kind of a pose by its name, `OTHER` if no kind fits."""
    return next((kind for kind, words in POSE_KINDS.items() if any(word in pose for word in words)), OTHER)


def body_of(key: str) -> str:
    """The words of a sample's key that name its body: all but the view."""
    return split_key(key)[0]


def directions(pose: Pose) -> Matrix:
    """Directions of a body's segments, unit vectors [14, 3] in the order of `SEGMENTS`; body frame, heading left out.

    Limbs, and trunk and head upside down: along the segment; the last three: where pelvis, chest and face look.
    """
    turned, rest = _orientations(replace(pose, trunk=replace(pose.trunk, turn=0.0))), _hanging()
    # By what turn a segment left the position in which all of them hang straight down.
    turns = {name: turned[name] @ rest[name].T for name in turned}
    along = [turns[name] @ _DOWN for name in (*_SEGMENTS, *_LEGS)]
    return np.array([*along, *(turns[name] @ _FRONT for name in _SEGMENTS[:3])])


@cache
def _hanging() -> dict[str, Matrix]:
    return _orientations(_HANGING)


def _orientations(pose: Pose) -> dict[str, Matrix]:
    """The rotation of every segment in the body frame, [3, 3]."""
    bones = bone_rotations(pose)

    def after(parent: Matrix, names: Iterable[str], side: str = "") -> Matrix:
        return reduce(np.matmul, (bones[name + side] for name in names), parent)

    found = {"pelvis": bones["root"]}
    found["chest"] = after(found["pelvis"], _SPINE)
    found["head"] = after(found["chest"], _NECK)
    for side in (".L", ".R"):
        found[f"arm{side}"] = after(found["chest"], _UPPER_ARM, side)
        found[f"forearm{side}"] = after(found[f"arm{side}"], _FOREARM, side)
        found[f"thigh{side}"] = after(found["pelvis"], _THIGH, side)
        found[f"shin{side}"] = after(found[f"thigh{side}"], ("lowerleg01",), side)
    return found


class Nearest(NamedTuple):
    """The nearest pose: its distance in degrees, its name, and the segment that differs so much."""

    degrees: float
    pose: str
    segment: str


UNKNOWN: Final = Nearest(float("nan"), "", "")


class KnownPoses:
    """Poses of training bodies and, as trainings hold images before a mirror, their mirror images."""

    def __init__(self, poses: Iterable[tuple[str, Pose]]) -> None:
        """poses: names and poses of the bodies."""
        self._names: list[str] = []
        known: list[Matrix] = []
        for name, pose in poses:
            self._names.append(name)
            known.append(directions(pose))
        plain = np.array(known).reshape(-1, len(SEGMENTS), 3)
        self._known = np.concatenate([plain, plain[:, _MIRRORED] * (-1, 1, 1)])

    def nearest(self, pose: Pose) -> Nearest:
        """The nearest known pose; NaN degrees and no names if none is known.

        Two poses are as far apart as the segment that differs most: no known body has all its segments within so many
        degrees of where they point in `pose`.
        """
        if not self._names:
            return UNKNOWN
        cosines = (self._known * directions(pose)).sum(axis=2)
        best = int(cosines.min(axis=1).argmax())
        segment = int(cosines[best].argmin())
        degrees = float(np.degrees(np.arccos(np.clip(cosines[best, segment], -1, 1))))
        return Nearest(degrees, self._names[best % len(self._names)], SEGMENTS[segment])


def made_bodies(source: str) -> dict[str, tuple[BodyRef, Callable[[], Pose]]]:
    """The bodies of a source that makes them, by `body_of` their samples' keys; none for other sources."""
    if source not in ("open", "hard"):
        return {}
    made = open_source(source)
    if not isinstance(made, MadeBodies):
        return {}
    return {f"{source}-{body.subject}-{body.mesh}": (body, partial(_pose, made, body)) for body in made.bodies()}


def _pose(made: MadeBodies, body: BodyRef) -> Pose:
    return made.figure(body).pose
