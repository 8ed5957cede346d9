"""Drapes and things: skirts and coats around trunk and both legs; a bag, bottle, stick, box or backpack.

The body's surface moved outwards cannot join two legs. A drape is a tube of rings instead: at every height of the
person at rest, the convex hull of the trunk or of both legs as they are posed, no narrower than the ring above as far
as the cloth hangs. Things have a range and no label.
"""

from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.limb_reaching import Side
from bodyseg_data.bodies.shells import Wearer, hull_radius, ringed, settled, shell
from bodyseg_data.bodies.skeleton import Floats, Pose
from bodyseg_data.bodies.wardrobe import fold_patterns
from bodyseg_data.meshes import Solid, cuboid, turned_solid

_RING_STEP_M: Final = 0.025  # between rings
_BAND_M: Final = 0.035  # a ring encloses the skin this far to each side; longer than the skin's edges
_RAISED_M: Final = 0.12  # the same, in height at rest, of skin that a tilted ring passes
_DRAPE_COLUMNS: Final = 96
_LEAST_AWAY_M: Final = 0.006  # least distance of the cloth from the body's hull
_CLOTH_M: Final = 0.003
_HANG: Final = 0.9  # cloth stands off by 1 + this of its width below a level limb, by 1 - this above it
_SHRINK: Final = 0.5  # metres a metre by which cloth that does not hang comes back to the body
_STEEPEST: Final = 1.0  # tilt of a ring, where one leg is ahead of the other
_FOLDING_M: Final = 0.3  # below the hips, over which folds become as deep as at the hem
_ALONG: Final = np.array([0.0, 0.4, 1.0, 0.4])  # share of each of the fold patterns' directions: lengthwise most
_SOFT: Final = (2.0, 0.8)  # standard deviation, in rows and columns, by which folds are smoothed
_LEFT_OVER: Final = 0.6  # of the length below the crotch, the least that a drape which rides up may keep

Kind = Literal["bag", "bottle", "stick", "box", "backpack"]

IN_HAND: Final[dict[Kind, float]] = {"bag": 0.35, "bottle": 0.25, "box": 0.25, "stick": 0.15}
"""Weights of the kinds that a hand holds."""

_FISTS: Final[dict[Kind, float]] = {"bag": 0.8, "bottle": 0.6, "stick": 0.85, "box": 0.15}
_MOST_INSIDE: Final = 12  # vertices of the rest of the body that may be inside a thing: cloth and flesh give way
_UP: Final = np.array([0.0, 1.0, 0.0])
_HOLLOW_M: Final = 0.012  # from a palm's skin to what its closed fingers hold
_STRAP_M: Final = 0.012
_ROUND_COLUMNS: Final = 32
_HIGHEST_M: Final = 2.4  # of body and thing together: no mesh is larger


# Drapes.


@dataclass(frozen=True)
class Drape:
    """A skirt or coat. top: its upper end, 0 hip bones (ASIS) to 1 armpits. length: its lower end, 0 crotch to 1 ankle
    bone. loose_m: mean distance of the cloth from the hull of the body, metres. flare: metres by which it widens for
    every metre that it falls. girth_m: length of the cloth around the hem, metres, beyond which it rides up. fold_m:
    wavelength of the folds. fold_depth_m: of the folds at the hem. open_deg: angle to each side of the front by which a
    coat stands open at the hem, 0 closed. seed: of the fold patterns.
    """

    top: float
    length: float
    loose_m: float
    flare: float
    girth_m: float
    fold_m: float
    fold_depth_m: float
    open_deg: float
    seed: int


