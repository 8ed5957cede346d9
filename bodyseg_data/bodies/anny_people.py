"""583 different people, computed from their numbers alone, and the 71 postures of one person.

Postures are key postures, their mirror images, and blends of pairs. The last 14 are for testing: they come from key
postures that no training posture uses.
"""

from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Final

import numpy as np

from bodyseg_data.bodies.skeleton import Arm, Leg, Pose, Trunk, symmetric
from bodyseg_data.core import Draws

PEOPLE: Final = 583


@dataclass(frozen=True)
class Person:
    """Parameters of a person's body. female: 0 or 1, or between for neither. years: age. stature_m: height. The rest
    are 0 to 1, least to most: muscle, weight, proportions (1 the least usual), cupsize, firmness, african, asian,
    caucasian (mixed by ratio).
    """

    female: float
    years: float
    stature_m: float
    muscle: float
    weight: float
    proportions: float = 0.5
    cupsize: float = 0.5
    firmness: float = 0.5
    african: float = 1.0
    asian: float = 1.0
    caucasian: float = 1.0

    def phenotype(self) -> dict[str, float]:
        """Return Anny's parameters, all but the height, which depends on the others and on stature."""
        # Anny's anchors: 1/3 is a child of about ten, 2/3 an adult of 25, 1 one of 90.
        age = np.interp(self.years, (10, 25, 90), (1 / 3, 2 / 3, 1))
        same = ("muscle", "weight", "proportions", "cupsize", "firmness", "african", "asian", "caucasian")
        return {"gender": self.female, "age": float(age)} | {name: getattr(self, name) for name in same}


SUBJECT_A: Final = Person(female=0.0, years=30, stature_m=1.78, muscle=0.62, weight=0.48, proportions=0.4)
"""The one person of the 71 postures."""

SUBJECT_B: Final = Person(
    female=0.0, years=34, stature_m=1.85, muscle=0.55, weight=0.55, proportions=0.55, african=0.3, asian=0.2
)
"""The man of the four motions of subset B."""

SUBJECT_C: Final = Person(
    female=1.0, years=26, stature_m=1.66, muscle=0.55, weight=0.55, proportions=0.45, cupsize=0.45, firmness=0.6,
    african=0.4, asian=0.6, caucasian=0.6,
)  # fmt: skip
"""The woman of the four motions of subset C."""


def person(index: int) -> Person:
    """Return person number `index`: men and women in turn, 18 to 80 years old, 1.46 to 1.95 m tall."""
    draws = _draws(index, "shape", 10)
    female = float(index % 2)
    # Statures as in Europe, all but the outermost half per cent. Anny's women are slight for their weight parameter.
    mean, deviation = (1.63, 0.066) if female else (1.765, 0.072)
    stature = NormalDist(mean, deviation).inv_cdf(0.005 + 0.99 * draws[0])
    least_weight = 0.45 if female else 0.3
    return Person(
        female=female,
        years=18 + 62 * draws[1],
        stature_m=stature,
        muscle=0.2 + 0.65 * draws[2],
        weight=least_weight + (1 - least_weight) * draws[3],
        proportions=0.15 + 0.7 * draws[4],
        cupsize=0.25 + 0.6 * draws[5],
        firmness=0.3 + 0.5 * draws[6],
        african=0.02 + draws[7] ** 2,
        asian=0.02 + draws[8] ** 2,
        caucasian=0.02 + draws[9] ** 2,
    )


def standing_pose(index: int) -> Pose:
    """Return the standing pose of person number `index`: arms a little off the body, with individual differences."""
    openness, gap, spread, *draws = [2 * draw - 1 for draw in _draws(index, "posture", 14)]
    arms = [
        Arm(flex=4 * a, abduct=30 + 6 * openness + 2.5 * b, twist=8 * spread + 3 * c, elbow=12 + 5 * d)
        for a, b, c, d in (draws[:4], draws[4:8])
    ]
    leg = Leg(abduct=2 + 3 * gap, twist=8 + 6 * spread)
    return Pose(Trunk(bend=2 * draws[8], nod=4 * draws[9], look=5 * draws[10]), arms[0], arms[1], leg, leg)


