"""Repair of raw scans with pymeshlab.

A scan may consist of unconnected triangles, have duplicate, degenerate or inverted faces, and edges that three faces
share. A renderer draws these, but geodesics, normals and the checks of `Mesh` fail or go wrong.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadMesh
from bodyseg_data.meshes.pymeshlab_thread import with_pymeshlab
from bodyseg_data.meshes.topology import check_arrays, face_components

SAME_POINT_M: Final = 1e-6
"""Distance in metres below which vertices are joined: far below a scanner's resolution, above rounding in files."""

_FEATURE: Final = "mesh repair"


def repair(
    name: str, vertices: NDArray[np.float64], faces: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Repair a surface for `Mesh` and geodesics: returns vertices float64 [V, 3], metres, and faces int32 [F, 3].

    name: of the mesh, for messages. vertices: float [V, 3], metres. faces: int [F, 3].
    Steps, in this order: join coincident vertices; remove degenerate and duplicate faces; at edges of more than two
    faces remove the smallest; separate pieces that meet in a single vertex; orient neighbouring faces alike and each
    connected piece outwards; remove vertices that no face uses. Holes are not filled.

    Vertex indices change: landmarks by vertex are invalid afterwards, landmarks by coordinates stay valid.
    Raises BadMesh for a surface that cannot be repaired (no face left, coordinates that are not finite, faces with
    missing vertices, a one-sided surface), MissingLibrary without pymeshlab or the system libraries it loads.
    """
    vertices, faces = _used_part(name, np.asarray(vertices, np.float64), np.asarray(faces))
    vertices, faces = with_pymeshlab(_FEATURE, lambda pymeshlab: _filtered(pymeshlab, name, vertices, faces))
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    clashes = len(edges) - len(np.unique(edges, axis=0))  # neighbours of one orientation cross an edge in opposite ways
    if clashes:
        raise BadMesh(f"mesh {name} cannot be repaired: it has one side only, found {clashes} edges where faces clash")
    return vertices, _outward(vertices, faces)


def _filtered(
    pymeshlab: Any, name: str, vertices: NDArray[np.float64], faces: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """All steps of `repair` but the last orientation, in pymeshlab's thread."""
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertices, faces))
    try:
        meshes.meshing_merge_close_vertices(threshold=pymeshlab.PureValue(SAME_POINT_M))
        meshes.meshing_remove_null_faces()
        meshes.meshing_remove_duplicate_faces()
        if meshes.current_mesh().face_number() == 0:
            raise BadMesh(f"mesh {name} cannot be repaired: no face has an area")
        meshes.meshing_repair_non_manifold_edges(method="Remove Faces")
        meshes.meshing_repair_non_manifold_vertices(vertdispratio=0.0)
        meshes.meshing_re_orient_faces_coherently()
        meshes.meshing_remove_unreferenced_vertices()
    except pymeshlab.PyMeshLabException as error:
        raise BadMesh(f"mesh {name} cannot be repaired: {' '.join(str(error).split())}") from error
    whole = meshes.current_mesh()
    return np.array(whole.vertex_matrix(), np.float64), np.array(whole.face_matrix(), np.int32)


def _used_part(
    name: str, vertices: NDArray[np.float64], faces: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Vertices that faces use, and faces with their new indices, checked, since pymeshlab does not check its input."""
    check_arrays(f"mesh {name}", vertices, faces, check_unused=False)
    used, renumbered = np.unique(faces, return_inverse=True)
    return vertices[used], renumbered.reshape(faces.shape).astype(np.int32)


def _outward(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.int32]:
    """The faces [F, 3], inverted in every connected piece that encloses a negative volume."""
    piece_of_vertex = face_components(len(vertices), faces, _FEATURE)
    count = int(piece_of_vertex.max()) + 1
    piece = piece_of_vertex[faces[:, 0]]
    # Measured about the mean vertex of the piece, so that the sign is right also for one with small holes.
    size = np.bincount(piece_of_vertex, minlength=count)
    middle = np.stack([np.bincount(piece_of_vertex, axis, count) for axis in vertices.T], axis=1) / size[:, None]
    corners = vertices[faces] - middle[piece][:, None]
    volume = np.bincount(piece, np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])), count)
    inside_out = volume[piece] < 0
    turned = faces.copy()
    turned[inside_out] = turned[inside_out][:, ::-1]
    return turned
