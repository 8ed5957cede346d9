"""The source `wide`: the open bodies, and 900 more people for training in randomly drawn postures.

Networks trained on `open` fail on unseen poses: on the floor, with arms before the trunk (docs/results/failures.md).
Each drawn posture is a stance and two arms, independent of one another, every joint uniform within a range. So people
who crouch cross their arms as well as people who stand, and no posture is copied from `hard`, which remains a test set.
No floor or chair is modelled, and limbs may touch or intersect a little.
"""

from __future__ import annotations

from functools import partial
from typing import Final, NamedTuple

import numpy as np

from bodyseg_data.bodies.anny.model import Figure
from bodyseg_data.bodies.anny.people import person
from bodyseg_data.bodies.anny.skeleton import Arm, Leg, Pose, Trunk
from bodyseg_data.bodies.clothes.outfits import OUTFITS
from bodyseg_data.bodies.contacts.ranges import Ranges, within
from bodyseg_data.bodies.source import BodyRef
from bodyseg_data.bodies.sources.open_bodies import Listed, MadeBodies, Maker, OpenBodies
from bodyseg_data.core.randomness import generator

WIDE: Final = 900
_FIRST_PERSON: Final = 1000  # beyond those of the open and the hard set
_DRESSED_EVERY: Final = 3


class WideStance(NamedTuple):
    """Ranges of trunk and legs, degrees. alike: both legs have the same angles."""

    trunk: Ranges
    leg: Ranges
    alike: bool = False


_HEAD: Final[Ranges] = {"nod": (-20, 25), "tilt": (-15, 15), "look": (-45, 45)}
_LYING_LEG: Final[Ranges] = {
    "flex": (-5, 90), "abduct": (-4, 25), "twist": (-10, 40), "knee": (0, 110), "planted": (0, 0), "ankle": (5, 40),
}  # fmt: skip
_ANY_WAY: Final = {"turn": (-180.0, 180.0)}

STANCES: Final[dict[str, WideStance]] = {
    "upright": WideStance(
        {"lean": (-5, 8), "bend": (-8, 18), "side": (-12, 12), "twist": (-25, 25)} | _HEAD,
        {"flex": (-12, 25), "abduct": (-3, 15), "twist": (-5, 25), "knee": (0, 25)},
    ),
    "bent": WideStance(
        {"lean": (15, 65), "bend": (10, 60), "side": (-15, 15), "twist": (-25, 25)} | _HEAD,
        {"flex": (30, 75), "abduct": (0, 15), "twist": (0, 20), "knee": (0, 45)},
    ),
    "crouching": WideStance(
        {"lean": (5, 45), "bend": (5, 45), "side": (-10, 10), "twist": (-20, 20)} | _HEAD,
        {"flex": (70, 125), "abduct": (0, 30), "twist": (0, 35), "knee": (75, 132)},
    ),
    "on a chair": WideStance(
        {"lean": (-15, 15), "bend": (0, 35), "side": (-10, 10), "twist": (-20, 20)} | _HEAD,
        {"flex": (72, 108), "abduct": (-2, 25), "twist": (-5, 35), "knee": (60, 112)},
    ),
    "on the floor": WideStance(
        {"lean": (-35, 0), "bend": (0, 45), "twist": (-20, 20)} | _HEAD,
        {
            "flex": (55, 120),
            "abduct": (0, 42),
            "twist": (-5, 45),
            "knee": (0, 130),
            "planted": (0, 0),
            "ankle": (0, 25),
        },
    ),
    "kneeling": WideStance(
        {"lean": (-8, 25), "bend": (-5, 30), "side": (-10, 10), "twist": (-25, 25)} | _HEAD,
        {"flex": (-5, 60), "abduct": (0, 15), "knee": (85, 134), "planted": (0, 0), "ankle": (20, 48)},
        alike=True,
    ),
    "bent double": WideStance(
        {"lean": (60, 90), "bend": (0, 70), "twist": (-20, 20)} | _HEAD,
        {"flex": (55, 100), "abduct": (0, 15), "knee": (0, 95), "planted": (0, 0), "ankle": (0, 40)},
        alike=True,
    ),
    "on the back": WideStance({"lean": (-95, -80), "bend": (-5, 20)} | _HEAD | _ANY_WAY, _LYING_LEG),
    "on the front": WideStance(
        {"lean": (80, 95), "bend": (-25, 5)} | _HEAD | _ANY_WAY, _LYING_LEG | {"flex": (-10, 30), "knee": (0, 60)}
    ),
    "on the side": WideStance({"roll": (-95, 95), "bend": (0, 45)} | _HEAD | _ANY_WAY, _LYING_LEG),
}