def _draws(index: int, purpose: str, count: int) -> list[float]:
    """Draw numbers in [0, 1) that depend on this person and the purpose alone."""
    return [*map(float, Draws(0, 0, f"open/person-{index:03d}").generator(purpose).random(count))]


_LEVEL: Final = Arm(abduct=90, elbow=4)
_AHEAD: Final = Arm(flex=88, abduct=6, elbow=6)
_RAISED: Final = Arm(flex=168, abduct=14, elbow=10)
HIP_HAND: Final = Arm(flex=-28, abduct=49, twist=-36, elbow=91, supinate=-20, wrist=27, fist=0.3)
_STRAIGHT: Final = Leg()
_WIDE: Final = Leg(abduct=14, twist=10)

# Symmetric: the mirror image is the same posture.
_SYMMETRIC: Final[dict[str, Pose]] = {
    "standing": Pose(),
    "a_pose": symmetric(Trunk(), Arm(abduct=40, elbow=6), Leg(abduct=3)),
    "t_pose": symmetric(Trunk(), _LEVEL, _STRAIGHT),
    "arms_up": symmetric(Trunk(), _RAISED, _STRAIGHT),
    "arms_forward": symmetric(Trunk(), _AHEAD, _STRAIGHT),
    "hands_on_hips": symmetric(Trunk(), HIP_HAND, Leg(abduct=4, twist=10)),
    "half_squat": symmetric(Trunk(lean=22, bend=8, nod=-16), Arm(flex=105, abduct=5, elbow=10), Leg(62, 6, 12, 72)),
    "deep_squat": symmetric(Trunk(lean=30, bend=22, nod=-28), Arm(flex=118, abduct=8, elbow=12), Leg(118, 14, 20, 122)),
    "forward_bend": symmetric(Trunk(lean=48, bend=52, nod=5), Arm(flex=92, abduct=6, elbow=5), Leg(flex=44, knee=6)),
    "star": symmetric(Trunk(), Arm(abduct=135, elbow=5), Leg(abduct=22, twist=14)),
    "arms_back": symmetric(Trunk(lean=14, bend=10, nod=-14), Arm(flex=-45, abduct=14, elbow=6), Leg(26, 2, 5, 30)),
    "tiptoe": symmetric(Trunk(), Arm(flex=155, abduct=30, elbow=14), Leg(ankle=34, toes=30)),
    "hands_at_head": symmetric(Trunk(), Arm(abduct=110, twist=93, elbow=128, fist=0.2), Leg(abduct=4)),
    "kneeling": symmetric(Trunk(), Arm(elbow=25, flex=8), Leg(4, 2, 0, 92, planted=0, ankle=38)),
    "arched_back": symmetric(Trunk(lean=-8, bend=-26, nod=-22), Arm(flex=-20, abduct=42, elbow=8), Leg(-4, 4, 8, 4)),
    "hands_in_front": symmetric(
        Trunk(nod=8), Arm(flex=24, abduct=5, twist=-32, elbow=42, supinate=-10, fist=0.2), _STRAIGHT
    ),
}

