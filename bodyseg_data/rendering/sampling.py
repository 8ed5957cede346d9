"""From what two cameras see of a labelled body to a stored sample; the same code for every renderer."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies import BodyRef
from bodyseg_data.mesh import Mesh
from bodyseg_data.parts import BACKGROUND
from bodyseg_data.rendering import Renderer, Surface
from bodyseg_data.rig import PlacedCamera, Rig
from bodyseg_data.sample import Sample, SampleInfo, steps
from bodyseg_data.views import View


def sample_key(source: str, body: BodyRef, view: View) -> str:
    """The identity of a sample: it names the body and the view, nothing that depends on how shards are cut."""
    return f"{source}-{body.subject}-{body.mesh}-{view.name}"


def take_sample(
    renderer: Renderer, rig: Rig, mesh: Mesh, labels: NDArray[np.uint8], source: str, body: BodyRef, view: View
) -> Sample:
    """Render one view of `mesh`, whose vertices carry `labels` (uint8 [V]), with `rig`. Raises BadSample."""
    key = sample_key(source, body, view)
    camera, projector = rig.placed(mesh.centre, view)
    seen = renderer.see(camera)
    rows, columns = np.nonzero(seen.face >= 0)
    faces = seen.face[rows, columns]
    points = surface_points(seen, camera, rows, columns)
    label_image = np.full(seen.face.shape, BACKGROUND, np.uint8)
    label_image[rows, columns] = labels_at(mesh, labels, faces, points)
    facing = np.zeros(seen.face.shape, np.bool_)
    facing[rows, columns] = faces_towards(mesh, faces, points, projector.position)
    info = SampleInfo(
        source, body.subset, body.subject, body.mesh, body.pose, view.distance_cm, view.azimuth_deg, body.split
    )
    sample = Sample(key, steps(seen.range, key), steps(renderer.see(projector).range, key), label_image, facing, info)
    sample.check()
    return sample


def surface_points(
    seen: Surface, camera: PlacedCamera, rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> NDArray[np.float64]:
    """The points [N, 3] of the body's frame that the given pixels see."""
    rays = np.ones((len(rows), 3))
    rays[:, 0] = (columns + 0.5 - camera.camera.centre_px[0]) / camera.camera.focal_px
    rays[:, 1] = (rows + 0.5 - camera.camera.centre_px[1]) / camera.camera.focal_px
    return camera.to_body(rays * seen.range[rows, columns, None])


def labels_at(
    mesh: Mesh, labels: NDArray[np.uint8], faces: NDArray[np.int32], points: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Part of each surface point, uint8 [N]: that of the triangle's corner with the largest barycentric weight.

    A triangle between two parts is divided along its middle instead of going whole to one of them, which would
    draw triangle-shaped teeth along every border.
    """
    corners = labels[mesh.faces[faces]]
    chosen = corners[:, 0].copy()
    mixed = np.flatnonzero((corners != corners[:, :1]).any(axis=1))
    weights = barycentric(mesh, faces[mixed], points[mixed])
    chosen[mixed] = corners[mixed, weights.argmax(axis=1)]
    return chosen


def barycentric(mesh: Mesh, faces: NDArray[np.int32], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Barycentric weights [N, 3] of points [N, 3] projected onto the planes of their triangles (Ericson 2005, 3.4)."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[faces]], 1, 0)
    ab, ac, ap = b - a, c - a, points - a
    aa, bb, ab_ac = (np.einsum("ij,ij->i", x, y) for x, y in ((ab, ab), (ac, ac), (ab, ac)))
    p_ab, p_ac = np.einsum("ij,ij->i", ap, ab), np.einsum("ij,ij->i", ap, ac)
    area = aa * bb - ab_ac**2
    area[area == 0] = 1  # a degenerate triangle: any corner is as good
    v, w = (bb * p_ab - ab_ac * p_ac) / area, (aa * p_ac - ab_ac * p_ab) / area
    return np.stack([1 - v - w, v, w], axis=1)


def faces_towards(
    mesh: Mesh, faces: NDArray[np.int32], points: NDArray[np.float64], source: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether the triangles seen at `points` [N, 3] turn their outside to a light at `source` [3], bool [N]."""
    normals = mesh.normals()[faces]
    towards: NDArray[np.bool_] = np.einsum("ij,ij->i", normals, source - points) > 0
    return towards
