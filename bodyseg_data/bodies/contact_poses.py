"""Everyday poses of one person: a stance, then each arm sent to a place, rejected where skin meets skin.

An arm goes to a place on the body, the other hand, the floor, the seat, the air before the body, or none.
"""

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from bodyseg_data.bodies.anny_model import Posable
from bodyseg_data.bodies.limb_reaching import (
    ALL_AXES,
    ARM,
    CROSSED_TWIST,
    GAP_M,
    LEG,
    LOADED_WRIST,
    Base,
    Goal,
    Limb,
    PosedSkin,
    Ranges,
    Reach,
    Side,
    chosen,
    deepest_m,
    mostly_middle,
    one_of,
    other,
    uniform,
    within,
)
from bodyseg_data.bodies.skeleton import Arm, Floats, Leg, Pose, Trunk, bone_rotations
from bodyseg_data.bodies.stances import CANDIDATE_STANCES, LegTask, Places, Stance
from bodyseg_data.meshes import vertex_normals

_UP: Final = np.array([0.0, 1.0, 0.0])
_AROUND: Final = np.array([0.3, 1.0, 0.3])  # the height matters, the place not much
_JITTER_DEG: Final = 12.0

_KINDS: Final = {"touch": 0.73, "other hand": 0.06, "air": 0.16, "free": 0.05}

_SEAT: Final = 0.08  # chance of a hand on the seat where there is one

# Places that a hand or forearm touches: of the trunk and head or of the same side, and of the other side.
_NEAR: Final = {
    "face": 1.3, "crown": 0.5, "back of the head": 0.6, "neck": 0.6, "chest": 1.3, "belly": 1.2, "lower back": 0.9,
    "upper back": 0.2,
    "side of the head": 0.6, "shoulder": 0.2, "waist": 0.6, "hip": 0.9, "buttock": 0.5, "thigh": 0.9,
    "inner thigh": 0.2, "back of the thigh": 0.2, "knee": 0.6, "shin": 0.5, "calf": 0.3, "instep": 0.4, "sole": 0.2,
}  # fmt: skip
_ACROSS: Final = {
    "side of the head": 0.3, "shoulder": 0.8, "waist": 0.5, "hip": 0.4, "upper arm": 0.9, "elbow": 0.5, "forearm": 0.9,
    "thigh": 0.4, "knee": 0.4, "shin": 0.3, "instep": 0.2, "sole": 0.1,
}  # fmt: skip

_BY: Final = {
    "palm": 0.36, "fingertips": 0.22, "back of the hand": 0.09, "knuckles": 0.07, "inner forearm": 0.2, "elbow": 0.06,
}  # fmt: skip
_BY_CROSSED: Final = {"palm": 0.4, "fingertips": 0.2, "inner forearm": 0.4}
_FOLDED: Final = {"chest": 0.4, "belly": 0.3, "waist": 0.15, "shoulder": 0.15}
_CROSSED: Final = {"upper arm": 0.4, "elbow": 0.2, "forearm": 0.25, "shoulder": 0.15}
"""`_FOLDED` and this: the places that the first and the second of two crossed arms touch, with their weights."""

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

DEEPEST_M: Final = 0.012
"""Depth of skin in skin beyond which a pose is rejected."""

_MISS_M: Final = 0.02  # largest distance of a foot or hand from its place
_PRESSED_M: Final = 0.01  # by which flesh gives way on the floor
_BELOW_M: Final = 0.015  # below the floor, beyond which a pose is rejected
_ATTEMPTS: Final = 40
_ARM_TRIES: Final = 8
_SAME_KIND: Final = 4  # tries, before an arm is given another kind of task
_ALIKE: Final = 0.4  # chance that both arms, or legs with one task, have the same angles where they can
_CENTRE: Final = 0.8  # the point this far from pelvis to chest is above the feet of who keeps his balance
_STRETCHED: Final = 0.985  # largest distance from hip to sole, as a share of a leg's length
_KNEE_M: Final = 0.03  # from a knee's centre to the floor under it
_PAIRS: Final = 10
_SHOULDER_M: Final = 0.05  # by which shoulder and hip may be below the floor that the trunk lies on