# Asymmetric: each is followed by its mirror image.
_ASYMMETRIC: Final[dict[str, Pose]] = {
    "arm_raised": Pose(Trunk(side=-4), replace(_RAISED, elbow=6), Arm()),
    "walk_contact": Pose(
        Trunk(lean=3, twist=-8),
        Arm(flex=-24, abduct=10, elbow=14),
        Arm(flex=26, abduct=8, elbow=28),
        Leg(flex=30, knee=9, planted=0.5),
        Leg(flex=-16, knee=14, ankle=8, toes=22),
    ),
    "walk_swing": Pose(
        Trunk(lean=3, twist=3),
        Arm(flex=4, abduct=8, elbow=18),
        Arm(flex=2, abduct=8, elbow=18),
        Leg(flex=2, knee=4),
        Leg(flex=24, knee=58, planted=0, ankle=8),
    ),
    "run": Pose(
        Trunk(lean=12, bend=4, twist=-14, nod=-8, look=8),
        Arm(flex=-50, abduct=24, twist=8, elbow=88, fist=0.6),
        Arm(flex=48, abduct=8, twist=-16, elbow=95, fist=0.6),
        Leg(flex=74, knee=82, planted=0, ankle=0),
        Leg(flex=-10, knee=18, ankle=26, toes=28),
    ),
    "lunge": Pose(
        Trunk(lean=4),
        HIP_HAND,
        HIP_HAND,
        Leg(flex=74, abduct=0, knee=72),
        Leg(flex=-8, abduct=-2, knee=70, planted=0, ankle=-12, toes=45),
    ),
    "side_lunge": Pose(
        Trunk(lean=18, bend=10, side=6, nod=-12),
        Arm(flex=80, abduct=10, elbow=30),
        Arm(flex=80, abduct=10, elbow=30),
        Leg(flex=72, abduct=28, twist=22, knee=76),
        Leg(flex=18, abduct=40, twist=8, knee=2),
    ),
    "crane": Pose(
        Trunk(roll=-2),
        Arm(abduct=82, elbow=30, wrist=20),
        Arm(abduct=82, elbow=30, wrist=20),
        Leg(flex=86, abduct=6, knee=98, planted=0, ankle=22),
        Leg(abduct=-7),
    ),
    "side_bend": Pose(
        Trunk(side=32, tilt=10), Arm(abduct=46, flex=8, elbow=8), Arm(abduct=160, flex=10, elbow=28), _WIDE, _WIDE
    ),
    "trunk_twist": Pose(
        Trunk(twist=48, look=22),
        Arm(flex=-12, abduct=72, elbow=30),
        Arm(flex=72, abduct=20, elbow=40),
        Leg(abduct=6, twist=10),
        Leg(abduct=6, twist=10),
    ),
    "front_kick": Pose(
        Trunk(lean=-10, bend=10, twist=-10),
        Arm(flex=-22, abduct=44, elbow=50, fist=0.9),
        Arm(flex=48, abduct=18, elbow=88, fist=0.9),
        Leg(flex=88, abduct=4, knee=16, planted=0, ankle=5),
        Leg(flex=-8, abduct=-6, knee=10),
    ),
    "throw": Pose(
        Trunk(lean=-6, bend=-10, twist=-34, look=26),
        Arm(flex=75, abduct=28, elbow=22),
        Arm(abduct=104, twist=65, elbow=88, fist=0.4),
        Leg(flex=26, abduct=4, knee=10),
        Leg(flex=-10, abduct=8, twist=28, knee=30),
    ),
    "reach_up_side": Pose(
        Trunk(side=-14, tilt=-6, look=14),
        Arm(abduct=146, elbow=8),
        Arm(abduct=24, elbow=14),
        Leg(abduct=12, twist=10),
        Leg(abduct=12, twist=10),
    ),
    "archer": Pose(
        Trunk(twist=-30, look=74),
        Arm(abduct=90, flex=0, elbow=4, fist=0.8),
        Arm(abduct=92, twist=-6, elbow=120, fist=0.8),
        _WIDE,
        _WIDE,
    ),
    "punch": Pose(
        Trunk(lean=4, twist=30, look=-24),
        Arm(flex=42, abduct=18, twist=-18, elbow=118, fist=1),
        Arm(flex=88, abduct=22, elbow=6, supinate=-60, fist=1),
        Leg(flex=40, abduct=4, twist=4, knee=48),
        Leg(flex=-14, abduct=8, twist=24, knee=14),
    ),
    "half_kneeling": Pose(
        Trunk(lean=2),
        Arm(flex=44, abduct=10, elbow=42, wrist=10),
        Arm(elbow=20),
        Leg(flex=88, abduct=6, knee=90),
        Leg(flex=-2, abduct=0, twist=0, knee=92, planted=0, ankle=-18, toes=60),
    ),
    "arms_crossed": Pose(
        Trunk(bend=6, nod=6),
        Arm(flex=60, abduct=2, twist=-54, elbow=88, supinate=-20),
        Arm(flex=32, abduct=6, twist=-58, elbow=86, supinate=-20),
    ),
}

