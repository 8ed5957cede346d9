"""The source `hard`: a small test set of postures; `open` trains two of them to 3 degrees, hands on hips and kneeling.

Crossed and folded arms, hands at face, hips and back, sitting, kneeling, bent double, lying, each by another person,
and one person turned through a full circle.
"""

from dataclasses import replace
from functools import partial
from typing import Final

from bodyseg_data.bodies.anny_model import Figure
from bodyseg_data.bodies.anny_people import HIP_HAND, PEOPLE, person
from bodyseg_data.bodies.outfits import of_every_third
from bodyseg_data.bodies.skeleton import Arm, Leg, Pose, Trunk, symmetric
from bodyseg_data.bodies.source import BodyRef
from bodyseg_data.bodies.sources.open_bodies import Listed, MadeBodies

_STANDING: Final = Leg(abduct=-2, twist=7)
_THIGH_HAND: Final = Arm(flex=34, abduct=8, twist=-6, elbow=26, supinate=-60, fist=0.2)
_FOLDED: Final = Leg(flex=118, abduct=12, twist=10, knee=126, planted=0, ankle=10)


def _same_legs(trunk: Trunk, left: Arm, right: Arm, legs: Leg = _STANDING) -> Pose:
    """Return the pose whose legs have the same angles."""
    return Pose(trunk, left, right, legs, legs)


