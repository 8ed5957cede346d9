"""Hair, shoes, and the closed surfaces of cloth and hair, made for a posed person.

Surfaces are made of grids of points: with two sides, or solids of rings. Hair is a bun on a head, or long hair that
falls over neck, shoulders and back; a shoe is a closed solid around each foot, with a sole.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.anny_model import Posable
from bodyseg_data.bodies.limb_reaching import Side
from bodyseg_data.bodies.skeleton import Floats, Pose, RigidMotion, bone_rotations
from bodyseg_data.bodies.stances import Places
from bodyseg_data.core import Draws
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.meshes import Solid, load_landmarks, vertex_normals

Mask = NDArray[np.bool_]

_ARM: Final = ("upperarm", "lowerarm", "wrist", "metacarpal", "finger")

_SETTLED_M: Final = 0.006  # above the floor, within which lies what would hang lower

Indices = NDArray[np.int64]

_BEGIN_M: Final = 0.03  # over which hair gets its full thickness behind the hairline
_FOREHEAD_M: Final = 0.055  # of the hairline above the bridge of the nose
_NAPE_M: Final = 0.015  # of the hairline below the lowest point of the occipital bone
_BUN_LEVELS: Final = 12
_BUN_COLUMNS: Final = 24
_STRAND_STEP_M: Final = 0.015
_STRANDS: Final = 44
_ROOTS_UP: Final = 0.3  # slope of the directions to the roots above the middle of the skull
_HAIR_THICK_M: Final = 0.012  # at the roots, half as much at the ends
_CLEAR_M: Final = 0.004  # of the strands from the skin
_INERTIA: Final = 0.72  # of a strand's direction from step to step, against its weight
_WAVES_M: Final = 0.004

_SHOE_SLICE_M: Final = 0.012
_SHOE_BAND_M: Final = 0.018  # to each side of a slice
_SOLE_FLAT_M: Final = 0.03  # above the ground at rest, below which skin is on the sole
_SHOE_COLUMNS: Final = 40


class Wearer:
    """A person in a pose. points: float64 [V, 3], metres, the open body's own vertices, dressed as far as clothes are
    its surface. rest: the same person standing straight, bare. normals: [V, 3] of `points`. floor: height of the lowest
    point. solid: bool [V], skin, which leaves out eyes and mouth.
    """

    def __init__(self, person: Posable, points: Floats, places: Places) -> None:
        self.points, self.places = points, places
        self.rest = person.vertices(*person.placed(bone_rotations(Pose())))
        self.normals = vertex_normals(points, person.faces)
        self.floor = float(points[np.unique(person.faces), 1].min())
        self.solid = places.solid
        self._bones = np.array([person.bones[bone] for bone in person.owner])
        self._at = dict(zip(LANDMARKS, load_landmarks("open").vertices, strict=True))

    def of(self, *bones: str, side: Side | None = None) -> Mask:
        """Mark the skin that bones whose names begin like this move most, of one side or all, bool [V]."""
        named = np.any([np.char.startswith(self._bones, bone) for bone in bones], axis=0)
        if side is not None:
            named &= np.char.endswith(self._bones, f".{side}")
        return np.asarray(self.solid & named, np.bool_)

    @cached_property
    def arms(self) -> Mask:
        """Both arms and hands, bool [V]."""
        return self.of(*_ARM)

    def landmark(self, name: str) -> Floats:
        """A landmark at rest, [3], metres."""
        return np.asarray(self.rest[self._at[name]], np.float64)

    def frame(self, of: Mask) -> RigidMotion:
        """The rigid motion from rest to the pose that fits vertices best (Kabsch 1976)."""
        rest, posed = self.rest[of], self.points[of]
        u, _, v = np.linalg.svd((rest - rest.mean(axis=0)).T @ (posed - posed.mean(axis=0)))
        turn = v.T @ np.diag([1.0, 1.0, np.linalg.det(v.T @ u.T)]) @ u.T
        return RigidMotion(turn, posed.mean(axis=0) - turn @ rest.mean(axis=0))

    @cached_property
    def head(self) -> RigidMotion:
        """The head's motion."""
        return self.frame(self.of("head"))


# Surfaces of grids.