_SYMMETRIC_FOR_TESTING: Final[dict[str, Pose]] = {
    "sitting": symmetric(Trunk(lean=4, bend=8, nod=-4), Arm(flex=38, abduct=8, elbow=48, wrist=8), Leg(90, 6, 8, 88)),
    "surrender": symmetric(Trunk(), Arm(abduct=92, twist=84, elbow=88), Leg(abduct=5, twist=10)),
}

_ASYMMETRIC_FOR_TESTING: Final[dict[str, Pose]] = {
    "fencing": Pose(
        Trunk(twist=-20, look=26),
        Arm(flex=82, abduct=14, elbow=14, fist=0.7),
        Arm(abduct=78, flex=-22, twist=40, elbow=92, wrist=10),
        Leg(flex=48, abduct=10, twist=6, knee=48),
        Leg(flex=-8, abduct=30, twist=40, knee=6),
    ),
    "arabesque": Pose(
        Trunk(lean=58, bend=-22, nod=-30),
        Arm(abduct=92, elbow=6),
        Arm(abduct=92, elbow=6),
        Leg(flex=-12, knee=8, planted=0, ankle=40),
        Leg(flex=54, abduct=-6, knee=4),
    ),
    "wave": Pose(
        Trunk(side=-4, tilt=4), Arm(abduct=96, twist=78, elbow=72), Arm(abduct=12), Leg(abduct=3), Leg(abduct=3)
    ),
    "step_up": Pose(
        Trunk(lean=14, bend=6, nod=-6),
        Arm(flex=-26, abduct=12, elbow=24),
        Arm(flex=52, abduct=8, elbow=44),
        Leg(flex=78, abduct=2, knee=72),
        Leg(flex=2, knee=12, ankle=14, toes=16),
    ),
}

# Share of the way from the first to the second.
_BLENDS: Final = (
    ("t_pose", "half_squat", 0.5),
    ("t_pose", "arms_up", 0.5),
    ("arms_forward", "deep_squat", 0.45),
    ("hands_on_hips", "forward_bend", 0.5),
    ("star", "side_bend", 0.5),
    ("walk_contact", "walk_swing_mirrored", 0.5),
    ("run", "front_kick", 0.5),
    ("lunge", "arms_up", 0.35),
    ("throw", "punch", 0.5),
)
_BLENDS_FOR_TESTING: Final = (
    ("fencing", "surrender", 0.5),
    ("wave_mirrored", "step_up", 0.5),
    ("surrender", "wave", 0.5),
    ("arabesque", "step_up", 0.6),
)


def _listed() -> tuple[tuple[str, Pose], ...]:
    poses: dict[str, Pose] = {}
    for same, mirrored, blends in (
        (_SYMMETRIC, _ASYMMETRIC, _BLENDS),
        (_SYMMETRIC_FOR_TESTING, _ASYMMETRIC_FOR_TESTING, _BLENDS_FOR_TESTING),
    ):
        poses |= same
        for name, pose in mirrored.items():
            poses[name] = pose
            poses[f"{name}_mirrored"] = pose.mirrored()
        for first, second, share in blends:
            poses[f"{first}-to-{second}"] = poses[first].blend(poses[second], share)
    return tuple(poses.items())


POSTURES: Final = _listed()
"""(name, pose) in the order in which meshes are numbered."""

EVERYDAY_POSES: Final[dict[str, Pose]] = {
    "desk": symmetric(Trunk(bend=8, nod=6), Arm(flex=32, abduct=10, twist=-14, elbow=72), Leg(90, 6, 8, 88)),
    "kick": Pose(
        Trunk(lean=-8, bend=10, twist=-8),
        Arm(flex=-14, abduct=34, elbow=62, fist=0.9),
        Arm(flex=44, abduct=16, elbow=96, fist=0.9),
        Leg(flex=82, abduct=2, knee=12, planted=0),
        Leg(flex=-6, abduct=-5, knee=8),
    ),
    "fist": Pose(Trunk(look=-6), Arm(flex=10, elbow=18), Arm(flex=152, abduct=16, elbow=34, fist=1)),
}
"""Poses of no set, to test with: at a desk, a kick to the front, a fist above the head."""
