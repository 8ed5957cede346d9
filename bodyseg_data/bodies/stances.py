"""Stances: ranges of the trunk, what each leg does, and the places on a person's skin that contacts name."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.anny_model import Posable
from bodyseg_data.bodies.limb_reaching import Ranges
from bodyseg_data.bodies.skeleton import Arm, Floats, Leg, Pose, Trunk, bone_rotations
from bodyseg_data.meshes import vertex_normals

Vertices = NDArray[np.int64]

_UPRIGHT: Final = Pose(
    Trunk(), Arm(abduct=0, elbow=0), Arm(abduct=0, elbow=0), Leg(abduct=0, twist=0), Leg(abduct=0, twist=0)
)
_OUTERMOST_M: Final = 0.012  # from the head's convex hull: leaves out the mouth and what is behind the eyes
_JOINT_M: Final = 0.06  # around a joint's centre: knee, elbow

_TRUNK: Final = ("spine01", "spine02", "spine03")
_WAIST: Final = ("spine04", "spine05")


class Places:
    """Vertices of each place. `on(name, side)` finds them; places of the trunk and head are the same for both sides.

    solid: bool [V], skin that can be gone into, which leaves out eyes and mouth.
    """

    def __init__(self, person: Posable) -> None:
        turns, heads = person.placed(bone_rotations(_UPRIGHT))
        self._at = person.vertices(turns, heads)
        self._looks = vertex_normals(self._at, person.faces)
        self._names = np.array([person.bones[bone] for bone in person.owner])
        used = np.zeros(len(self._at), bool)
        used[person.faces] = True
        hull = self._outer(used & np.isin(self._names, ("head", "neck03")))
        self.solid: NDArray[np.bool_] = used & (~np.isin(self._names, ("head", "eye.L", "eye.R")) | hull)
        self._places: dict[str, Vertices] = {}
        x, y, z = self._looks.T
        self._add("face", ("head",), z > 0.4)
        self._add("crown", ("head",), y > 0.6)
        self._add("back of the head", ("head",), z < -0.5)
        self._add("neck", ("neck01", "neck02", "neck03"))
        self._add("chest", _TRUNK, z > 0.4)
        self._add("upper back", _TRUNK, z < -0.5)
        self._add("belly", _WAIST, z > 0.4)
        self._add("lower back", (*_WAIST, "root"), z < -0.6)
        for side, sign in (("L", 1), ("R", -1)):
            self._side(person, heads, side, sign * x)

    def _side(self, person: Posable, heads: Floats, side: str, out: Floats) -> None:
        """Add the places of one side. out: [V], by how much the skin looks away from the body's middle."""
        _, y, z = self._looks.T
        pelvis = ("root", f"pelvis.{side}", f"upperleg01.{side}")
        own = self._at[:, 0] * (1 if side == "L" else -1) > 0.02
        thigh, shin = (tuple(f"{bone}{number}.{side}" for number in (1, 2)) for bone in ("upperleg0", "lowerleg0"))
        forearm = (f"lowerarm01.{side}", f"lowerarm02.{side}")
        palm = (f"wrist.{side}", *(f"metacarpal{finger}.{side}" for finger in range(2, 6)))
        below = self._at[:, 1] < heads[person.numbers[f"upperleg01.{side}"], 1] - 0.1
        for name, bones, fits in (
            ("side of the head", ("head",), out > 0.6),
            ("shoulder", (f"clavicle.{side}", f"shoulder01.{side}", f"upperarm01.{side}"), (y > 0) | (z > 0.3)),
            ("waist", ("spine03", *_WAIST), out > 0.6),
            ("hip", pelvis, (out > 0.6) & own),
            ("buttock", pelvis, (z < -0.6) & own),
            ("thigh", thigh, ((z > 0.2) | (out > 0.5)) & below),
            ("inner thigh", thigh, (out < -0.5) & below),
            ("back of the thigh", thigh, (z < -0.5) & below),
            ("knee", (f"upperleg02.{side}", *shin), (z > 0.4) & self._near(heads, person, f"lowerleg01.{side}")),
            ("shin", shin, z > 0.2),
            ("inner shin", shin, out < -0.5),
            ("calf", shin, z < -0.4),
            ("instep", (f"foot.{side}",), y > 0.4),
            ("foot", (f"foot.{side}", *(f"toe{toe}-{part}.{side}" for toe in range(1, 6) for part in (1, 2, 3))), True),
            ("sole", (f"foot.{side}",), y < -0.8),
            ("outer ankle", (f"foot.{side}", shin[1]), (out > 0.5) & self._near(heads, person, f"foot.{side}")),
            ("upper arm", (f"upperarm01.{side}", f"upperarm02.{side}"), (out > 0.2) | (z > 0.4)),
            ("elbow", (f"upperarm02.{side}", *forearm), (z < -0.3) & self._near(heads, person, f"lowerarm01.{side}")),
            ("forearm", forearm, np.ones(len(z), bool)),
            ("inner forearm", forearm, (out < -0.3) | (z > 0.5)),
            ("palm", palm, out < -0.6),
            ("back of the hand", palm, out > 0.6),
            ("fingertips", tuple(f"finger{finger}-3.{side}" for finger in (2, 3, 4)), out < -0.3),
            ("knuckles", tuple(f"finger{finger}-1.{side}" for finger in (2, 3, 4, 5)), out > 0.6),
        ):
            self._add(f"{name}.{side}", bones, fits)

    def on(self, name: str, side: str = "") -> Vertices:
        """Return the vertices of a place, int [N]. side: "L" or "R", for a place that each side has."""
        return self._places[name] if name in self._places else self._places[f"{name}.{side}"]

    def _add(self, name: str, bones: Iterable[str], fits: NDArray[np.bool_] | bool = True) -> None:
        self._places[name] = np.flatnonzero(np.isin(self._names, tuple(bones)) & fits & self.solid)

    def _near(self, heads: Floats, person: Posable, bone: str) -> NDArray[np.bool_]:
        distance = np.linalg.norm(self._at - heads[person.numbers[bone]], axis=1)
        return np.asarray(distance < _JOINT_M, np.bool_)

    def _outer(self, of: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return bool [V]: vertices of a part that are near its convex hull."""
        from scipy.spatial import ConvexHull

        numbers = np.flatnonzero(of)
        planes = ConvexHull(self._at[numbers]).equations
        depth = (self._at[numbers] @ planes[:, :3].T + planes[:, 3]).max(axis=1)
        outer = np.zeros_like(of)
        outer[numbers[depth > -_OUTERMOST_M]] = True
        return outer


@dataclass(frozen=True)
class LegTask:
    """Task of one leg. start: ranges of the angles that the search begins at and keeps where it can. out, ahead: ranges
    of the position of a sole flat on the floor, metres outwards of the hip and in front of it; None for a foot that is
    not. floor: places of the leg that touch the floor. by, touch: a place of the leg, and those of the other of which
    it touches one.
    """

    start: Ranges
    out: tuple[float, float] | None = None
    ahead: tuple[float, float] = (0, 0)
    floor: tuple[str, ...] = ()
    by: str = ""
    touch: tuple[str, ...] = ()


@dataclass(frozen=True)
class Stance:
    """Ranges of the trunk, degrees, and pairs of tasks for the legs, of which one is drawn; either leg takes the first.

    pelvis: height of the pelvis above the floor, as a share of that in upright standing; None for people whose trunk
    lies or sits on the floor. balanced: feet are placed below the trunk's centre. floor_hands: chance of an arm to be
    put on the floor. seat: there is a seat, on which hands can be put. arms: kind of the arms' tasks; "" for any.
    """

    trunk: Ranges
    legs: tuple[tuple[LegTask, LegTask], ...]
    pelvis: tuple[float, float] | None = None
    balanced: bool = True
    floor_hands: float = 0
    seat: bool = False
    arms: str = ""


_HEAD: Final[Ranges] = {"nod": (-25, 32), "tilt": (-18, 18), "look": (-45, 45)}
_UPRIGHT_TRUNK: Final[Ranges] = {"lean": (-6, 10), "bend": (-10, 22), "side": (-14, 14), "twist": (-28, 28)} | _HEAD
_FREE: Final = {"planted": (0.0, 0.0)}
_ANY_WAY: Final = {"turn": (-180.0, 180.0)}

_STRAIGHT: Final[Ranges] = {"flex": (-6, 14), "abduct": (-2, 10), "twist": (0, 20), "knee": (0, 14)}
_BENT: Final[Ranges] = {"flex": (30, 100), "abduct": (0, 20), "twist": (0, 25), "knee": (40, 115)}
_STANDING: Final = LegTask(_STRAIGHT, out=(-0.05, 0.14), ahead=(-0.1, 0.1))
_UNDER: Final = LegTask(_STRAIGHT, out=(-0.1, -0.05), ahead=(-0.02, 0.02))
_CROSSED: Final = LegTask(_STRAIGHT | {"abduct": (-18, -10)}, out=(-0.24, -0.16), ahead=(0.06, 0.16))
_STEP_AHEAD: Final = LegTask(
    {"flex": (15, 60), "twist": (0, 15), "knee": (5, 70)}, out=(-0.06, 0.1), ahead=(0.12, 0.42)
)
_STEP_BACK: Final = LegTask(
    {"flex": (-15, 10), "twist": (0, 25), "knee": (10, 50)}, out=(-0.06, 0.1), ahead=(-0.3, -0.05)
)
_CROUCHED: Final = LegTask(_BENT, out=(-0.02, 0.16), ahead=(-0.08, 0.14))

_RAISED_KNEE: Final = LegTask(
    {"flex": (40, 115), "abduct": (-8, 30), "twist": (-10, 35), "knee": (40, 128), "ankle": (-5, 35)} | _FREE
)
_KICK: Final = LegTask(
    {"flex": (25, 90), "abduct": (-8, 40), "twist": (-10, 25), "knee": (0, 40), "ankle": (0, 40)} | _FREE
)
_KICK_BACK: Final = LegTask(
    {"flex": (-24, 5), "abduct": (0, 25), "twist": (-5, 25), "knee": (0, 70), "ankle": (10, 45)} | _FREE
)
_SHIN_BACK: Final = LegTask(
    {"flex": (-20, 35), "abduct": (-6, 12), "twist": (-10, 12), "knee": (75, 134), "ankle": (10, 45)} | _FREE
)
_SOLE_ON_LEG: Final = LegTask(
    {"flex": (30, 70), "abduct": (15, 42), "twist": (20, 45), "knee": (80, 130), "ankle": (0, 35)} | _FREE,
    by="sole", touch=("inner shin", "inner thigh", "calf", "knee", "shin"),
)  # fmt: skip
_FOOT_HOOKED: Final = LegTask(
    {"flex": (5, 35), "abduct": (-15, 5), "twist": (0, 20), "knee": (20, 80), "ankle": (5, 40)} | _FREE,
    by="instep", touch=("calf",),
)  # fmt: skip

_SEATED: Final = LegTask(
    {"flex": (70, 100), "abduct": (0, 18), "twist": (-5, 20), "knee": (65, 105)}, out=(-0.06, 0.14), ahead=(0.22, 0.55)
)
_KNEE_OVER: Final = LegTask(
    {"flex": (85, 115), "abduct": (-22, -8), "twist": (-5, 25), "knee": (60, 100), "ankle": (5, 30)} | _FREE,
    by="calf", touch=("knee", "thigh", "shin"),
)  # fmt: skip
_ANKLE_ON_KNEE: Final = LegTask(
    {"flex": (80, 110), "abduct": (15, 40), "twist": (40, 72), "knee": (80, 120), "ankle": (0, 25)} | _FREE,
    by="outer ankle", touch=("knee", "thigh"),
)  # fmt: skip
_FEET_CROSSED: Final = LegTask(
    {"flex": (65, 95), "abduct": (-12, 0), "twist": (0, 25), "knee": (20, 60), "ankle": (5, 30)} | _FREE,
    by="calf", touch=("shin", "instep"),
)  # fmt: skip

_STRETCHED: Final = LegTask(
    {"flex": (60, 95), "abduct": (-2, 30), "twist": (0, 35), "knee": (0, 25), "ankle": (0, 30)} | _FREE, floor=("foot",)
)
_KNEE_UP: Final = LegTask(
    {"flex": (85, 128), "abduct": (-4, 20), "twist": (-5, 20), "knee": (70, 132), "ankle": (0, 40)} | _FREE,
    floor=("foot",),
)
_FOLDED: Final = LegTask(
    {"flex": (65, 100), "abduct": (22, 44), "twist": (40, 74), "knee": (85, 132), "ankle": (10, 40)} | _FREE,
    floor=("foot",),
)
_SOLE_ON_THIGH: Final = LegTask(
    {"flex": (65, 100), "abduct": (20, 42), "twist": (35, 70), "knee": (95, 132), "ankle": (10, 35)} | _FREE,
    by="sole", touch=("inner thigh", "inner shin"),
)  # fmt: skip

_KNEELING: Final = LegTask(
    {"flex": (-5, 60), "abduct": (-2, 16), "twist": (-8, 8), "knee": (80, 134), "ankle": (25, 46)} | _FREE,
    floor=("knee", "foot"),
)
_HALF: Final = LegTask(
    {"flex": (70, 110), "abduct": (0, 15), "twist": (0, 15), "knee": (75, 110)}, out=(-0.04, 0.14), ahead=(0.2, 0.45)
)

_LYING_FLAT: Final = LegTask(
    {"flex": (-2, 8), "abduct": (-2, 22), "twist": (0, 38), "knee": (0, 12), "ankle": (10, 42)} | _FREE
)
_LYING_UP: Final = LegTask(
    {"flex": (30, 75), "abduct": (-5, 20), "twist": (-10, 25), "knee": (60, 125), "ankle": (5, 45)} | _FREE,
    floor=("foot",),
)
_TO_CHEST: Final = LegTask(
    {"flex": (85, 125), "abduct": (-5, 20), "twist": (-5, 20), "knee": (60, 130), "ankle": (0, 40)} | _FREE
)
_LEG_UP: Final = LegTask(
    {"flex": (50, 100), "abduct": (-5, 20), "twist": (-5, 20), "knee": (0, 45), "ankle": (0, 40)} | _FREE
)
_OVER: Final = LegTask(
    {"flex": (40, 80), "abduct": (-20, 20), "twist": (0, 45), "knee": (50, 110), "ankle": (0, 30)} | _FREE,
    by="outer ankle", touch=("knee", "shin", "thigh"),
)  # fmt: skip
_PRONE: Final = LegTask(
    {"flex": (-15, 5), "abduct": (-2, 20), "twist": (-10, 25), "knee": (0, 15), "ankle": (25, 47)} | _FREE
)
_PRONE_BENT: Final = LegTask(
    {"flex": (-10, 5), "abduct": (-2, 18), "twist": (-10, 15), "knee": (40, 125), "ankle": (0, 45)} | _FREE
)
_PRONE_OUT: Final = LegTask(
    {"flex": (25, 80), "abduct": (28, 45), "twist": (20, 45), "knee": (30, 110), "ankle": (10, 45)} | _FREE
)
_SIDE_LEG: Final = LegTask(
    {"flex": (5, 95), "abduct": (-10, 12), "twist": (-8, 12), "knee": (10, 120), "ankle": (5, 40)} | _FREE
)
_SIDE_OVER: Final = LegTask(
    {"flex": (5, 100), "abduct": (-12, 12), "twist": (-8, 20), "knee": (10, 115), "ankle": (5, 40)} | _FREE,
    by="inner shin", touch=("shin", "calf", "knee", "inner shin"),
)  # fmt: skip

_LIES: Final = {"bend": (-6.0, 22.0), "side": (-14.0, 14.0), "twist": (-14.0, 14.0)} | _HEAD | _ANY_WAY

STANCES: Final[dict[str, Stance]] = {
    "standing": Stance(_UPRIGHT_TRUNK, ((_STANDING, _STANDING), (_CROSSED, _UNDER)), (0.97, 0.995)),
    "stepping": Stance(
        _UPRIGHT_TRUNK | {"lean": (-4, 22)}, ((_STEP_AHEAD, _STEP_BACK), (_STEP_AHEAD, _STANDING)), (0.72, 0.96)
    ),
    "on_one_leg": Stance(
        _UPRIGHT_TRUNK | {"lean": (-12, 25)},
        (
            (_RAISED_KNEE, _UNDER), (_KICK, _UNDER), (_KICK_BACK, _UNDER), (_SHIN_BACK, _UNDER), (_SOLE_ON_LEG, _UNDER),
            (_SOLE_ON_LEG, _UNDER), (_FOOT_HOOKED, _UNDER),
        ),
        (0.96, 0.995),
    ),
    "bending": Stance(
        {"lean": (20, 80), "bend": (10, 62), "side": (-18, 18), "twist": (-32, 32)} | _HEAD | {"nod": (-35, 25)},
        ((_STANDING, _STANDING), (_STEP_AHEAD, _STANDING)), (0.78, 0.98), floor_hands=0.15,
    ),
    "crouching": Stance(
        {"lean": (10, 48), "bend": (5, 48), "side": (-12, 12), "twist": (-22, 22)} | _HEAD | {"nod": (-35, 20)},
        ((_CROUCHED, _CROUCHED), (_CROUCHED, _STEP_AHEAD)), (0.42, 0.76), floor_hands=0.12,
    ),
    "sitting_on_a_chair": Stance(
        {"lean": (-18, 32), "bend": (-2, 38), "side": (-14, 14), "twist": (-26, 26)} | _HEAD,
        (
            (_SEATED, _SEATED), (_SEATED, _SEATED), (_KNEE_OVER, _SEATED), (_KNEE_OVER, _SEATED),
            (_ANKLE_ON_KNEE, _SEATED), (_FEET_CROSSED, _SEATED),
        ),
        (0.5, 0.62), balanced=False, seat=True,
    ),
    "sitting_on_the_floor": Stance(
        {"lean": (-32, 2), "bend": (4, 44), "side": (-10, 10), "twist": (-24, 24)} | _HEAD | _ANY_WAY,
        (
            (_STRETCHED, _STRETCHED), (_KNEE_UP, _KNEE_UP), (_KNEE_UP, _STRETCHED), (_FOLDED, _STRETCHED),
            (_FOLDED, _FOLDED), (_SOLE_ON_THIGH, _STRETCHED), (_SOLE_ON_THIGH, _FOLDED), (_FOLDED, _KNEE_UP),
        ),
        balanced=False, floor_hands=0.22,
    ),
    "kneeling": Stance(
        {"lean": (-6, 32), "bend": (-4, 38), "side": (-12, 12), "twist": (-24, 24)} | _HEAD,
        ((_KNEELING, _KNEELING), (_HALF, _KNEELING)), (0.42, 0.58), balanced=False, floor_hands=0.08,
    ),
    "on_all_fours": Stance(
        {"lean": (74, 98), "bend": (-14, 26), "side": (-10, 10), "twist": (-15, 15)} | _HEAD | {"nod": (-42, 15)},
        ((_KNEELING, _KNEELING),), (0.44, 0.56), balanced=False, floor_hands=0.82,
    ),
    "lying_on_the_back": Stance(
        {"lean": (-94, -84)} | _LIES | {"nod": (-5, 30)},
        (
            (_LYING_FLAT, _LYING_FLAT), (_LYING_UP, _LYING_UP), (_LYING_UP, _LYING_FLAT), (_TO_CHEST, _LYING_FLAT),
            (_TO_CHEST, _TO_CHEST), (_LEG_UP, _LYING_UP), (_OVER, _LYING_UP), (_OVER, _LYING_FLAT),
        ),
        floor_hands=0.15, balanced=False,
    ),
    "lying_on_the_front": Stance(
        {"lean": (84, 95)} | _LIES | {"bend": (-26, 2), "look": (-58, 58), "nod": (-30, 5)},
        ((_PRONE, _PRONE), (_PRONE_BENT, _PRONE), (_PRONE_BENT, _PRONE_BENT), (_PRONE_OUT, _PRONE)),
        floor_hands=0.35, balanced=False,
    ),
    "lying_on_the_left": Stance(
        {"lean": (-6, 6), "roll": (82, 96)} | _LIES | {"bend": (0, 44), "tilt": (-24, 6)},
        ((_SIDE_OVER, _SIDE_LEG), (_SIDE_LEG, _SIDE_LEG)), floor_hands=0.15, balanced=False,
    ),
    "lying_on_the_right": Stance(
        {"lean": (-6, 6), "roll": (-96, -82)} | _LIES | {"bend": (0, 44), "tilt": (-6, 24)},
        ((_SIDE_OVER, _SIDE_LEG), (_SIDE_LEG, _SIDE_LEG)), floor_hands=0.15, balanced=False,
    ),
}  # fmt: skip
"""Stances by name, which take turns."""

CANDIDATE_STANCES: Final[dict[str, Stance]] = STANCES | {
    "arms_crossed": replace(STANCES["standing"], arms="across"),
    "sitting_with_crossed_arms": replace(STANCES["sitting_on_a_chair"], arms="across"),
    "lying_straight": replace(STANCES["lying_on_the_back"], legs=((_LYING_FLAT, _LYING_FLAT),)),
    "lying_with_crossed_arms": replace(STANCES["lying_on_the_back"], arms="across"),
    "lying_with_raised_arms": replace(STANCES["lying_on_the_front"], arms="raised"),
    "raised_knee_with_raised_arms": replace(
        STANCES["on_one_leg"], legs=((_RAISED_KNEE, _UNDER), (_KICK, _UNDER)), arms="raised"
    ),
}
"""Those of candidates for a training, among which the worst are looked for."""