def shell(outside: Floats, thickness: Floats | float, around: bool) -> Solid:
    """Make a closed surface of a sheet and its other side.

    outside: float64 [K, J, 3], metres, rows of points. thickness: metres, broadcast to [K, J]; the other side lies that
    far against `grid_normals`. around: the last column is joined to the first. Normals point away from the sheet's
    inside, whichever way its rows and columns run.
    """
    inside = outside - np.broadcast_to(thickness, outside.shape[:2])[..., None] * grid_normals(outside, around)
    rows, columns = outside.shape[:2]
    points = np.concatenate([outside, inside[::-1]]).reshape(-1, 3)
    grid = np.arange(2 * rows * columns).reshape(2 * rows, columns)
    ring = np.concatenate([grid, grid[:1]])
    faces = [_quads(np.concatenate([ring, ring[:, :1]], axis=1) if around else ring)]
    if not around:
        back = grid[rows:][::-1]
        faces += [
            _quads(np.stack([back[:, 0], grid[:rows, 0]], axis=1)),
            _quads(np.stack([grid[:rows, -1], back[:, -1]], axis=1)),
        ]
    return Solid(points, np.concatenate(faces).astype(np.int32))


def ringed(rings: Floats) -> Solid:
    """Make a closed solid of rings [K, J, 3], metres, its ends closed by fans about the means of first and last ring.

    Normals point outwards whichever way the rings run.
    """
    rows, columns = rings.shape[:2]
    grid = np.arange(rows * columns).reshape(rows, columns)
    around = np.concatenate([grid, grid[:, :1]], axis=1)
    first, last = rows * columns, rows * columns + 1
    ends = [
        np.stack([np.full(columns, first), around[0, :-1], around[0, 1:]], axis=1),
        np.stack([np.full(columns, last), around[-1, 1:], around[-1, :-1]], axis=1),
    ]
    points = np.concatenate([rings.reshape(-1, 3), rings[0].mean(axis=0)[None], rings[-1].mean(axis=0)[None]])
    faces = np.concatenate([_quads(around), *ends]).astype(np.int32)
    solid = Solid(points, faces)
    return solid if solid.volume > 0 else Solid(points, faces[:, ::-1])


def hull_radius(points: Floats, ways: Floats) -> Floats:
    """Distance [J] from the origin, inside, to the convex hull of points [N, 2] along unit vectors [J, 2]."""
    from scipy.spatial import ConvexHull

    planes = ConvexHull(points).equations
    towards = ways @ planes[:, :2].T
    distance = np.where(towards > 1e-9, -planes[:, 2] / np.maximum(towards, 1e-9), np.inf)
    return np.asarray(np.maximum(distance.min(axis=1), 0), np.float64)


def settled(points: Floats, floor: float) -> Floats:
    """Points [..., 3] with those below the floor laid on it, in their order of height."""
    lowest = floor + _SETTLED_M
    under = np.maximum(lowest - points[..., 1], 0)
    lying = lowest - 0.7 * _SETTLED_M * (1 - np.exp(-under / 0.1))
    return np.concatenate([points[..., :1], np.where(under > 0, lying, points[..., 1])[..., None], points[..., 2:]], -1)


def grid_normals(points: Floats, around: bool) -> Floats:
    """Unit normals [K, J, 3] of a sheet of points [K, J, 3], along row step x column step."""
    down = np.gradient(points, axis=0)
    joined = np.concatenate([points[:, -1:], points, points[:, :1]], axis=1) if around else points
    across = np.gradient(joined, axis=1)
    normals = np.cross(down, across[:, 1:-1] if around else across)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-9), np.float64)


def _quads(grid: Indices) -> Indices:
    """Two triangles for each mesh of a grid of indices [K, J], normals along row step x column step: [N, 3]."""
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]).reshape(-1, 3)


# Hair.


@dataclass(frozen=True)
class Hair:
    """Hair of a person. kind: "bun" or "long". volume_m: thickness over the scalp, metres. size_m: radius of the bun,
    or length of the hair below its roots, metres. height: of the bun, 0 at the nape to 1 on the crown; of long hair,
    how far it comes forward, 0 behind the ears to 1 over the temples. seed: of the strands.
    """

    kind: Literal["bun", "long"]
    volume_m: float
    size_m: float
    height: float
    seed: int = 0


