"""One surface from all frames, and cameras moved so that each frame fits it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.model.real.recording import Floats, Frame
from bodyseg_data.core import BadConfig
from bodyseg_data.meshes import find_edges, vertex_normals
from bodyseg_data.meshes.mesh import components, face_components
from bodyseg_data.rigs import PlacedCamera

VOXEL_M: Final = 0.004

_TRUNCATION: Final = 4  # voxels behind the surface, where a frame still counts
_LEAST_FRAMES: Final = 3  # that see a voxel; with fewer the surface stays open there
_LEAST_DISTANCE: Final = np.float32(0.02)  # of the truncation: no corner of the surface falls on a corner of the grid
_MARGIN_M: Final = 0.03
_OUTSIDE: Final = 0.002  # share of a frame's points that may lie outside the volume: loose pixels
_TILE: Final = 1 << 20  # voxels at once
_RIM: Final = 0.2  # of the surface's height, from below: a boundary that reaches it is where the frames end
_NEAR_M: Final = 0.02  # a pixel's point farther from the surface than this has no counterpart there
_FACING: Final = 0.7  # least cosine between its normal and the surface's
_STEPS: Final = 6  # of fitting one frame
_LEAST_MATCHES: Final = 100  # a frame with fewer stays where it is
_PIXELS: Final = 4000  # of a frame that fitting uses


@dataclass(frozen=True)
class FusedSurface:
    """The surface in the world. vertices, normals: float64 [V, 3], metres; normals point outwards, of unit length.
    faces: int64 [F, 3], manifold, one piece. rim: int64 [R], vertices of the boundary where the frames end below.
    """

    vertices: Floats
    faces: NDArray[np.int64]
    normals: Floats
    rim: NDArray[np.int64]


def fuse(frames: Sequence[Frame], voxel_m: float = VOXEL_M) -> FusedSurface:
    """Fuse the frames: the zero level of the mean truncated signed distance (Curless and Levoy 1996; Lorensen and Cline
    1987), its largest piece, without what fewer than three frames see.

    The world's y must point down. Raises BadConfig if the frames show no surface together.
    """
    from skimage.measure import marching_cubes

    distance, known, low = _volume(frames, voxel_m)
    if not (distance[known] > 0).any() or not (distance[known] < 0).any():
        raise BadConfig(f"frames must see one surface together, found none in {len(frames)} frames: are cameras right?")
    points, faces, _, _ = marching_cubes(distance, 0.0)
    ends = [np.clip(np.rint(points + sign * 0.499).astype(int), 0, np.array(known.shape) - 1) for sign in (-1, 1)]
    seen = known[tuple(ends[0].T)] & known[tuple(ends[1].T)]  # both ends of the edge of the grid that a vertex is on
    faces = faces[seen[faces].all(axis=1)].astype(np.int64)
    piece = face_components(len(points), faces)
    faces = faces[piece[faces[:, 0]] == np.bincount(piece[faces[:, 0]]).argmax()]
    used, corners = np.unique(faces, return_inverse=True)
    vertices = low + voxel_m * points[used].astype(np.float64)
    faces = corners.reshape(-1, 3)
    return FusedSurface(vertices, faces, vertex_normals(vertices, faces.astype(np.int32)), _rim(vertices, faces))


def fitted(frames: Sequence[Frame], surface: FusedSurface) -> list[Frame]:
    """Move each frame's camera so that its points lie on the surface: Gauss-Newton steps on the distances of points to
    the planes at their nearest vertices (Chen and Medioni 1992).
    """
    from scipy.spatial import KDTree
    from scipy.spatial.transform import Rotation

    tree = KDTree(surface.vertices)
    found = []
    for frame in frames:
        sample, placed = _sample(frame), frame.placed
        for _ in range(_STEPS):
            points, vertices = _matches(sample, placed, surface, tree)
            if len(points) < _LEAST_MATCHES:
                break
            normals = surface.normals[vertices]
            away = ((points - surface.vertices[vertices]) * normals).sum(axis=1)
            middle = points.mean(axis=0)
            rows = np.concatenate([np.cross(points - middle, normals), normals], axis=1)
            step = np.linalg.lstsq(rows, -away, rcond=None)[0]
            turn = Rotation.from_rotvec(step[:3]).as_matrix()
            moved = turn @ (placed.position - middle) + middle + step[3:]
            placed = PlacedCamera(placed.camera, placed.axes @ turn.T, moved)
        found.append(replace(frame, placed=placed))
    return found


def residual_m(frames: Sequence[Frame], surface: FusedSurface) -> float:
    """Median distance of a frame's points to the surface, along its normals, metres; the median of all frames that
    have enough of them there.
    """
    from scipy.spatial import KDTree

    tree = KDTree(surface.vertices)
    medians = []
    for frame in frames:
        points, vertices = _matches(_sample(frame), frame.placed, surface, tree)
        away = ((points - surface.vertices[vertices]) * surface.normals[vertices]).sum(axis=1)
        if len(points) >= _LEAST_MATCHES:
            medians.append(np.median(np.abs(away)))
    return float(np.median(medians))


def _volume(frames: Sequence[Frame], voxel_m: float) -> tuple[NDArray[np.float32], NDArray[np.bool_], Floats]:
    """Mean signed distance in units of the truncation, -1 where unknown; where it is known; the first voxel's place."""
    points = [frame.points() for frame in frames]
    low = np.min([np.quantile(each, _OUTSIDE, axis=0) for each in points], axis=0) - _MARGIN_M
    high = np.max([np.quantile(each, 1 - _OUTSIDE, axis=0) for each in points], axis=0) + _MARGIN_M
    shape = tuple(int(side) for side in np.ceil((high - low) / voxel_m) + 1)
    total, count = np.zeros(np.prod(shape), np.float32), np.zeros(np.prod(shape), np.uint16)
    for begin in range(0, len(total), _TILE):
        tile = slice(begin, min(begin + _TILE, len(total)))
        index = np.stack(np.unravel_index(np.arange(tile.start, tile.stop), shape), axis=1)
        places = (low + voxel_m * index).astype(np.float32)
        for frame in frames:
            _add(frame, places, voxel_m * _TRUNCATION, total[tile], count[tile])
    known = count >= _LEAST_FRAMES
    distance = np.where(known, total / np.maximum(count, 1), np.float32(-1))
    distance = np.where(np.abs(distance) < _LEAST_DISTANCE, np.copysign(_LEAST_DISTANCE, distance), distance)
    return distance.reshape(shape), known.reshape(shape), low