@dataclass(frozen=True)
class ArmSurroundings:
    """The posed body as an arm meets it. vertices, normals: [V, 3]. pelvis, shoulder, chest: [3], metres. chest_turn:
    [3, 3]. floor: height, metres. seat: one is at the height of the pelvis. other_placed: the other arm is in place.
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
    presets: tuple[Arm, ...] = tuple(_PRESETS.values())
    ranges: Ranges = field(default_factory=lambda: ARM)

    def begun(self, preset: Arm, draws: np.random.Generator) -> Arm:
        """Return a preset with drawn differences and this task's hand."""
        angles = {
            name: float(np.clip(getattr(preset, name) + uniform(draws, -_JITTER_DEG, _JITTER_DEG), *self.ranges[name]))
            for name in self.ranges
        }
        return replace(preset, **angles, fist=self.fist)


def drawn_kind(body: ArmSurroundings, stance: Stance, draws: np.random.Generator) -> str:
    """Draw what kind of task an arm has."""
    if stance.arms:
        return stance.arms
    if draws.random() < stance.floor_hands:
        return "floor"
    if body.seat and draws.random() < _SEAT:
        return "seat"
    kind = chosen(_KINDS, draws)
    return "touch" if kind == "other hand" and not body.other_placed else kind


def drawn_task(kind: str, body: ArmSurroundings, draws: np.random.Generator) -> ArmTask:
    if kind == "other hand":
        by = "palm" if draws.random() < 0.7 else "fingertips"
        on = "palm" if draws.random() < 0.5 else "back of the hand"
        return _touching(body, by, on, other(body.side), draws)
    if kind == "free":
        relaxed = Arm(**within(_RELAXED, draws))
        return ArmTask("free", [], uniform(draws, 0, 0.6), (relaxed,))
    if kind == "across":
        by, on = (chosen(weights, draws) for weights in (_BY_CROSSED, _CROSSED if body.other_placed else _FOLDED))
        return _touching(body, by, on, other(body.side), draws)
    if kind == "raised":
        return _in_the_air(body, draws, (0.25, 0.7), (-0.15, 0.45))
    return {"floor": _on_floor, "seat": _on_seat, "air": _in_the_air, "touch": _on_body}[kind](body, draws)


def _on_body(body: ArmSurroundings, draws: np.random.Generator) -> ArmTask:
    weights = {(name, body.side): weight for name, weight in _NEAR.items()}
    arm = ("upper arm", "elbow", "forearm")
    weights |= {
        (name, other(body.side)): weight for name, weight in _ACROSS.items() if body.other_placed or name not in arm
    }
    name, side = chosen(weights, draws)
    return _touching(body, chosen(_BY, draws), name, side, draws)


def _touching(body: ArmSurroundings, by: str, name: str, side: str, draws: np.random.Generator) -> ArmTask:
    own, on = body.places.on(by, body.side), body.places.on(name, side)
    at = one_of(on, draws)
    vertex = one_of(own, draws)
    goal = Goal(vertex, body.vertices[at] + GAP_M * body.normals[at], ALL_AXES, -body.normals[at])
    fist = uniform(draws, *_FISTS.get(by, (0.0, 1.0)))
    return ArmTask(f"{by} on {name}", [goal], fist)


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
    return ArmTask(f"{by} on the floor", [goal], fist, ranges=ranges)


def _on_seat(body: ArmSurroundings, draws: np.random.Generator) -> ArmTask:
    sign = 1 if body.side == "L" else -1
    place = body.pelvis + np.array([sign * uniform(draws, 0.2, 0.34), -0.1, uniform(draws, -0.25, 0.15)])
    own = body.places.on("palm", body.side)
    goal = Goal(one_of(own, draws), place, _AROUND, -_UP)
    return ArmTask("palm on the seat", [goal], uniform(draws, 0, 0.4), ranges=ARM | {"wrist": LOADED_WRIST})