_POSES: Final[dict[str, Pose]] = {
    # Arms before the trunk, on it, behind it.
    "arms_crossed": _same_legs(
        Trunk(bend=4, nod=4),
        Arm(flex=58, abduct=4, twist=-56, elbow=98, supinate=-10),
        Arm(flex=32, abduct=10, twist=-60, elbow=94, supinate=-10),
    ),
    "arms_crossed_low": _same_legs(
        Trunk(lean=2, bend=6, nod=10),
        Arm(flex=28, abduct=10, twist=-60, elbow=82, supinate=-20),
        Arm(flex=42, abduct=4, twist=-56, elbow=86, supinate=-20),
    ),
    "hugging_oneself": _same_legs(
        Trunk(bend=10, nod=14),
        Arm(flex=70, abduct=-4, twist=-44, elbow=118),
        Arm(flex=58, abduct=-2, twist=-46, elbow=116),
    ),
    "hand_on_shoulder": _same_legs(Trunk(look=10), Arm(), Arm(flex=62, abduct=0, twist=-44, elbow=126)),
    "hands_on_hips": symmetric(Trunk(), HIP_HAND, Leg(abduct=5, twist=10)),
    "hand_on_hip": _same_legs(Trunk(roll=4, side=-6, look=20), HIP_HAND, Arm(abduct=12), Leg(abduct=4, twist=10)),
    "hands_clasped": symmetric(Trunk(nod=6), Arm(flex=20, abduct=10, twist=-48, elbow=52, supinate=-20), _STANDING),
    "praying": symmetric(Trunk(nod=14), Arm(flex=44, abduct=14, twist=-36, elbow=112, wrist=-30), _STANDING),
    "hand_behind_back": _same_legs(
        Trunk(), Arm(flex=-46, abduct=20, twist=-58, elbow=72, supinate=30), Arm(abduct=12, elbow=14)
    ),
    "hands_behind_back": symmetric(
        Trunk(bend=-4), Arm(flex=-38, abduct=18, twist=-58, elbow=60, supinate=20), _STANDING
    ),
    "hand_at_face": _same_legs(
        Trunk(nod=10), Arm(flex=42, abduct=6, twist=-20, elbow=136, wrist=10), Arm(flex=10, elbow=20)
    ),
    "hands_at_face": symmetric(Trunk(nod=12), Arm(flex=62, abduct=8, twist=-14, elbow=132, wrist=6), _STANDING),
    "phone_at_ear": _same_legs(
        Trunk(tilt=6, look=8), Arm(flex=24, abduct=44, twist=34, elbow=142, wrist=10, fist=0.5), Arm(abduct=10)
    ),
    "hands_behind_head": symmetric(Trunk(bend=-4), Arm(flex=12, abduct=108, twist=92, elbow=136, fist=0.2), _STANDING),
    "scratching_head": _same_legs(Trunk(tilt=-8, nod=8), Arm(flex=60, abduct=96, twist=70, elbow=122), Arm(abduct=10)),
    # Bent double.
    "touching_toes": symmetric(Trunk(lean=62, bend=66, nod=12), Arm(flex=112, abduct=4, elbow=6), Leg(flex=58, knee=6)),
    "hanging_forward": symmetric(
        Trunk(lean=70, bend=58, nod=20), Arm(flex=124, abduct=10, elbow=20), Leg(flex=72, abduct=5, knee=16)
    ),
    "hands_on_knees": symmetric(
        Trunk(lean=42, bend=22, nod=-26),
        Arm(flex=52, abduct=2, elbow=12, supinate=-40, fist=0.3),
        Leg(flex=72, abduct=6, knee=44),
    ),
    "looking_under": _same_legs(
        Trunk(lean=56, bend=50, twist=26, nod=14, look=24),
        Arm(flex=80, abduct=10, elbow=26),
        Arm(flex=118, abduct=14, elbow=10),
        Leg(flex=74, abduct=10, knee=42),
    ),
    # Sitting, on a chair (which is not modelled) and on the floor.
    "sitting_upright": symmetric(Trunk(lean=-2, bend=6), _THIGH_HAND, Leg(88, 8, 8, 88)),
    "sitting_bent": symmetric(
        Trunk(lean=10, bend=26, nod=-12), Arm(flex=64, abduct=8, twist=-28, elbow=58), Leg(104, 10, 8, 96)
    ),
    "sitting_legs_crossed": Pose(
        Trunk(lean=-10, bend=14),
        Arm(flex=36, abduct=16, twist=-14, elbow=44, supinate=-50),
        Arm(flex=30, abduct=10, elbow=30, supinate=-50),
        Leg(flex=101, abduct=18, twist=66, knee=94, planted=0, ankle=10),
        Leg(74, 6, 6, 82),
    ),
    "sitting_on_floor": symmetric(
        Trunk(lean=-24, bend=8, nod=8),
        Arm(flex=-46, abduct=18, twist=10, elbow=8, wrist=-60),
        Leg(flex=62, abduct=8, twist=12, knee=4, planted=0, ankle=14),
    ),
    "sitting_cross_legged": Pose(
        Trunk(lean=-12, bend=24, nod=2),
        Arm(flex=34, abduct=14, elbow=30, supinate=-50),
        Arm(flex=36, abduct=12, elbow=34, supinate=-50),
        Leg(flex=76, abduct=50, twist=78, knee=128, planted=0, ankle=24),
        Leg(flex=74, abduct=48, twist=74, knee=92, planted=0, ankle=24),
    ),
    "hugging_knees": symmetric(
        Trunk(lean=-24, bend=34, nod=12),
        Arm(flex=78, abduct=10, twist=-36, elbow=44),
        Leg(flex=116, abduct=0, knee=112),
    ),
    # Kneeling and on all fours.
    "kneeling": symmetric(Trunk(), Arm(elbow=22, flex=8), Leg(4, 4, 0, 92, planted=0, ankle=38)),
    "sitting_on_heels": symmetric(Trunk(lean=-2, bend=8), _THIGH_HAND, Leg(49, 4, 0, 136, planted=0, ankle=48)),
    "half_kneeling": Pose(
        Trunk(lean=10, bend=12),
        Arm(flex=48, abduct=12, twist=-20, elbow=56),
        Arm(flex=20, elbow=24),
        Leg(flex=98, abduct=8, knee=92),
        Leg(flex=8, twist=0, knee=98, planted=0, ankle=-14, toes=55),
    ),
    "on_all_fours": symmetric(
        Trunk(lean=82, bend=4, nod=-24),
        Arm(flex=86, abduct=8, twist=-6, elbow=6, supinate=-70, wrist=-78),
        Leg(flex=84, abduct=4, twist=0, knee=88, planted=0, ankle=40),
    ),
    # Lying.
    "lying_on_back": symmetric(
        Trunk(lean=-90), Arm(abduct=18, flex=-2, elbow=10), Leg(abduct=5, twist=18, planted=0, ankle=26)
    ),
    "lying_knees_up": symmetric(
        Trunk(lean=-90, turn=35), Arm(flex=14, abduct=22, twist=-50, elbow=72), Leg(52, 4, 0, 104, planted=0, ankle=36)
    ),
    "lying_arms_up": Pose(
        Trunk(lean=-90, turn=90, look=24),
        Arm(flex=-8, abduct=118, twist=90, elbow=58),
        Arm(flex=-10, abduct=34, elbow=14),
        Leg(abduct=12, twist=22, planted=0, ankle=28),
        Leg(flex=14, abduct=16, twist=24, knee=38, planted=0, ankle=24),
    ),
    "lying_on_front": Pose(
        Trunk(lean=90, turn=-30, look=52, nod=-6),
        Arm(flex=10, abduct=118, twist=86, elbow=84),
        Arm(flex=8, abduct=112, twist=84, elbow=70),
        Leg(abduct=6, planted=0, ankle=44),
        Leg(abduct=10, planted=0, ankle=44),
    ),
    "lying_on_side": Pose(
        Trunk(roll=90, turn=80, bend=16, tilt=-16),
        Arm(flex=96, abduct=6, elbow=84),
        Arm(flex=66, abduct=-22, elbow=44),
        Leg(flex=30, abduct=0, knee=46, planted=0, ankle=20),
        Leg(flex=74, abduct=-26, knee=78, planted=0, ankle=20),
    ),
    "curled_up": Pose(
        Trunk(roll=90, turn=-60, bend=46, nod=26),
        Arm(flex=40, abduct=8, elbow=134),
        Arm(flex=46, abduct=0, elbow=128),
        replace(_FOLDED, flex=108, abduct=-2),
        replace(_FOLDED, flex=98, abduct=-12),
    ),
    "lying_on_elbows": symmetric(
        Trunk(lean=88, bend=-32, nod=-26, turn=150),
        Arm(flex=56, abduct=8, twist=-10, elbow=86, supinate=-40),
        Leg(flex=-4, abduct=7, planted=0, ankle=44),
    ),
}