def scalp(wearer: Wearer, hair: Hair) -> Floats:
    """The wearer's surface [V, 3] with the hair's volume over the scalp."""
    head = np.flatnonzero(wearer.of("head"))
    share = np.clip(_above_hairline(wearer, wearer.rest[head]) / _BEGIN_M, 0, 1)
    thick = hair.volume_m * share * share * (3 - 2 * share)
    points = wearer.points.copy()
    points[head] += thick[:, None] * wearer.normals[head]
    return points


def _above_hairline(wearer: Wearer, rest: Floats) -> Floats:
    """Height of points [N, 3] at rest above the plane of the hairline, metres."""
    front, back = wearer.landmark("Sellion"), wearer.landmark("Nuchale")
    a, b = front + np.array([0, _FOREHEAD_M, 0]), back - np.array([0, _NAPE_M, 0])
    normal = np.array([0.0, a[2] - b[2], b[1] - a[1]])
    return np.asarray((rest - a) @ normal / np.linalg.norm(normal), np.float64)


def bun(wearer: Wearer, hair: Hair) -> Solid:
    """A bun: an ellipsoid that sits on the back of the head."""
    centre, points = _skull(wearer)
    angle = np.radians(-45 + 105 * hair.height)
    out = np.array([0.0, np.sin(angle), -np.cos(angle)])
    ways = points - centre
    lengths = np.linalg.norm(ways, axis=1)
    reach = lengths[ways @ out > 0.94 * lengths].max()
    up = np.array([0.0, np.cos(angle), np.sin(angle)])
    polar = np.pi * (np.arange(_BUN_LEVELS) + 0.5) / _BUN_LEVELS
    around = -2 * np.pi * np.arange(_BUN_COLUMNS) / _BUN_COLUMNS
    local = np.stack(
        [
            np.outer(np.sin(polar), np.cos(around)),
            np.outer(np.sin(polar), np.sin(around)),
            np.outer(np.cos(polar), np.ones(_BUN_COLUMNS)),
        ],
        axis=2,
    )  # fmt: skip
    axes = np.stack([np.cross(up, out), up, 0.75 * out])
    rest = centre + (reach + hair.volume_m + 0.45 * hair.size_m) * out + hair.size_m * local @ axes
    return ringed(wearer.head(rest))


def _skull(wearer: Wearer) -> tuple[Floats, Floats]:
    """The middle of the skull [3] and the skin above the hairline [N, 3], at rest."""
    head = wearer.rest[wearer.of("head")]
    points = head[_above_hairline(wearer, head) > 0]
    return (points.min(axis=0) + points.max(axis=0)) / 2, points


def long_hair(wearer: Wearer, hair: Hair) -> Solid:
    """A sheet of strands from the sides and the back of the head, which fall, lie on the body and end on the floor."""
    from scipy.ndimage import gaussian_filter

    centre, points = _skull(wearer)
    turned = np.radians(80 + 35 * hair.height) * np.linspace(1, -1, _STRANDS)
    ways = np.stack([np.sin(turned), np.full(_STRANDS, _ROOTS_UP), -np.cos(turned)], axis=1)
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    offsets = points - centre
    lengths = np.linalg.norm(offsets, axis=1)
    reach = np.where(ways @ offsets.T > 0.94 * lengths, lengths, 0).max(axis=1)
    roots = wearer.head(centre + (reach + hair.volume_m - _HAIR_THICK_M)[:, None] * ways)
    sheet = _fallen(wearer, hair, roots, wearer.head.turn @ np.array([0.0, -1.0, 0.0]))
    sheet = gaussian_filter(sheet, (1.0, 1.5, 0.0), mode="nearest")
    share = np.linspace(0, 1, len(sheet))[:, None]
    draws = Draws(hair.seed, 0, "open/hair").generator("strands")
    waves = gaussian_filter(draws.standard_normal(sheet.shape[:2]), (8.0, 1.0), mode="nearest")
    waves *= _WAVES_M / max(float(waves.std()), 1e-9)
    thick = _HAIR_THICK_M * (1 - 0.5 * share) + np.clip(waves, -_HAIR_THICK_M / 3, _HAIR_THICK_M)
    outside = sheet + thick[..., None] * grid_normals(sheet, around=False)
    strands = shell(outside, thick, around=False)
    return Solid(settled(strands.vertices, wearer.floor), strands.faces)


