"""Hair: a bun on a head, or long hair that falls over neck, shoulders and back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.worn.shells import grid_normals, ringed, settled, shell
from bodyseg_data.bodies.worn.wearer import Wearer
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.randomness import generator
from bodyseg_data.meshes.solids import Solid

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Hair:
    """Hair of a person. kind: "bun" or "long". volume_m: thickness over the scalp, metres. size_m: radius of the bun,
    or length of the hair below its roots, metres. height: of the bun, 0 at the nape to 1 on the crown; of long hair,
    how far it comes forward, 0 behind the ears to 1 over the temples. seed: of the strands.

    Raises BadConfig for another kind or a number out of its range.
    """

    kind: Literal["bun", "long"]
    volume_m: float
    size_m: float
    height: float
    seed: int = 0

    def __post_init__(self) -> None:
        if self.kind not in _SIZES:
            raise BadConfig(f"hair must be {' or '.join(_SIZES)}, found {self.kind!r}")
        for name, (low, high) in {"volume_m": (0, 0.03), "size_m": _SIZES[self.kind], "height": (0, 1)}.items():
            if not low <= getattr(self, name) <= high:
                raise BadConfig(
                    f"the {name} of {self.kind} hair must be {low:g} to {high:g}, found {getattr(self, name)!r}"
                )


_SIZES: Final[dict[str, tuple[float, float]]] = {"bun": (0.02, 0.07), "long": (0.1, 0.7)}

_BEGIN_M: Final = 0.03  # over which hair gets its full thickness behind the hairline
_FOREHEAD_M: Final = 0.055  # of the hairline above the bridge of the nose
_NAPE_M: Final = 0.015  # of the hairline below the lowest point of the occipital bone
_LEVELS: Final = 12
_AROUND: Final = 24
_STEP_M: Final = 0.015
_STRANDS: Final = 44
_ROOTS_UP: Final = 0.3  # slope of the directions to the roots above the middle of the skull
_THICK_M: Final = 0.012  # at the roots, half as much at the ends
_CLEAR_M: Final = 0.004  # of the strands from the skin
_INERTIA: Final = 0.72  # of a strand's direction from step to step, against its weight
_WAVES_M: Final = 0.004


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
    polar = np.pi * (np.arange(_LEVELS) + 0.5) / _LEVELS
    around = -2 * np.pi * np.arange(_AROUND) / _AROUND
    local = np.stack(
        [
            np.outer(np.sin(polar), np.cos(around)),
            np.outer(np.sin(polar), np.sin(around)),
            np.outer(np.cos(polar), np.ones(_AROUND)),
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
    roots = wearer.head(centre + (reach + hair.volume_m - _THICK_M)[:, None] * ways)
    sheet = _fallen(wearer, hair, roots, wearer.head.turn @ np.array([0.0, -1.0, 0.0]))
    sheet = gaussian_filter(sheet, (1.0, 1.5, 0.0), mode="nearest")
    share = np.linspace(0, 1, len(sheet))[:, None]
    draws = generator(hair.seed, 0, "open/hair", "strands")
    waves = gaussian_filter(draws.standard_normal(sheet.shape[:2]), (8.0, 1.0), mode="nearest")
    waves *= _WAVES_M / max(float(waves.std()), 1e-9)
    thick = _THICK_M * (1 - 0.5 * share) + np.clip(waves, -_THICK_M / 3, _THICK_M)
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
    for _ in range(max(2, round(hair.size_m / _STEP_M))):
        ways = _INERTIA * ways + (1 - _INERTIA) * np.array([0.0, -1.0, 0.0])
        moved = strands[-1] + _STEP_M * ways / np.linalg.norm(ways, axis=1, keepdims=True)
        nearest = tree.query(moved)[1]
        height = np.einsum("ij,ij->i", moved - skin[nearest], normals[nearest])
        moved += np.maximum(_CLEAR_M - height, 0)[:, None] * normals[nearest]
        moved[:, 1] = np.maximum(moved[:, 1], wearer.floor + _CLEAR_M)
        step = moved - strands[-1]
        lengths = np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-6)
        strands.append(strands[-1] + step * np.minimum(_STEP_M / lengths, 1))
        ways = step / lengths
    return np.array(strands)
