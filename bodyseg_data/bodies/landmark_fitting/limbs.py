"""Arms and legs to try for a fitted body: a grid over the ranges of shoulder, elbow, hip, knee and ankle."""

from __future__ import annotations

from typing import Final

from bodyseg_data.bodies.anny.skeleton import Arm, Leg, Pose, Trunk

_ELBOWS_DEG: Final = (12, 75, 130)

ARMS: Final = (
    *(
        Arm(flex=flex, abduct=8, twist=twist, elbow=elbow)
        for flex in (0, 50, 100, 160)
        for twist in (-50, 0)
        for elbow in _ELBOWS_DEG
    ),
    *(
        Arm(abduct=abduct, twist=twist, elbow=elbow)
        for abduct in (50, 100, 150)
        for twist in (0, 80)
        for elbow in _ELBOWS_DEG
    ),
    Arm(flex=-40, abduct=16, elbow=12),
    Arm(flex=-35, abduct=40, twist=-45, elbow=85),
)
"""Raised to the front, to the side, and to the back, turned and bent."""

LEGS: Final = tuple(
    Leg(flex=flex, abduct=abduct, twist=twist, knee=knee, planted=0, ankle=ankle)
    for flex in (-5, 45, 95)
    for abduct, twist in ((0, 5), (35, 55))
    for knee, ankle in ((5, 0), (55, 20), (100, 5), (100, 45), (135, 25))
)
"""Raised to the front and to the side, bent at the knee; the foot square to the shin, or pointed."""

LIMB_POSES: Final = {
    "arm": tuple(Pose(Trunk(), arm, arm, Leg(), Leg()) for arm in ARMS),
    "leg": tuple(Pose(Trunk(), Arm(), Arm(), leg, leg) for leg in LEGS),
}
"""Poses that hold each of them on both sides."""