def _add(
    frame: Frame,
    places: NDArray[np.float32],
    truncation_m: float,
    total: NDArray[np.float32],
    count: NDArray[np.uint16],
) -> None:
    """Add one frame's signed distances to places [N, 3] of the volume, in place."""
    camera = frame.placed.camera
    local = (places - frame.placed.position.astype(np.float32)) @ frame.placed.axes.T.astype(np.float32)
    ahead = np.maximum(local[:, 2], np.float32(1e-3))
    column = np.floor(local[:, 0] / ahead * np.float32(camera.focal_px) + np.float32(camera.centre_px[0]))
    row = np.floor(local[:, 1] / ahead * np.float32(camera.focal_px) + np.float32(camera.centre_px[1]))
    inside = np.flatnonzero((column >= 0) & (column < camera.columns) & (row >= 0) & (row < camera.rows))
    pixels = row[inside].astype(np.intp) * camera.columns + column[inside].astype(np.intp)
    measured = frame.range_m.ravel()[pixels]
    distance = (measured - ahead[inside]) / np.float32(truncation_m)
    counts = (measured > 0) & (distance > -1)
    total[inside[counts]] += np.minimum(distance[counts], 1)
    count[inside[counts]] += 1


def _sample(frame: Frame) -> tuple[Floats, Floats]:
    """Some of the frame's points, evenly over it, and their normals, both in the camera's frame, [N, 3]."""
    normals = frame.normals()
    usable = np.flatnonzero(np.isfinite(normals).all(axis=1))
    chosen = usable[:: max(1, len(usable) // _PIXELS)]
    return frame.local_points(frame.pixels[chosen]), normals[chosen]


def _matches(
    sample: tuple[Floats, Floats], placed: PlacedCamera, surface: FusedSurface, tree: Any
) -> tuple[Floats, NDArray[np.intp]]:
    """The sample's points [N, 3] as its camera is placed, and their nearest vertices [N], which face the same way."""
    points = sample[0] @ placed.axes + placed.position
    away, vertices = tree.query(points, distance_upper_bound=_NEAR_M)
    near = np.isfinite(away)
    near[near] = ((sample[1][near] @ placed.axes) * surface.normals[vertices[near]]).sum(axis=1) > _FACING
    return points[near], vertices[near]


def _rim(vertices: Floats, faces: NDArray[np.int64]) -> NDArray[np.int64]:
    edges = find_edges(faces)
    ends = edges.ends[edges.faces == 1]
    loop = components(len(vertices), ends)
    height = -vertices[:, 1]
    low = height < height.min() + _RIM * np.ptp(height)
    boundary = np.unique(ends)
    return boundary[np.isin(loop[boundary], loop[boundary[low[boundary]]])]
