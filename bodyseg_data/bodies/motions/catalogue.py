"""Catalogue of the motions of subjects B and C: for every frame a pose and a height above the floor.

Each subject's four motions and their numbers of frames are those of the paper's two MIT subjects.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

from bodyseg_data.bodies.anny_people import SUBJECT_B, SUBJECT_C, Person
from bodyseg_data.bodies.motions.curves import Build, angles, from_angles
from bodyseg_data.bodies.motions.handstand import handstand
from bodyseg_data.bodies.motions.jumps import Bounces, Jumps
from bodyseg_data.bodies.motions.stands import SQUATS_B, SQUATS_C, crane
from bodyseg_data.bodies.motions.walk import Gait, walking
from bodyseg_data.bodies.skeleton import Pose

FRAMES_PER_SECOND: Final = 25

_DECIMALS: Final = 4  # of a degree: the last bits of sines differ between machines


@dataclass(frozen=True)
class Motion:
    """A motion of `frames` frames; at(seconds) returns the pose and its lowest point's height, metres."""

    frames: int
    at: Callable[[float], tuple[Pose, float]]

    def frame(self, number: int) -> tuple[Pose, float]:
        """Return frame `number`, from 0, as `at` does, rounded to four decimals of a degree and six of a metre."""
        pose, height = self.at(number / FRAMES_PER_SECOND)
        return from_angles(angles(pose), _DECIMALS), round(height, 6)


BUILD_B: Final = Build(
    hip=(0.1241, -0.0085, -0.0110),
    thigh=(0.0344, -0.4409, 0.0354),
    shin=(0.0496, -0.4657, -0.0240),
    ball=(0.0, -0.0805, 0.164),
    heel=(0.0, -0.0805, -0.050),
)
BUILD_C: Final = Build(
    hip=(0.0998, -0.0127, -0.0047),
    thigh=(0.0372, -0.3740, 0.0318),
    shin=(0.0297, -0.4144, -0.0344),
    ball=(0.0, -0.0756, 0.140),
    heel=(0.0, -0.0756, -0.035),
)

STRIDES_B: Final = Gait(
    stride=1.22, seconds=1.16, turn=40, apart=0.19, pelvis=0.985, bob=0.019, sway=0.022, list=3, sweep=4.5, arms=22,
    arms_out=14, elbow=14, lean=3, toe_out=7, hip=26, first=0.2,
)  # fmt: skip
STRIDES_C: Final = Gait(
    stride=1.10, seconds=1.02, turn=-36, apart=0.15, pelvis=0.863, bob=0.019, sway=0.024, list=5, sweep=6.5, arms=25,
    arms_out=15, elbow=13, lean=1, toe_out=4, hip=29, first=0.43,
)  # fmt: skip


def _standing(motion: Callable[[float], Pose]) -> Callable[[float], tuple[Pose, float]]:
    return lambda time: (motion(time), 0.0)


MOTIONS: Final[Mapping[Literal["B", "C"], Mapping[str, Motion]]] = {
    "B": {
        "crane": Motion(175, _standing(lambda time: crane(BUILD_B, time))),
        "jumping": Motion(150, Jumps(BUILD_B).at),
        "march": Motion(250, _standing(lambda time: walking(BUILD_B, STRIDES_B, time))),
        "squat": Motion(250, _standing(lambda time: SQUATS_B.at(BUILD_B, time))),
    },
    "C": {
        "bouncing": Motion(175, Bounces(BUILD_C).at),
        "handstand": Motion(175, _standing(lambda time: handstand(BUILD_C, time))),
        "march": Motion(250, _standing(lambda time: walking(BUILD_C, STRIDES_C, time))),
        "squat": Motion(250, _standing(lambda time: SQUATS_C.at(BUILD_C, time))),
    },
}
"""Motions by subject and name, in the order in which meshes are listed."""

SUBJECTS: Final[Mapping[Literal["B", "C"], Person]] = {"B": SUBJECT_B, "C": SUBJECT_C}