def _fallen(wearer: Wearer, hair: Hair, roots: Floats, way: Floats) -> Floats:
    """Strands [K, J, 3] from their roots [J, 3], which begin along `way` [3] and turn downwards, outside the body."""
    from scipy.spatial import cKDTree

    body = wearer.solid & ~wearer.arms
    skin, normals = scalp(wearer, hair)[body], wearer.normals[body]
    tree = cKDTree(skin)
    ways = np.tile(way, (len(roots), 1))
    strands = [roots]
    for _ in range(max(2, round(hair.size_m / _STRAND_STEP_M))):
        ways = _INERTIA * ways + (1 - _INERTIA) * np.array([0.0, -1.0, 0.0])
        moved = strands[-1] + _STRAND_STEP_M * ways / np.linalg.norm(ways, axis=1, keepdims=True)
        nearest = tree.query(moved)[1]
        height = np.einsum("ij,ij->i", moved - skin[nearest], normals[nearest])
        moved += np.maximum(_CLEAR_M - height, 0)[:, None] * normals[nearest]
        moved[:, 1] = np.maximum(moved[:, 1], wearer.floor + _CLEAR_M)
        step = moved - strands[-1]
        lengths = np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-6)
        strands.append(strands[-1] + step * np.minimum(_STRAND_STEP_M / lengths, 1))
        ways = step / lengths
    return np.array(strands)


# Shoes.


@dataclass(frozen=True)
class Shoes:
    """A pair of shoes. upper_m: from the foot to their outside, metres. sole_m: thickness of the sole, metres."""

    upper_m: float
    sole_m: float


def shoe(wearer: Wearer, shoes: Shoes, side: Side) -> Solid:
    """The shoe of one foot: convex slices from heel to toes, so that toes do not show."""
    from scipy.ndimage import gaussian_filter1d

    foot = wearer.of("foot", "toe", side=side)
    ankle = wearer.landmark(f"{side}t. Lateral Malleolus")[1]
    frame = wearer.frame(foot)
    foot &= wearer.rest[:, 1] < ankle
    rest = frame.back(wearer.points[foot])
    flat = rest[wearer.rest[foot][:, 1] < wearer.rest[foot][:, 1].min() + _SOLE_FLAT_M]
    points = np.concatenate([rest, flat - np.array([0, shoes.sole_m, 0])])
    toes = rest[rest[:, 2] > np.quantile(rest[:, 2], 0.9)].mean(axis=0)
    heel = rest[rest[:, 2] < np.quantile(rest[:, 2], 0.1)].mean(axis=0)
    ahead = (toes - heel) * [1, 0, 1] / np.linalg.norm((toes - heel) * [1, 0, 1])
    axes = np.stack([np.cross([0.0, 1.0, 0.0], ahead), [0.0, 1.0, 0.0], ahead])
    local = points @ axes.T
    low, high = local[:, 2].min(), local[:, 2].max()
    angles = np.arange(_SHOE_COLUMNS) * (2 * np.pi / _SHOE_COLUMNS)
    ways = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    slices = np.arange(low + _SHOE_BAND_M / 2, high, _SHOE_SLICE_M)
    centres, radii = [], []
    for at in slices:
        section = local[np.abs(local[:, 2] - at) < _SHOE_BAND_M, :2]
        centres.append((section.min(axis=0) + section.max(axis=0)) / 2)
        radii.append(hull_radius(section - centres[-1], ways) + shoes.upper_m)
    along = np.concatenate([[low - shoes.upper_m], slices, [high + shoes.upper_m]])
    middles = gaussian_filter1d(np.array([centres[0], *centres, centres[-1]]), 1.0, axis=0, mode="nearest")
    wide = gaussian_filter1d(np.array([0.6 * radii[0], *radii, 0.6 * radii[-1]]), 0.7, axis=0, mode="nearest")
    rings = np.concatenate(
        [middles[:, None] + wide[..., None] * ways, np.broadcast_to(along[:, None, None], (*wide.shape, 1))], axis=2
    )
    return ringed(frame(rings @ axes))
