"""Places on a person's skin by name: where contacts are, and the points of limbs that make them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.anny.posable import Posable
from bodyseg_data.bodies.anny.skeleton import Arm, Leg, Pose, Trunk, bone_rotations
from bodyseg_data.bodies.contacts.surface import vertex_normals

Floats = NDArray[np.float64]
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
