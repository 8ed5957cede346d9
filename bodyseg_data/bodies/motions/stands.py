"""Motions on the spot: squats, and the crane of martial arts on one leg and then the other."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from bodyseg_data.bodies.motions.curves import Build, PoseTrack, Sole, Track, pelvis_over, standing, wander
from bodyseg_data.bodies.skeleton import Arm, Leg, Pose, Trunk, symmetric


class Squats:
    """Squats on fixed soles.

    highest, lowest: the poses between which the body goes; of their legs, hip, knee and ankle are used. times,
    depths: key times, seconds, and the depth at each, 0 to 1. apart: distance of the ankles, metres. toe_out: degrees.
    """

    def __init__(
        self, highest: Pose, lowest: Pose, times: Sequence[float], depths: Sequence[float], apart: float, toe_out: float
    ) -> None:
        self._poses = PoseTrack(
            [(time, highest.blend(lowest, depth)) for time, depth in zip(times, depths, strict=True)]
        )
        left = Sole(apart / 2, 0, toe_out)
        self._soles = (left, left.mirrored())

    def at(self, build: Build, time: float) -> Pose:
        """Return the pose at a time in seconds."""
        pose = self._poses.at(time)
        trunk = replace(
            pose.trunk,
            turn=3 * wander(time, 1, 6.3),
            twist=4 * wander(time, 2, 5.1),
            side=1.5 * wander(time, 3, 4.4),
            look=7 * wander(time, 4, 7.9),
            nod=pose.trunk.nod + 2 * wander(time, 5, 5.7),
        )
        arms = (_with_sway(pose.left_arm, time, 6), _with_sway(pose.right_arm, time, 7))
        pelvis = pelvis_over(build, pose)
        pelvis[0] = 0.012 * wander(time, 8, 5.5)
        return standing(build, pelvis, trunk, arms, self._soles)


def _with_sway(arm: Arm, time: float, number: int) -> Arm:
    return replace(
        arm, flex=arm.flex + 3 * wander(time, number, 4.9), elbow=arm.elbow + 2 * (1 + wander(time, number, 3.7))
    )


SQUATS_B: Final = Squats(
    symmetric(Trunk(lean=2, bend=2), Arm(flex=10, abduct=9, elbow=14), Leg(flex=6, knee=8)),
    symmetric(Trunk(lean=31, bend=20, nod=-22), Arm(flex=128, abduct=5, elbow=6), Leg(flex=117, knee=114)),
    (0, 0.3, 1.2, 1.35, 2.0, 2.2, 3.1, 3.3, 4.0, 4.1, 4.8, 4.9, 5.5, 5.7, 6.7, 7.0, 7.7, 7.9, 8.7, 8.9, 9.6, 10.0),
    (0, 0, 0.8, 0.8, 0.03, 0.03, 1, 1, 0.05, 0.05, 0.6, 0.6, 0.02, 0.02, 0.96, 1, 0.04, 0.04, 0.86, 0.86, 0, 0),
    apart=0.36, toe_out=14,
)  # fmt: skip
"""Six squats of a man who reaches ahead with straight arms."""

SQUATS_C: Final = Squats(
    symmetric(Trunk(lean=1, bend=2), Arm(flex=14, abduct=16, twist=-22, elbow=56, wrist=4), Leg(flex=14, knee=22)),
    symmetric(
        Trunk(lean=17, bend=14, nod=-12), Arm(flex=44, abduct=16, twist=-30, elbow=112, wrist=-4),
        Leg(flex=104, knee=113),
    ),
    (0, 0.5, 1.9, 2.4, 3.5, 3.8, 5.0, 5.3, 5.8, 6.2, 7.2, 7.4, 8.6, 9.2, 10.0),
    (0, 0, 0.9, 0.9, 0.1, 0.1, 1, 1, 0.7, 1, 0.02, 0.02, 0.78, 0.78, 0.3),
    apart=0.5, toe_out=30,
)  # fmt: skip
"""Slower squats of a woman with feet wide apart and hands before the chest, once with a bounce at the bottom."""

_LIFTED: Final = Leg(flex=88, abduct=4, twist=5, knee=102, planted=0, ankle=24)
_KICKING: Final = Leg(flex=92, abduct=2, twist=5, knee=22, planted=0, ankle=30)
_APART: Final = 0.2

_UPPER: Final = PoseTrack(
    [
        (0.0, Pose(Trunk(lean=1), Arm(), Arm())),
        (0.3, Pose(Trunk(lean=1), Arm(), Arm())),
        (1.4, Pose(Trunk(bend=2), Arm(abduct=86, elbow=26, wrist=34), Arm(abduct=86, elbow=26, wrist=34))),
        (2.6, Pose(Trunk(side=2, look=6), Arm(abduct=78, elbow=34, wrist=26), Arm(abduct=84, elbow=26, wrist=34))),
        (3.7, Pose(Trunk(lean=3), Arm(abduct=62, elbow=30, wrist=10), Arm(abduct=62, elbow=30, wrist=10))),
        (4.7, Pose(Trunk(bend=2, look=-8), Arm(abduct=94, elbow=22, wrist=40), Arm(abduct=88, elbow=30, wrist=30))),
        (5.4, Pose(Trunk(lean=-5, bend=6), Arm(abduct=84, elbow=32, wrist=26), Arm(abduct=88, elbow=24, wrist=34))),
        (6.2, Pose(Trunk(lean=1), Arm(abduct=70, elbow=22, wrist=16), Arm(abduct=70, elbow=22, wrist=16))),
        (7.0, Pose(Trunk(lean=1), Arm(abduct=26), Arm(abduct=26))),
    ]
)
_WEIGHT: Final = Track((0.2, 1.0, 3.1, 3.9, 6.2, 6.9), (0, -1, -1, 1, 1, 0))
"""Weight on the feet: 1 all on the left one, -1 all on the right one."""

_LEFT_LIFT: Final = Track((0.75, 1.6, 2.75, 3.35), (0, 1, 1, 0))
_RIGHT_LIFT: Final = Track((3.6, 4.4, 5.75, 6.45), (0, 1, 1, 0))
_KICK: Final = Track((4.7, 5.15, 5.3, 5.7), (0, 1, 1, 0))
_BEAT: Final = Track((1.0, 1.8, 5.6, 6.3), (0, 1, 1, 0))


def crane(build: Build, time: float) -> Pose:
    """Return the crane's pose at a time in seconds: arms beat like wings, left knee up, then the right, which kicks."""
    pose = _UPPER.at(time)
    beat = _BEAT.one(time) * math.sin(2 * math.pi * time / 1.15 + 0.3 * wander(time, 1, 3.1))
    arms = tuple(
        replace(
            arm,
            flex=arm.flex + 5 * wander(time, number, 4.1),
            abduct=arm.abduct + 17 * beat + 2 * wander(time, number, 3.3),
            wrist=arm.wrist - 16 * beat,
            elbow=arm.elbow + 5 * beat,
        )
        for number, arm in ((2, pose.left_arm), (3, pose.right_arm))
    )
    weight, sway = _WEIGHT.one(time), wander(time, 4, 2.3)
    trunk = replace(
        pose.trunk,
        roll=-1.5 * weight + 1.2 * sway,
        turn=4 * wander(time, 5, 5.2),
        side=pose.trunk.side + weight - 2 * sway,
        twist=3 * wander(time, 6, 3.6),
        nod=2 * wander(time, 7, 4.7),
    )
    stance = Leg(flex=7 + 4 * abs(weight), knee=9 + 6 * abs(weight) + wander(time, 8, 2.9))
    pelvis = pelvis_over(build, replace(pose, left_leg=stance))
    pelvis[0] = weight * (_APART / 2 - 0.015) + 0.008 * sway
    left = Sole(_APART / 2, 0, 8)
    planted = standing(build, pelvis, trunk, (arms[0], arms[1]), (left, left.mirrored()))
    raised = _LIFTED.blend(_KICKING, _KICK.one(time))
    return replace(
        planted,
        left_leg=planted.left_leg.blend(_LIFTED, _LEFT_LIFT.one(time)),
        right_leg=planted.right_leg.blend(raised, _RIGHT_LIFT.one(time)),
    )