def draped(wearer: Wearer, drape: Drape) -> Solid | None:
    """The surface of a drape on a posed person, or None if too little of it would be left: its legs need more cloth
    than its girth, as when one is kicked up, or it is crumpled so far that it encloses nothing.
    """
    hip = (wearer.landmark("Lt. ASIS")[1] + wearer.landmark("Rt. ASIS")[1]) / 2
    armpit = (wearer.landmark("Lt. Axilla, Post.")[1] + wearer.landmark("Rt. Axilla, Post.")[1]) / 2
    ankle = (wearer.landmark("Lt. Lateral Malleolus")[1] + wearer.landmark("Rt. Lateral Malleolus")[1]) / 2
    middle = wearer.solid & (np.abs(wearer.rest[:, 0]) < 0.012) & (wearer.rest[:, 1] > 0.3 * hip)
    crotch = float(wearer.rest[middle, 1].min())
    start, end = hip + drape.top * (armpit - hip), crotch + drape.length * (ankle - crotch)
    heights = np.arange(start, end, -_RING_STEP_M)
    rings = _Rings(wearer, heights)
    loop, girths = rings.hung(drape)
    below = np.maximum(crotch - heights, 0)
    too_wide = np.flatnonzero((girths > drape.girth_m) & (below > 0))
    kept = int(too_wide[0]) if len(too_wide) else len(heights)
    if kept < len(heights) and below[kept - 1] < _LEFT_OVER * (crotch - end):
        return None
    depth = np.clip((hip - heights[:kept]) / _FOLDING_M, 0, 1)
    loop = rings.loop(np.maximum(loop[:kept] + depth[:, None] * _folds(drape, kept), rings.body[:kept] + _LEAST_AWAY_M))
    if drape.open_deg:
        loop = _opened(loop, np.radians(drape.open_deg) * (0.3 + 0.7 * np.linspace(0, 1, kept)))
    cloth = shell(loop, _CLOTH_M, around=not drape.open_deg)
    cloth = Solid(settled(cloth.vertices, wearer.floor), cloth.faces)
    return cloth if cloth.volume > 0 else None


