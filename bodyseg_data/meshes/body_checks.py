"""Checks of meshes that people bring as bodies: faults that no rule of meshes finds, but landmarks do.

Programs with left-handed axes write meshes that are mirrored, with landmarks that are, too: such a body looks whole,
but its front and back, or right and left, are exchanged. Scans often hold the floor under the feet, or somebody else.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadMesh
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.meshes.mending import welded
from bodyseg_data.meshes.mesh import Floats, face_components, face_normals

_TRUNK_M: Final = 0.5  # from the PSIS to the Cervicale; the lengths below are for such a trunk, and grow with it
_LEAST_TRUNK_M: Final = 0.1
_PLATE_M: Final = 0.3  # least width of a plate
_THIN: Final = 0.1  # largest thickness of a plate, as a share of its width
_THICK: Final = 0.25  # the same of a platform under the feet
_NEAR_FEET_M: Final = 0.1
_APART_M: Final = 0.5  # most of what people wear is nearer to the body, wide skirts included
_LEVEL: Final = 0.94  # vertical part of a floor's normal
_AWAY_M: Final = 0.2  # little of a body's underside is as far from all landmarks, whatever its posture
_FLOOR_M2: Final = 0.13


def check_body(vertices: Floats, faces: NDArray[np.integer[Any]], landmarks: Floats, where: str) -> None:
    """Raise BadMesh, naming `where`, for a mirrored body, or one that is not alone in its mesh.

    vertices: [V, 3]; faces: [F, 3]; landmarks: [33, 3]; metres, body frame.
    """
    points = dict(zip(LANDMARKS, landmarks, strict=True))
    pelvis = _middle(points, "Rt. PSIS", "Lt. PSIS")
    up = points["Cervicale"] - pelvis
    size = float(np.linalg.norm(up)) / _TRUNK_M
    if size * _TRUNK_M < _LEAST_TRUNK_M:
        raise BadMesh(f"{where}: a trunk is {_LEAST_TRUNK_M} m long at least, found {size * _TRUNK_M:.3f}")
    chest = _middle(points, "Suprasternale", "Substernale") - _middle(points, "Cervicale", "10th Rib Midspine")
    belly = _middle(points, "Rt. ASIS", "Lt. ASIS") - pelvis
    handed = _handed(points, ("Acromion", "Axilla, Post."), up, chest)
    if handed + _handed(points, ("ASIS", "PSIS", "Trochanterion"), up, belly) < 0:
        raise BadMesh(
            f"{where}: with the trunk upright and the left side on the left, chest and belly must be in front, found "
            "them behind: the mesh is mirrored, as from a program with left-handed axes (or right and left landmarks "
            "are exchanged): negate one axis"
        )
    _check_alone(vertices, faces, landmarks, size, where)


def _handed(points: dict[str, Floats], pairs: tuple[str, ...], up: Floats, front: Floats) -> float:
    """Cosine of the angle of left x up to the front: below 0 if mirrored. left: from the right of pairs to the left."""
    left = np.sum([points[f"Lt. {name}"] - points[f"Rt. {name}"] for name in pairs], axis=0)
    lengths = float(np.linalg.norm(left) * np.linalg.norm(up) * np.linalg.norm(front))
    return float(np.cross(left, up) @ front) / max(lengths, 1e-12)


def _middle(points: dict[str, Floats], *names: str) -> Floats:
    return np.asarray(np.mean([points[name] for name in names], axis=0))


def _check_alone(vertices: Floats, faces: NDArray[np.integer[Any]], landmarks: Floats, size: float, where: str) -> None:
    """Raise BadMesh for a piece without a landmark, flat or apart, or a level surface away from all at the bottom."""
    from scipy.spatial import KDTree

    used, corners = np.unique(faces, return_inverse=True)  # vertices without faces may lie anywhere
    kept, place = welded(vertices[used])
    points, corners = vertices[used][kept], place[corners].reshape(-1, 3)
    piece = face_components(len(points), corners)
    own = np.unique(piece[KDTree(points).query(landmarks)[1]])
    body = points[np.isin(piece, own)]
    bottom, near = float(body[:, 1].min()), KDTree(body)
    body_width = float(np.sort(np.ptp(landmarks, axis=0))[1])
    order = np.argsort(piece, kind="stable")
    for other in np.split(order, np.flatnonzero(np.diff(piece[order])) + 1):  # scans may have thousands
        plate = points[other]
        if len(other) < 3 or np.sort(np.ptp(plate, axis=0))[1] < _PLATE_M * size or piece[other[0]] in own:
            continue
        axes = np.linalg.svd(plate - plate.mean(axis=0), full_matrices=False)[2]
        long, wide, thin = np.ptp(plate @ axes.T, axis=0).tolist()
        under = np.median(plate[:, 1]) < bottom + _NEAR_FEET_M * size and abs(axes[2, 1]) > _LEVEL
        if thin < (_THICK if under else _THIN) * wide and wide > (_PLATE_M * size if under else body_width):
            kind, out = "flat piece", f"{' under it' if under else ''}: take the floor, plate or wall out"
        elif np.quantile(near.query(plate)[0], 0.9) > _APART_M * size:
            kind, out = "piece", " and apart from it: take the other person or thing out"
        else:
            continue
        size_m = f"{long:.2g} x {wide:.2g} m"
        raise BadMesh(f"{where}: a body must be alone in its mesh, found a {kind} of {size_m} without a landmark{out}")
    normals = face_normals(points, corners)
    double_area = np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    level = (np.abs(normals[:, 1]) > _LEVEL * double_area) & np.isin(piece[corners[:, 0]], own)
    low = points[corners, 1].max(axis=1) < points[:, 1].min() + _NEAR_FEET_M * size
    away = KDTree(landmarks).query(points)[0][corners].max(axis=1) > _AWAY_M * size
    floor_m2 = float(double_area[level & low & away].sum()) / 2
    if floor_m2 > _FLOOR_M2 * size**2:
        raise BadMesh(
            f"{where}: a body must be alone in its mesh, found {floor_m2:.2g} m2 of level surface at its bottom, away "
            "from all landmarks: take the floor or plate out"
        )