def _in_the_air(
    body: ArmSurroundings,
    draws: np.random.Generator,
    up: tuple[float, float] = (-0.3, 0.6),
    ahead: tuple[float, float] = (0.08, 0.6),
) -> ArmTask:
    sign = 1 if body.side == "L" else -1
    reach = [sign * uniform(draws, -0.25, 0.55), uniform(draws, *up), uniform(draws, *ahead)]
    own = body.places.on("palm", body.side)
    goal = Goal(int(own[len(own) // 2]), body.chest + body.chest_turn @ reach, ALL_AXES)
    return ArmTask("in the air", [goal], uniform(draws, 0, 1))


@dataclass(frozen=True)
class DrawnContact:
    """Result of a search for a pose. contacts: of each arm, left first. attempts: poses drawn. deepest_m: in skin."""

    pose: Pose
    contacts: tuple[str, str]
    attempts: int
    deepest_m: float


class ContactSampler:
    """Poses of one person."""

    def __init__(self, person: Posable, places: Places) -> None:
        """places: found on any person, since all have the same vertices."""
        self._person, self._places = person, places
        self._normals = vertex_normals(person.modelled, person.faces)
        self._legs: dict[Side, Limb] = {"L": Limb(person, "leg", "L"), "R": Limb(person, "leg", "R")}
        self._arms: dict[Side, Limb] = {"L": Limb(person, "arm", "L"), "R": Limb(person, "arm", "R")}
        self._limbs = [*self._legs.values(), *self._arms.values()]
        self._far = np.any([limb.far for limb in self._limbs], axis=0)
        self._trunk = self._places.solid & ~np.any([limb.vertices for limb in self._limbs], axis=0)
        lifted = np.any(
            [*(leg.far for leg in self._legs.values()), *(arm.vertices for arm in self._arms.values())], axis=0
        )
        self._resting = self._places.solid & ~lifted
        turns, heads = person.placed(bone_rotations(Pose()))
        self._leg_m = float(heads[0, 1] - person.vertices(turns, heads)[self._places.solid, 1].min())

    def draw(self, stance: str, draws: np.random.Generator) -> DrawnContact:
        """Draw a pose. Of many rejected ones, in the end, the one with the least depth is returned."""
        best: DrawnContact | None = None
        for attempt in range(1, _ATTEMPTS + 1):
            found = self._attempt(CANDIDATE_STANCES[stance], draws)
            if found is None:
                continue
            pose, contacts, deepest = found
            if best is None or deepest < best.deepest_m:
                best = DrawnContact(pose, contacts, attempt, deepest)
            if deepest <= DEEPEST_M:
                break
        return best or DrawnContact(Pose(), ("hanging", "hanging"), _ATTEMPTS, 0.0)

    def _attempt(self, stance: Stance, draws: np.random.Generator) -> tuple[Pose, tuple[str, str], float] | None:
        legs = self._with_legs(stance, draws)
        if legs is None:
            return None
        pose, floor = legs
        contacts: dict[Side, str] = {}
        first: Side = "L" if draws.random() < 0.5 else "R"
        for side in (first, other(first)):
            placed = self._with_arm(pose, side, stance, floor, contacts.get(first), draws)
            if placed is None:
                return None
            pose, contacts[side] = placed
        vertices, normals = self._posed(pose)
        if (
            vertices[self._far, 1].min() < floor - _BELOW_M
            or vertices[self._places.solid, 1].min() < floor - _SHOULDER_M
        ):
            return None
        return pose, (contacts["L"], contacts["R"]), deepest_m(vertices, normals, self._limbs, self._places.solid)

    def _with_legs(self, stance: Stance, draws: np.random.Generator) -> tuple[Pose, float] | None:
        """Return a pose with hanging arms and the floor's height, or None if a leg does not reach."""
        trunk = Trunk(**mostly_middle(stance.trunk, draws))
        first: Side = "L" if draws.random() < 0.5 else "R"
        if trunk.roll:  # the leg on top lies on the other
            first = "R" if trunk.roll > 0 else "L"
        pair = stance.legs[int(draws.random() * len(stance.legs))]
        tasks: dict[Side, LegTask] = {first: pair[0], other(first): pair[1]}
        starts = {side: Leg(**within(task.start, draws)) for side, task in tasks.items()}
        alike = pair[0] is pair[1] and draws.random() < _ALIKE
        if alike:
            starts[other(first)] = starts[first]
        pose = Pose(trunk, Arm(), Arm(), starts["L"], starts["R"])
        turns, heads = self._person.placed(bone_rotations(pose))
        vertices = self._person.vertices(turns, heads)
        shifts = {
            side: None if task.out is None else (uniform(draws, *task.out), uniform(draws, *task.ahead))
            for side, task in tasks.items()
        }
        if alike:
            shifts[other(first)] = shifts[first]
        feet = {side: self._foot(shift, side, stance, heads) for side, shift in shifts.items()}
        if stance.pelvis is None:
            floor = float(vertices[self._resting, 1].min()) + _PRESSED_M
        else:
            floor = float(heads[0, 1]) - uniform(draws, *stance.pelvis) * self._leg_m
            floor = max([floor, *(self._lowest(heads, side, tasks[side], feet[side]) for side in feet)])
        done = self._trunk.copy()
        for side in (other(first), first):  # the first one may touch the other
            limb, task, at = self._legs[side], tasks[side], feet[side]
            vertices, normals = self._posed(pose)
            base = Base(turns[limb.base_bone], heads[limb.base_bone], turns[0])
            goals = []
            if at is not None:
                sole = self._places.on("sole", side)
                goals.append(Goal(int(sole[len(sole) // 2]), np.array([at[0], floor, at[1]]), ALL_AXES))
            if task.by:
                goals.append(self._touch(task, side, limb.bones(starts[side], base), vertices, normals, draws))
            ranges = {name: LEG[name] for name in ("flex", "abduct", "twist", "knee")}
            if "planted" in task.start:
                ranges["ankle"] = LEG["ankle"]
            if task.start.get("twist", (0, 0))[1] > LEG["twist"][1]:
                ranges["twist"] = CROSSED_TWIST
            resting = [self._places.on(name, side) for name in task.floor]
            reach = Reach(limb, base, self._normals, goals, PosedSkin(vertices, normals, done), floor, resting)
            reached = reach(starts[side], ranges)
            if reached.miss_m > _MISS_M or reach.depth_m(reached.angles) > DEEPEST_M:
                return None
            pose = _with(pose, side, reached.angles)
            done |= limb.vertices
        return pose, floor

    def _foot(
        self, shift: tuple[float, float] | None, side: Side, stance: Stance, heads: Floats
    ) -> tuple[float, float] | None:
        """Return x and z of a sole that is flat on the floor, metres, or None if this one is not.

        shift: outwards of the hip and in front of it, metres.
        """
        if shift is None:
            return None
        hip, chest = heads[self._person.numbers[f"upperleg01.{side}"]], heads[self._person.numbers["spine02"]]
        under = _CENTRE * (chest - heads[0]) if stance.balanced else np.zeros(3)
        out = shift[0] if side == "L" else -shift[0]
        return float(hip[0] + under[0] + out), float(hip[2] + under[2] + shift[1])

    def _lowest(self, heads: Floats, side: Side, task: LegTask, at: tuple[float, float] | None) -> float:
        """Return the height of the lowest floor that a leg's sole or knee reaches, -inf for a leg in the air."""
        person, hip = self._person, self._person.numbers[f"upperleg01.{side}"]
        if at is not None:
            length = self._leg_m - float(person.heads[0, 1] - person.heads[hip, 1])
            across = float(np.hypot(heads[hip, 0] - at[0], heads[hip, 2] - at[1]))
            return float(heads[hip, 1] - np.sqrt(max((_STRETCHED * length) ** 2 - across**2, 0)))
        if "knee" in task.floor:
            thigh = float(np.linalg.norm(person.heads[person.numbers[f"lowerleg01.{side}"]] - person.heads[hip]))
            return float(heads[hip, 1]) - thigh - _KNEE_M
        return -np.inf

    def _touch(
        self,
        task: LegTask,
        side: Side,
        bones: tuple[Floats, Floats],
        vertices: Floats,
        normals: Floats,
        draws: np.random.Generator,
    ) -> Goal:
        """Return the nearest of a few drawn pairs of a point of this leg and a point of the other one."""
        own = self._places.on(task.by, side)
        on = self._places.on(task.touch[int(draws.random() * len(task.touch))], other(side))
        mine = np.array([one_of(own, draws) for _ in range(_PAIRS)])
        theirs = np.array([one_of(on, draws) for _ in range(_PAIRS)])
        here = self._legs[side].points(mine, self._normals[mine]).moved(*bones)
        best = int(np.linalg.norm(here - vertices[theirs], axis=1).argmin())
        at = theirs[best]
        return Goal(int(mine[best]), vertices[at] + GAP_M * normals[at], ALL_AXES, -normals[at])

    def _with_arm(
        self, pose: Pose, side: Side, stance: Stance, floor: float, other_task: str | None, draws: np.random.Generator
    ) -> tuple[Pose, str] | None:
        """Return the pose with one arm sent to a place, and the place; None if none of eight can be reached.

        other_task: what the other arm does, None if it is not in its place yet.
        """
        limb, opposite = self._arms[side], self._arms[other(side)]
        turns, heads = self._person.placed(bone_rotations(pose))
        vertices = self._person.vertices(turns, heads)
        normals = vertex_normals(vertices, self._person.faces)
        solid = self._places.solid & ~limb.vertices
        if other_task is None:
            solid &= ~opposite.vertices
        obstacles = PosedSkin(vertices, normals, solid)
        base = Base(turns[limb.base_bone], heads[limb.base_bone], turns[0])
        chest = self._person.numbers["spine02"]
        body = ArmSurroundings(
            side=side,
            places=self._places,
            vertices=vertices,
            normals=normals,
            pelvis=heads[0],
            shoulder=heads[self._person.numbers[f"upperarm01.{side}"]],
            chest=heads[chest],
            chest_turn=turns[chest],
            floor=floor,
            seat=stance.seat,
            other_placed=other_task is not None,
        )
        if other_task is not None and stance.arms != "across" and draws.random() < _ALIKE:
            same = pose.right_arm if side == "L" else pose.left_arm  # angles are those of a left arm for both
            reach = Reach(limb, base, self._normals, [], obstacles, floor)
            reached = reach(same, ARM | {"wrist": LOADED_WRIST})
            if reach.depth_m(reached.angles) <= DEEPEST_M:
                return _with(pose, side, reached.angles), other_task
        kind = ""
        for index in range(_ARM_TRIES):
            if index % _SAME_KIND == 0:
                kind = drawn_kind(body, stance, draws)
            task = drawn_task(kind, body, draws)
            reach = Reach(limb, base, self._normals, task.goals, obstacles, floor)
            start = min((task.begun(preset, draws) for preset in task.presets), key=reach.miss_m)
            reached = reach(start, task.ranges)
            if reached.miss_m <= _MISS_M and reach.depth_m(reached.angles) <= DEEPEST_M:
                return _with(pose, side, reached.angles), task.name
        return None

    def _posed(self, pose: Pose) -> tuple[Floats, Floats]:
        vertices = self._person.vertices(*self._person.placed(bone_rotations(pose)))
        return vertices, vertex_normals(vertices, self._person.faces)


def _with(pose: Pose, side: Side, angles: Arm | Leg) -> Pose:
    if isinstance(angles, Arm):
        return replace(pose, left_arm=angles) if side == "L" else replace(pose, right_arm=angles)
    return replace(pose, left_leg=angles) if side == "L" else replace(pose, right_leg=angles)