class _Rings:
    """Frames and hulls of the body at each level. body: float64 [K, J], metres, radius of the hull."""

    def __init__(self, wearer: Wearer, heights: Floats) -> None:
        from scipy.ndimage import gaussian_filter1d

        whole = wearer.solid & ~wearer.arms
        rest, points = wearer.rest[whole], wearer.points[whole]
        near = [np.abs(rest[:, 1] - height) < _BAND_M for height in heights]
        lefts = [points[ring & (rest[:, 0] > 0)].mean(axis=0) for ring in near]
        rights = [points[ring & (rest[:, 0] <= 0)].mean(axis=0) for ring in near]
        self.centres: Floats = (np.array(lefts) + np.array(rights)) / 2
        axes = gaussian_filter1d(np.gradient(self.centres, axis=0), 2.0, axis=0, mode="nearest")
        self.axes: Floats = axes / np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-9)
        self._turns(wearer)
        angles = np.arange(_DRAPE_COLUMNS) * (2 * np.pi / _DRAPE_COLUMNS)
        self._ways: Floats = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        local = [(points - centre) @ frame.T for centre, frame in zip(self.centres, self.frames, strict=True)]
        tilts = [
            np.linalg.lstsq(at[ring, :2], at[ring, 2], rcond=None)[0] for at, ring in zip(local, near, strict=True)
        ]
        tilts = np.clip(tilts, -_STEEPEST, _STEEPEST)
        self._tilts: Floats = gaussian_filter1d(tilts, 2.0, axis=0, mode="nearest")
        hulls = []
        for at, ring, tilt, height in zip(local, near, self._tilts, heights, strict=True):
            # Where a leg is raised, skin of other heights at rest is beside the ring, too.
            beside = (np.abs(at[:, 2] - at[:, :2] @ tilt) < _RING_STEP_M) & (np.abs(rest[:, 1] - height) < _RAISED_M)
            hulls.append(hull_radius(at[ring | beside, :2], self._ways))
        self.body: Floats = np.array(hulls)

    def _turns(self, wearer: Wearer) -> None:
        """Frames [K, 3, 3], rows: to the left, to the back, down the garment; carried along without twist."""
        pelvis = wearer.frame(wearer.of("root", "pelvis", "spine05"))
        left = pelvis.turn[:, 0]
        frames = []
        for axis in self.axes:
            left = left - (left @ axis) * axis
            left = left / np.linalg.norm(left)
            frames.append(np.stack([left, np.cross(left, axis), axis]))
        self.frames: Floats = np.array(frames)

    def loop(self, radii: Floats, first: int = 0) -> Floats:
        """Points [N, J, 3] at these radii [N, J] of the rings from `first` on."""
        rings = slice(first, first + len(radii))
        flat = radii[..., None] * self._ways
        along = np.einsum("kjc,kc->kj", flat, self._tilts[rings])
        local = np.concatenate([flat, along[..., None]], axis=2)
        return np.asarray(self.centres[rings, None] + np.einsum("kjc,kcd->kjd", local, self.frames[rings]), np.float64)

    def hung(self, drape: Drape) -> tuple[Floats, Floats]:
        """Radii [K, J] of the cloth without folds, and the least length around each ring [K], metres."""
        from scipy.ndimage import gaussian_filter

        outwards = np.einsum("jc,kcd->kjd", self._ways, self.frames[:, :2])
        ease = np.maximum(drape.loose_m * (1 - _HANG * outwards[..., 1]), _LEAST_AWAY_M)
        radii = self.body + ease
        falls = np.clip(-self.axes[:, 1], 0, 1)
        for level in range(1, len(radii)):
            above = self.loop(radii[level - 1 : level], level - 1)[0]
            widened = _RING_STEP_M * (drape.flare * falls[level] - _SHRINK * (1 - falls[level]))
            radii[level] = np.maximum(radii[level], self._radius(above, level) + widened)
        radii = np.maximum(gaussian_filter(radii, (1.0, 1.0), mode=("nearest", "wrap")), self.body + _LEAST_AWAY_M)
        loops = self.loop(self.body + _LEAST_AWAY_M)
        return radii, np.linalg.norm(np.roll(loops, -1, axis=1) - loops, axis=2).sum(axis=1)

    def _radius(self, loop: Floats, level: int) -> Floats:
        """Radii [J] of a loop [J, 3] that is moved along the axis of a ring into its frame."""
        x, y = ((loop - self.centres[level]) @ self.frames[level, :2].T).T
        angles = np.arctan2(y, x)
        order = np.argsort(angles)
        asked = np.arctan2(self._ways[:, 1], self._ways[:, 0])
        return np.asarray(np.interp(asked, angles[order], np.hypot(x, y)[order], period=2 * np.pi), np.float64)


def _folds(drape: Drape, rows: int) -> Floats:
    """Folds [rows, J], metres at the hem, drawn on a cylinder as long around as the hem."""
    from scipy.ndimage import gaussian_filter

    radius = drape.girth_m / (2 * np.pi)
    angles, down = np.arange(_DRAPE_COLUMNS) * (2 * np.pi / _DRAPE_COLUMNS), np.arange(rows) * -_RING_STEP_M
    ways = np.stack([np.cos(angles), np.zeros(_DRAPE_COLUMNS), -np.sin(angles)], axis=1)
    normals = np.tile(ways, (rows, 1))
    points = normals * radius + np.repeat(down, _DRAPE_COLUMNS)[:, None] * [0.0, 1.0, 0.0]
    axes = np.tile([0.0, -1.0, 0.0], (len(points), 1))
    areas = np.full(len(points), _RING_STEP_M * drape.girth_m / _DRAPE_COLUMNS)
    patterns = fold_patterns(points, normals, axes, areas, drape.fold_m, drape.seed)
    folds = gaussian_filter((patterns @ _ALONG).reshape(rows, _DRAPE_COLUMNS), _SOFT, mode=("nearest", "wrap"))
    return np.asarray(drape.fold_depth_m * np.clip(folds, -1, 1), np.float64)