ARMS: Final[dict[str, Ranges]] = {
    "hanging": {"flex": (-25, 30), "abduct": (4, 25), "twist": (-20, 20), "elbow": (0, 40)},
    "before the chest": {"flex": (20, 70), "abduct": (-6, 14), "twist": (-68, -40), "elbow": (75, 120)},
    "at the belly": {"flex": (5, 40), "abduct": (2, 16), "twist": (-62, -35), "elbow": (40, 95)},
    "at the face": {"flex": (25, 70), "abduct": (-4, 35), "twist": (-30, 10), "elbow": (112, 145)},
    "at the head": {"flex": (5, 65), "abduct": (70, 120), "twist": (50, 90), "elbow": (100, 142)},
    "on the hip": {"flex": (-35, -10), "abduct": (35, 55), "twist": (-45, -25), "elbow": (75, 105)},
    "on the thigh": {"flex": (15, 65), "abduct": (0, 16), "twist": (-30, 5), "elbow": (5, 65)},
    "behind the back": {"flex": (-50, -30), "abduct": (14, 28), "twist": (-62, -45), "elbow": (45, 80)},
    "forward": {"flex": (50, 125), "abduct": (-5, 30), "twist": (-30, 30), "elbow": (0, 70)},
    "to the side": {"flex": (-20, 30), "abduct": (50, 125), "twist": (-30, 80), "elbow": (0, 110)},
    "overhead": {"flex": (120, 175), "abduct": (0, 25), "twist": (-20, 40), "elbow": (0, 70)},
}

_HAND: Final[Ranges] = {"supinate": (-60, 40), "wrist": (-30, 30), "fist": (0, 0.8)}


class WideBodies(MadeBodies):
    """The bodies of `OpenBodies`, and the subset "wide": 900 people, all for training, each in another posture."""

    def __init__(self) -> None:
        opened = OpenBodies()
        figures: dict[BodyRef, Maker] = {ref: partial(opened.figure, ref) for ref in opened.bodies()}
        super().__init__("wide", figures | dict(_drawn()))


def _drawn() -> Listed:
    for index in range(WIDE):
        stance = [*STANCES][index % len(STANCES)]
        ref = BodyRef("wide", f"W{index:03d}", f"wide-{index:03d}", stance.replace(" ", "_"), "train")
        yield ref, partial(_figure, index)


def _figure(index: int) -> Figure:
    outfits = tuple(OUTFITS.values())
    dressed = index % _DRESSED_EVERY == 0
    return Figure(
        person(_FIRST_PERSON + index),
        drawn_pose(index),
        outfit=outfits[index // _DRESSED_EVERY % len(outfits)] if dressed else None,
    )


def drawn_pose(index: int) -> Pose:
    """Draw the posture of body number `index`: stances take turns, everything else is random."""
    draws = generator(0, 0, f"wide/{index:03d}", "posture")
    stance = [*STANCES.values()][index % len(STANCES)]
    trunk = Trunk(**within(stance.trunk, draws))
    if "roll" in stance.trunk:
        trunk = Trunk(**vars(trunk) | {"roll": float(np.copysign(90 + trunk.roll % 10 - 5, trunk.roll))})
    left, right = (within(stance.leg, draws) for _ in range(2))
    kinds = [*ARMS.values()]
    arms = [Arm(**within(kinds[int(draws.random() * len(kinds))] | _HAND, draws)) for _ in range(2)]
    return Pose(trunk, arms[0], arms[1], Leg(**left), Leg(**(left if stance.alike else right)))