_FIRST_PERSON: Final = PEOPLE  # people whom the open set does not have
_TURNS: Final = 24
_TURNED: Final = Pose(
    Trunk(bend=4, nod=3), Arm(flex=16, abduct=14, elbow=34), Arm(flex=-6, abduct=12, elbow=16), _STANDING, _STANDING
)


class HardBodies(MadeBodies):
    """Subset "hard", all for testing: 36 postures, each by another person, and one person turned in steps of 15."""

    def __init__(self) -> None:
        super().__init__("hard", dict([*_postures(), *_turned()]))


def _postures() -> Listed:
    for index, (name, pose) in enumerate(_POSES.items()):
        ref = BodyRef("hard", f"H{index:02d}", f"hard-{index:02d}", name, "test")
        yield ref, partial(Figure, person(_FIRST_PERSON + index), pose, outfit=of_every_third(index, 2))


def _turned() -> Listed:
    number = len(_POSES)
    for step in range(_TURNS):
        degrees = step * 360 // _TURNS
        ref = BodyRef("hard", f"H{number:02d}", f"turned-{degrees:03d}", f"turned_{degrees:03d}", "test")
        pose = replace(_TURNED, trunk=replace(_TURNED.trunk, turn=float(degrees)))
        yield ref, partial(Figure, person(_FIRST_PERSON + number), pose)