def _opened(loop: Floats, half_rad: Floats) -> Floats:
    """The loop [K, J, 3] cut open in front: columns closer together, from `half_rad` [K] on one side to the other."""
    front = 0.75 * _DRAPE_COLUMNS  # number of the column in front: they begin on the left and pass the back first
    shares = np.linspace(0, 1, _DRAPE_COLUMNS)
    rows = []
    for ring, half in zip(loop, half_rad * (_DRAPE_COLUMNS / (2 * np.pi)), strict=True):
        at = front + half + shares * (_DRAPE_COLUMNS - 2 * half)
        numbers = np.arange(_DRAPE_COLUMNS)
        rows.append(
            np.stack([np.interp(at, numbers, ring[:, axis], period=_DRAPE_COLUMNS) for axis in range(3)], axis=1)
        )
    return np.array(rows)


# Things.


@dataclass(frozen=True)
class Held:
    """A thing that is held or worn. side: of the hand; a backpack has none to say. size: 0 smallest to 1 largest."""

    kind: Kind
    side: Side = "L"
    size: float = 0.5


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
    return [] if sum(_inside(piece, others) for piece in pieces) > _MOST_INSIDE else pieces


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
        """The thing with its y axis along `up` [3], its z axis away from the palm if it can, its origin at `at`."""
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
    back = frame.back(wearer.points[wearer.places.on("upper back")])  # the dressed back, moved to the pose at rest
    top = wearer.landmark("Cervicale")[1] - 0.06
    pack = padded((wide, high, deep)).moved((0, top - high / 2, float(np.quantile(back[:, 2], 0.1)) - deep / 2 + 0.02))
    return [frame.of(pack)], trunk | wearer.of("spine04", "spine05", "clavicle", "shoulder01")


_MAKERS: Final = {"bag": _bag, "bottle": _bottle, "stick": _stick, "box": _box}


def padded(size_m: tuple[float, float, float]) -> Solid:
    """A block with rounded edges around the origin, as a filled bag is. size_m: [3], metres."""
    angles = np.arange(_ROUND_COLUMNS) * (-2 * np.pi / _ROUND_COLUMNS)
    outline = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    outline /= (np.abs(outline) ** 4).sum(axis=1, keepdims=True) ** 0.25
    profile = [(0.7, 0.5), (0.9, 0.47), (1.0, 0.38), (1.0, 0.0), (1.0, -0.4), (0.92, -0.48), (0.75, -0.5)]
    flat = np.array([[wide, 1.0, wide] for wide, _ in profile])[:, None]
    levels = np.array([[0.0, up, 0.0] for _, up in profile])[:, None]
    rings = np.stack([outline[:, 0] / 2, np.zeros(_ROUND_COLUMNS), outline[:, 1] / 2], axis=1)[None] * flat + levels
    return ringed(rings * np.asarray(size_m))


def _bar(a: Floats, b: Floats) -> Solid:
    """A strap from `a` [3] to `b` [3]."""
    length = float(np.linalg.norm(b - a))
    y = (b - a) / length
    x = _level(np.eye(3)[int(np.abs(y).argmin())], y)
    return cuboid((_STRAP_M, length, _STRAP_M), (0, length / 2, 0)).placed(np.stack([x, y, np.cross(x, y)]), a)


def _inside(thing: Solid, points: Floats) -> int:
    """Number of `points` [N, 3] inside a convex thing: behind all of its faces."""
    near = ((points >= thing.vertices.min(axis=0)) & (points <= thing.vertices.max(axis=0))).all(axis=1)
    offsets = np.einsum("fi,fi->f", thing.normals, thing.vertices[thing.faces[:, 0]])
    return int((points[near] @ thing.normals.T < offsets).all(axis=1).sum())


def _unit(vector: Floats) -> Floats:
    return np.asarray(vector / np.linalg.norm(vector), np.float64)


def _level(vector: Floats, axis: Floats) -> Floats:
    """The unit vector nearest to `vector` [3] that is perpendicular to the unit vector `axis` [3]."""
    return _unit(vector - (vector @ axis) * axis)
