"""Things in a hand or on the back: bag, bottle, stick, box, backpack. They have a range and no label."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.anny.skeleton import Pose
from bodyseg_data.bodies.contacts.limbs import Side
from bodyseg_data.bodies.worn.shells import ringed
from bodyseg_data.bodies.worn.wearer import Wearer
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.meshes.solids import Solid, cuboid, turned_solid

Floats = NDArray[np.float64]
Kind = Literal["bag", "bottle", "stick", "box", "backpack"]

IN_HAND: Final[dict[Kind, float]] = {"bag": 0.35, "bottle": 0.25, "box": 0.25, "stick": 0.15}
"""Weights of the kinds that a hand holds."""


@dataclass(frozen=True)
class Held:
    """A thing that is held or worn. side: of the hand; a backpack has none to say. size: 0 smallest to 1 largest.

    Raises BadConfig for another kind or size.
    """

    kind: Kind
    side: Side = "L"
    size: float = 0.5

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind) or not 0 <= self.size <= 1:
            raise BadConfig(
                f"a held thing must be one of {', '.join(get_args(Kind))} with a size from 0 to 1, "
                f"found {self.kind!r}, {self.size!r}"
            )


_FISTS: Final[dict[Kind, float]] = {"bag": 0.8, "bottle": 0.6, "stick": 0.85, "box": 0.15}
_OVERLAP: Final = 12  # vertices of the rest of the body that may be inside a thing: cloth and flesh give way
_UP: Final = np.array([0.0, 1.0, 0.0])
_HOLLOW_M: Final = 0.012  # from a palm's skin to what its closed fingers hold
_STRAP_M: Final = 0.012
_ROUND: Final = 32
_HIGHEST_M: Final = 2.4  # of body and thing together: no mesh is larger


def held_thing(wearer: Wearer, held: Held) -> list[Solid]:
    """The closed surfaces of a thing in a hand or on the back; none where the floor or the body leaves no room."""
    if held.kind == "backpack":
        pieces, own = _backpack(wearer, held.size)
    else:
        hand = _Hand(wearer, held.side)
        pieces, own = _MAKERS[held.kind](hand, held.size), hand.near
    points = np.concatenate([piece.vertices for piece in pieces])
    both = np.concatenate([points, wearer.points[wearer.solid]])
    if points[:, 1].min() < wearer.floor or np.ptp(both, axis=0).max() > _HIGHEST_M:
        return []
    others = wearer.points[wearer.solid & ~own]
    return [] if sum(_inside(piece, others) for piece in pieces) > _OVERLAP else pieces


def gripping(pose: Pose, held: Held) -> Pose:
    """The pose with the hand closed that holds a thing."""
    if held.kind not in IN_HAND:
        return pose
    if held.side == "L":
        return replace(pose, left_arm=replace(pose.left_arm, fist=_FISTS[held.kind]))
    return replace(pose, right_arm=replace(pose.right_arm, fist=_FISTS[held.kind]))


class _Hand:
    """A hand in the pose. palm: [3], metres, in the palm's hollow. out: from the palm. across: from the index to the
    little finger. along: to the fingers. near: bool [V], hand and forearm, which may touch the thing.
    """

    def __init__(self, wearer: Wearer, side: Side) -> None:
        palm = wearer.places.on("palm", side)
        frame = wearer.frame(wearer.of("wrist", "metacarpal", side=side))
        root, index, little = (
            wearer.rest[wearer.of(name, side=side)].mean(axis=0) for name in ("wrist", "finger2-1", "finger5-1")
        )
        self.along: Floats = _unit(frame.turn @ ((index + little) / 2 - root))
        self.across: Floats = _level(frame.turn @ (little - index), self.along)
        out = np.cross(self.along, self.across)
        self.out: Floats = out * np.sign(out @ wearer.normals[palm].mean(axis=0))
        knuckles = frame((index + little) / 2)
        self.palm: Floats = (wearer.points[palm].mean(axis=0) + knuckles) / 2 + _HOLLOW_M * self.out
        self.near = wearer.of("lowerarm", "wrist", "metacarpal", "finger", side=side)

    def put(self, thing: Solid, up: Floats, at: Floats) -> Solid:
        """The thing with its y axis along `up` [3], its z axis away from the palm if it can, its origin at [3]."""
        y = _unit(up)
        z = _level(self.out if abs(self.out @ y) < 0.95 else self.along, y)
        return thing.placed(np.stack([np.cross(y, z), y, z]), at)


def _bottle(hand: _Hand, size: float) -> list[Solid]:
    radius, height = 0.028 + 0.016 * size, 0.18 + 0.14 * size
    shape = [(0.95, 0.0), (1.0, 0.03), (1.0, 0.62), (0.4, 0.8), (0.36, 0.99), (0.3, 1.0)]
    bottle = turned_solid([(radius * wide, height * (up - 0.42)) for wide, up in shape])
    return [hand.put(bottle, -hand.across, hand.palm + radius * hand.out)]


def _stick(hand: _Hand, size: float) -> list[Solid]:
    radius, length = 0.009 + 0.008 * size, 0.4 + 0.8 * size
    stick = turned_solid([(radius, -0.3 * length), (radius, 0.7 * length)])
    return [hand.put(stick, -hand.across, hand.palm + radius * hand.out)]


def _box(hand: _Hand, size: float) -> list[Solid]:
    wide, high, deep = 0.14 + 0.3 * size, 0.1 + 0.22 * size, 0.1 + 0.2 * size
    return [hand.put(cuboid((wide, high, deep), (0, 0, deep / 2)), _UP, hand.palm - _HOLLOW_M * hand.out)]


def _bag(hand: _Hand, size: float) -> list[Solid]:
    wide, high, deep = 0.22 + 0.22 * size, 0.2 + 0.24 * size, 0.07 + 0.1 * size
    drop = 0.1 + 0.16 * size
    along = _level(hand.across if abs(hand.across[1]) < 0.9 else hand.along, _UP)
    axes = np.stack([along, _UP, np.cross(along, _UP)])
    body = padded((wide, high, deep)).moved((0, -drop - high / 2, 0)).placed(axes, hand.palm)
    grips = [hand.palm + sign * 0.03 * along for sign in (-1, 1)]
    corners = [hand.palm + sign * 0.3 * wide * along - (drop + 0.02) * _UP for sign in (-1, 1)]
    straps = [_bar(grip, corner) for grip, corner in zip(grips, corners, strict=True)]
    return [body, *straps, _bar(grips[0], grips[1])]


def _backpack(wearer: Wearer, size: float) -> tuple[list[Solid], NDArray[np.bool_]]:
    wide, high, deep = 0.25 + 0.1 * size, 0.34 + 0.16 * size, 0.11 + 0.13 * size
    trunk = wearer.of("spine01", "spine02", "spine03")
    frame = wearer.frame(trunk)
    back = (wearer.points[wearer.places.on("upper back")] - frame.shift) @ frame.turn  # as at rest, with its clothes
    top = wearer.landmark("Cervicale")[1] - 0.06
    pack = padded((wide, high, deep)).moved((0, top - high / 2, float(np.quantile(back[:, 2], 0.1)) - deep / 2 + 0.02))
    return [Solid(frame(pack.vertices), pack.faces)], trunk | wearer.of("spine04", "spine05", "clavicle", "shoulder01")


_MAKERS: Final = {"bag": _bag, "bottle": _bottle, "stick": _stick, "box": _box}


def padded(size_m: tuple[float, float, float]) -> Solid:
    """A block with rounded edges around the origin, as a filled bag is. size_m: [3], metres."""
    angles = np.arange(_ROUND) * (-2 * np.pi / _ROUND)
    outline = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    outline /= (np.abs(outline) ** 4).sum(axis=1, keepdims=True) ** 0.25
    profile = [(0.7, 0.5), (0.9, 0.47), (1.0, 0.38), (1.0, 0.0), (1.0, -0.4), (0.92, -0.48), (0.75, -0.5)]
    flat = np.array([[wide, 1.0, wide] for wide, _ in profile])[:, None]
    levels = np.array([[0.0, up, 0.0] for _, up in profile])[:, None]
    rings = np.stack([outline[:, 0] / 2, np.zeros(_ROUND), outline[:, 1] / 2], axis=1)[None] * flat + levels
    return ringed(rings * np.asarray(size_m))


def _bar(a: Floats, b: Floats) -> Solid:
    """A strap from [3] to [3]."""
    length = float(np.linalg.norm(b - a))
    y = (b - a) / length
    x = _level(np.eye(3)[int(np.abs(y).argmin())], y)
    return cuboid((_STRAP_M, length, _STRAP_M), (0, length / 2, 0)).placed(np.stack([x, y, np.cross(x, y)]), a)


def _inside(thing: Solid, points: Floats) -> int:
    """Number of `points` [N, 3] behind all faces of a thing, which is right for convex ones."""
    near = ((points >= thing.vertices.min(axis=0)) & (points <= thing.vertices.max(axis=0))).all(axis=1)
    offsets = np.einsum("fi,fi->f", thing.normals, thing.vertices[thing.faces[:, 0]])
    return int((points[near] @ thing.normals.T < offsets).all(axis=1).sum())


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector), np.float64)


def _level(vector: Floats, axis: Floats) -> Floats:
    """The unit vector nearest to `vector` [3] that is perpendicular to the unit vector `axis` [3]."""
    return _unit(vector - (vector @ axis) * axis)
