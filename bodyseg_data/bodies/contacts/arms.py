"""Tasks of an arm: a place on the body, the other hand, the floor, the seat, the air before the body, or none."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.anny.skeleton import Arm
from bodyseg_data.bodies.contacts.limbs import Side, other
from bodyseg_data.bodies.contacts.places import Places
from bodyseg_data.bodies.contacts.ranges import ARM, LOADED_WRIST, Ranges, chosen, one_of, uniform, within
from bodyseg_data.bodies.contacts.reaching import ALL_AXES, GAP_M, Goal

Floats = NDArray[np.float64]

_UP: Final = np.array([0.0, 1.0, 0.0])
_AROUND: Final = np.array([0.3, 1.0, 0.3])  # the height matters, the place not much
_JITTER_DEG: Final = 12.0

_KINDS: Final = {"touch": 0.73, "other hand": 0.06, "air": 0.16, "free": 0.05}

_SEAT: Final = 0.08  # chance of a hand on the seat where there is one

# Places that a hand or forearm touches: of the trunk and head, of the same side, of the other side.
_MIDDLE: Final = {
    "face": 1.3, "crown": 0.5, "back of the head": 0.6, "neck": 0.6, "chest": 1.3, "belly": 1.2, "lower back": 0.9,
    "upper back": 0.2,
}  # fmt: skip
_SAME: Final = {
    "side of the head": 0.6, "shoulder": 0.2, "waist": 0.6, "hip": 0.9, "buttock": 0.5, "thigh": 0.9,
    "inner thigh": 0.2, "back of the thigh": 0.2, "knee": 0.6, "shin": 0.5, "calf": 0.3, "instep": 0.4, "sole": 0.2,
}  # fmt: skip
_ACROSS: Final = {
    "side of the head": 0.3, "shoulder": 0.8, "waist": 0.5, "hip": 0.4, "upper arm": 0.9, "elbow": 0.5, "forearm": 0.9,
    "thigh": 0.4, "knee": 0.4, "shin": 0.3, "instep": 0.2, "sole": 0.1,
}  # fmt: skip

_BY: Final = {
    "palm": 0.36,
    "fingertips": 0.22,
    "back of the hand": 0.09,
    "knuckles": 0.07,
    "inner forearm": 0.2,
    "elbow": 0.06,
}
_FISTS: Final = {"palm": (0.0, 0.45), "fingertips": (0.0, 0.4), "back of the hand": (0.0, 1.0), "knuckles": (0.9, 1.0)}

_PRESETS: Final[dict[str, Arm]] = {
    "hanging": Arm(flex=5, abduct=12, elbow=20),
    "at the belly": Arm(flex=20, abduct=12, twist=-48, elbow=75),
    "before the chest": Arm(flex=45, abduct=6, twist=-50, elbow=100),
    "at the face": Arm(flex=55, abduct=12, twist=-15, elbow=132),
    "at the head": Arm(flex=25, abduct=100, twist=75, elbow=128),
    "on the hip": Arm(flex=-25, abduct=45, twist=-36, elbow=90),
    "behind the back": Arm(flex=-40, abduct=20, twist=-58, elbow=65),
    "forward": Arm(flex=85, abduct=10, elbow=30),
    "forward and down": Arm(flex=40, abduct=8, twist=-10, elbow=20),
    "backward": Arm(flex=-45, abduct=18, twist=5, elbow=10, wrist=-55),
    "overhead": Arm(flex=155, abduct=14, elbow=30),
    "to the side": Arm(flex=5, abduct=85, twist=20, elbow=25),
}
_RELAXED: Final[Ranges] = {
    "flex": (-20, 30), "abduct": (6, 24), "twist": (-25, 10), "elbow": (5, 50), "supinate": (-40, 20),
    "wrist": (-10, 15),
}  # fmt: skip


@dataclass(frozen=True)
class ArmSurroundings:
    """The posed body as an arm meets it. vertices, normals: [V, 3]. pelvis, shoulder, chest: [3], metres. chest_turn:
    [3, 3]. floor: height, metres. seat: there is one at the height of the pelvis. other_placed: the other arm is in its
    place.
    """

    side: Side
    places: Places
    vertices: Floats
    normals: Floats
    pelvis: Floats
    shoulder: Floats
    chest: Floats
    chest_turn: Floats
    floor: float
    seat: bool
    other_placed: bool


@dataclass(frozen=True)
class ArmTask:
    """Goal of an arm. fist: of the hand. presets: postures of which the nearest to the goals is the start."""

    name: str
    goals: list[Goal]
    fist: float
    presets: tuple[Arm, ...]
    ranges: Ranges

    def begun(self, preset: Arm, draws: np.random.Generator) -> Arm:
        """Return a preset with drawn differences and this task's hand."""
        angles = {
            name: float(np.clip(getattr(preset, name) + uniform(draws, -_JITTER_DEG, _JITTER_DEG), *self.ranges[name]))
            for name in self.ranges
        }
        return replace(preset, **angles, fist=self.fist)


