"""Clothes over the open body: the surface of a dressed person in any pose, on the body's own vertices.

A wardrobe cuts an outfit to a person once. Worn in a pose, the cloth is the body's surface, smoothed so that details of
the body do not show, moved outwards by the width of the garment, more below a limb than above, and folded: deepest
where the pose shortens the surface. `docs/reference/clothes.md` lists what is modelled and what is not.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.clothes.folds import DIRECTIONS, fold_patterns
from bodyseg_data.bodies.clothes.operators import Smoother, averaging, diffused, gathering, patch, sliding
from bodyseg_data.bodies.clothes.outfits import Outfit
from bodyseg_data.bodies.clothes.tailoring import cut
from bodyseg_data.core.errors import BadMesh
from bodyseg_data.meshes.landmarks.by_vertex import load_landmarks

Floats = NDArray[np.float64]

FINE_M: Final = 0.022
"""Longest edge that still carries the folds: half the shortest wavelength. Finer meshes come from `Refinement`."""

_THICKNESS_M: Final = 0.004  # of cloth: its smallest distance from the skin
_SMOOTH_M: Final = 0.03  # detail of the body much smaller than this does not show through
_DIFFUSION_M: Final = 0.035  # over which the width of a garment is evened out
_HANG: Final = 0.9  # difference of the distance below and above a level limb, as a share
_MOST_SHORTENED: Final = 0.25  # beyond, cloth slides along the body instead of folding deeper
_DEEPEST_M: Final = 0.022
_AT_REST: Final = np.array([0.1, 0.6, 1.0, 0.6])  # share of an outfit's slack that folds across each of DIRECTIONS
_AT_ENDS: Final = np.array([1.0, 0.5, 0.2, 0.5])  # and of its crumple
_SMOOTHINGS: Final = 3  # of normals over neighbouring vertices, or flat triangles would show through wide cloth
_DECIMALS: Final = 6  # to the micrometre, as the body


class Wardrobe:
    """One person's clothes, cut once and worn in any pose. covered: bool [V], the vertices that clothes move."""

    def __init__(self, rest: Floats, faces: NDArray[np.int32], outfit: Outfit) -> None:
        """Cut `outfit` to a person.

        rest: float64 [V, 3], metres, body frame, standing straight with hanging arms, in the numbering of the open
        body or of a `Refinement` of it. faces: int32 [F, 3]. Raises BadMesh for anything else, as far as it shows.
        """
        self._count = len(rest)
        _check(rest, self._count)
        least = load_landmarks("open").vertex_count
        if self._count < least or faces.min() < 0 or faces.max() >= self._count:
            raise BadMesh(
                f"clothes are cut for the open body, of {least} vertices or more, found {self._count} vertices and "
                f"faces of vertices {faces.min()} to {faces.max()}"
            )
        pieces = cut(rest, faces, outfit)
        self.covered: NDArray[np.bool_] = pieces.top | pieces.trousers
        self._vertices, self._faces = patch(faces, self.covered)
        points = rest[self._vertices]
        self._free = self.covered[self._vertices]
        self._cover = self._free.astype(np.float64)[:, None]
        garment = np.where(pieces.top, 1, np.where(pieces.trousers, 2, 0))[self._vertices]
        self._gather = gathering(self._faces, len(points))
        self._average = averaging(self._faces, garment)
        self._slide = sliding(pieces.partner, pieces.slide, self._vertices)
        self._smoother = Smoother(points, self._faces, self._free, _SMOOTH_M)
        self._stand_off = diffused(pieces.stand_off[self._vertices], points, self._faces, garment, _DIFFUSION_M)
        self._slack = outfit.slack * _AT_REST + pieces.crumple[self._vertices, None] * _AT_ENDS
        normals = self._normals(points)
        axes = _tangent(pieces.axis[self._vertices], normals)
        areas = self._gather @ np.linalg.norm(self._face_normals(points), axis=1) / 6
        self._patterns = fold_patterns(points, normals, axes, areas, outfit.fold_m, outfit.seed)
        self._wave = outfit.fold_m
        self._rest_areas, self._frames = self._rest_frames(points, axes)

    def worn(self, vertices: Floats) -> Floats:
        """Return the dressed surface [V, 3] of the posed body `vertices` [V, 3], metres, body frame.

        Vertices that no garment covers come back as they are, bit for bit. The cloth changes smoothly with the pose.
        Raises BadMesh for another number of vertices or for coordinates that are not finite.
        """
        _check(vertices, self._count)
        shortened = self._shortened(vertices[self._vertices])
        body = self._slide @ vertices[self._vertices]
        calm = self._smoother(body)
        out = self._normals(calm)
        for _ in range(_SMOOTHINGS):
            out = self._average @ out
        out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)
        width = self._stand_off * (1 - _HANG * out[:, 1])
        # A strip with an excess length of share s has waves of amplitude wavelength / pi * sqrt(s).
        depths = self._wave / np.pi * np.sqrt(self._slack + shortened)
        folds = _DEEPEST_M * np.tanh((depths * self._patterns).sum(axis=1) / _DEEPEST_M)
        cloth = self._outside(calm + self._cover * (_THICKNESS_M + width + folds)[:, None] * out, body, out)
        cloth += 0.5 * self._cover * (self._average @ cloth - cloth)
        cloth = self._outside(cloth, body, out)
        dressed = vertices.copy()
        dressed[self._vertices[self._free]] = np.round(cloth[self._free], _DECIMALS) + 0.0
        return dressed

    def _outside(self, cloth: Floats, body: Floats, out: Floats) -> Floats:
        """Push cloth along `out` where it is closer to the body than its thickness."""
        gap = np.einsum("ij,ij->i", cloth - body, out)[:, None]
        return np.asarray(cloth + self._cover * np.maximum(_THICKNESS_M - gap, 0) * out, np.float64)

    def _face_normals(self, points: Floats) -> Floats:
        a, b, c = (points[self._faces[:, corner]] for corner in range(3))
        return np.asarray(np.cross(b - a, c - a), np.float64)

    def _normals(self, points: Floats) -> Floats:
        normals = self._gather @ self._face_normals(points)
        return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12), np.float64)

    def _rest_frames(self, points: Floats, axes: Floats) -> tuple[Floats, Floats]:
        """Return double areas [F] at rest, and the inverse [F, 2, 2] of each triangle's edges in (axis, around it)."""
        across = self._face_normals(points)
        areas = np.linalg.norm(across, axis=1)
        across /= np.maximum(areas, 1e-15)[:, None]
        axis = _tangent(axes[self._faces].sum(axis=1), across)
        frame = np.stack([axis, np.cross(across, axis)], axis=1)
        (a, b), (c, d) = np.moveaxis(frame @ self._edges(points), 0, 2)
        # Written out: a linear-algebra library would be called once a triangle, and its threads wait for each other.
        inverse = np.moveaxis(np.array([[d, -b], [-c, a]]) / np.maximum(a * d - b * c, 1e-15), 2, 0)
        return areas, np.ascontiguousarray(inverse)

    def _edges(self, points: Floats) -> Floats:
        a, b, c = (points[self._faces[:, corner]] for corner in range(3))
        return np.stack([b - a, c - a], axis=2)

    def _shortened(self, points: Floats) -> Floats:
        """Return the share by which the surface is shorter than at rest in each of DIRECTIONS, [N, 4]; 0 if longer."""
        b, c = np.moveaxis(self._edges(points), 2, 0)
        x, y = (b * self._frames[:, 0, way, None] + c * self._frames[:, 1, way, None] for way in (0, 1))
        metric = np.stack([np.einsum("fi,fi->f", u, v) for u, v in ((x, x), (x, y), (y, y))], axis=1)
        metric = self._gather @ (metric * self._rest_areas[:, None]) / (self._gather @ self._rest_areas)[:, None]
        for _ in range(_SMOOTHINGS):
            metric = self._average @ metric
        cosine, sine = np.cos(DIRECTIONS), np.sin(DIRECTIONS)
        lengths = np.sqrt(np.maximum(metric @ np.stack([cosine**2, 2 * cosine * sine, sine**2]), 1e-4))
        return np.asarray(np.clip(1 - lengths, 0, _MOST_SHORTENED), np.float64)


def _tangent(ways: Floats, normals: Floats) -> Floats:
    """Return unit vectors along the components of `ways` [N, 3] perpendicular to `normals` [N, 3]."""
    ways = ways - np.einsum("ij,ij->i", ways, normals)[:, None] * normals
    return np.asarray(ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12), np.float64)


def _check(vertices: Floats, count: int) -> None:
    if vertices.shape != (count, 3):
        raise BadMesh(f"clothes cut for {count} vertices need as many with three coordinates, found {vertices.shape}")
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(bad):
        raise BadMesh(f"clothes need finite coordinates, found {vertices[bad[0]].tolist()} at vertex {bad[0]}")
