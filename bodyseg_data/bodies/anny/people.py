"""583 different people: the body parameters of each, computed from the person's number alone."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.anny.skeleton import Arm, Leg, Pose, Trunk
from bodyseg_data.core.randomness import generator

PEOPLE: Final = 583


@dataclass(frozen=True)
class Person:
    """Parameters of a person's body.

    female: 0 or 1, or between for neither. years: age. stature_m: height. The rest are 0 to 1, least to most:
    muscle, weight, proportions (1 the least usual), cupsize, firmness, african, asian, caucasian (mixed by their
    ratio).
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
    stature = NormalDist(mean, deviation).inv_cdf(float(0.005 + 0.99 * draws[0]))
    least_weight = 0.45 if female else 0.3
    return Person(
        female=female,
        years=float(18 + 62 * draws[1]),
        stature_m=stature,
        muscle=float(0.2 + 0.65 * draws[2]),
        weight=float(least_weight + (1 - least_weight) * draws[3]),
        proportions=float(0.15 + 0.7 * draws[4]),
        cupsize=float(0.25 + 0.6 * draws[5]),
        firmness=float(0.3 + 0.5 * draws[6]),
        african=float(0.02 + draws[7] ** 2),
        asian=float(0.02 + draws[8] ** 2),
        caucasian=float(0.02 + draws[9] ** 2),
    )


def standing_pose(index: int) -> Pose:
    """Return the standing pose of person number `index`: arms a little off the body, with individual differences."""
    draws = 2 * _draws(index, "posture", 14) - 1
    openness, gap, spread = draws[:3]
    arms = [
        Arm(
            flex=float(4 * a),
            abduct=float(30 + 6 * openness + 2.5 * b),
            twist=float(8 * spread + 3 * c),
            elbow=float(12 + 5 * d),
        )
        for a, b, c, d in (draws[3:7], draws[7:11])
    ]
    leg = Leg(abduct=float(2 + 3 * gap), twist=float(8 + 6 * spread))
    trunk = Trunk(bend=float(2 * draws[11]), nod=float(4 * draws[12]), look=float(5 * draws[13]))
    return Pose(trunk, arms[0], arms[1], leg, leg)


def _draws(index: int, purpose: str, count: int) -> NDArray[np.float64]:
    """Draw numbers in [0, 1) that depend on this person and the purpose alone."""
    return generator(0, 0, f"open/person-{index:03d}", purpose).random(count)