def drawn_kind(body: ArmSurroundings, floor_hands: float, draws: np.random.Generator) -> str:
    """Draw what kind of task an arm has. floor_hands: chance of the floor."""
    if draws.random() < floor_hands:
        return "floor"
    if body.seat and draws.random() < _SEAT:
        return "seat"
    kind = chosen(_KINDS, draws)
    return "touch" if kind == "other hand" and not body.other_placed else kind


def drawn_task(kind: str, body: ArmSurroundings, draws: np.random.Generator) -> ArmTask:
    """Draw a task of a kind."""
    if kind == "other hand":
        by = "palm" if draws.random() < 0.7 else "fingertips"
        on = "palm" if draws.random() < 0.5 else "back of the hand"
        return _touching(body, by, on, other(body.side), draws)
    if kind == "free":
        relaxed = Arm(**within(_RELAXED, draws))
        return ArmTask("free", [], uniform(draws, 0, 0.6), (relaxed,), ARM)
    return {"floor": _on_floor, "seat": _on_seat, "air": _in_the_air, "touch": _on_body}[kind](body, draws)


def _on_body(body: ArmSurroundings, draws: np.random.Generator) -> ArmTask:
    weights = {(name, ""): weight for name, weight in _MIDDLE.items()}
    weights |= {(name, body.side): weight for name, weight in _SAME.items()}
    arm = ("upper arm", "elbow", "forearm")
    weights |= {
        (name, other(body.side)): weight for name, weight in _ACROSS.items() if body.other_placed or name not in arm
    }
    name, side = chosen({f"{name}/{side}": weight for (name, side), weight in weights.items()}, draws).split("/")
    return _touching(body, chosen(_BY, draws), name, side, draws)


def _touching(body: ArmSurroundings, by: str, name: str, side: str, draws: np.random.Generator) -> ArmTask:
    own, on = body.places.on(by, body.side), body.places.on(name, side)
    at = one_of(on, draws)
    vertex = one_of(own, draws)
    goal = Goal(vertex, body.vertices[at] + GAP_M * body.normals[at], ALL_AXES, -body.normals[at])
    fist = uniform(draws, *_FISTS.get(by, (0.0, 1.0)))
    return ArmTask(f"{by} on {name}", [goal], fist, tuple(_PRESETS.values()), ARM)


def _on_floor(body: ArmSurroundings, draws: np.random.Generator) -> ArmTask:
    place = body.shoulder + np.array([uniform(draws, -0.3, 0.3), 0, uniform(draws, -0.35, 0.35)])
    place[1] = body.floor + GAP_M
    ranges = ARM | {"wrist": LOADED_WRIST}
    if draws.random() < 0.75:
        by, fist = "palm", uniform(draws, 0, 0.15)
    else:
        by, fist = "inner forearm", uniform(draws, 0, 0.8)
    own = body.places.on(by, body.side)
    goal = Goal(one_of(own, draws), place, _AROUND, -_UP)
    return ArmTask(f"{by} on the floor", [goal], fist, tuple(_PRESETS.values()), ranges)


def _on_seat(body: ArmSurroundings, draws: np.random.Generator) -> ArmTask:
    sign = 1 if body.side == "L" else -1
    place = body.pelvis + np.array([sign * uniform(draws, 0.2, 0.34), -0.1, uniform(draws, -0.25, 0.15)])
    own = body.places.on("palm", body.side)
    goal = Goal(one_of(own, draws), place, _AROUND, -_UP)
    return ArmTask(
        "palm on the seat", [goal], uniform(draws, 0, 0.4), tuple(_PRESETS.values()), ARM | {"wrist": LOADED_WRIST}
    )


def _in_the_air(body: ArmSurroundings, draws: np.random.Generator) -> ArmTask:
    sign = 1 if body.side == "L" else -1
    reach = [sign * uniform(draws, -0.25, 0.55), uniform(draws, -0.3, 0.6), uniform(draws, 0.08, 0.6)]
    own = body.places.on("palm", body.side)
    goal = Goal(int(own[len(own) // 2]), body.chest + body.chest_turn @ reach, ALL_AXES)
    return ArmTask("in the air", [goal], uniform(draws, 0, 1), tuple(_PRESETS.values()), ARM)
