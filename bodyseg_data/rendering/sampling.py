"""From what two cameras see of a labelled body to a stored sample; the same code for every renderer."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies import BodyRef
from bodyseg_data.mesh import Mesh
from bodyseg_data.partition import Partition
from bodyseg_data.parts import BACKGROUND
from bodyseg_data.rendering import Renderer, Surface
from bodyseg_data.rig import PlacedCamera, Rig
from bodyseg_data.sample import Sample, SampleInfo, steps
from bodyseg_data.views import View


def sample_key(source: str, body: BodyRef, view: View) -> str:
    """The identity of a sample: it names the body and the view, nothing that depends on how shards are cut."""
    return f"{source}-{body.subject}-{body.mesh}-{view.name}"


def take_sample(
    renderer: Renderer, rig: Rig, mesh: Mesh, parts: Partition, source: str, body: BodyRef, view: View
) -> Sample:
    """Render one view of `mesh`, divided into `parts`, with `rig`. Raises BadSample."""
    key = sample_key(source, body, view)
    camera, projector = rig.placed(mesh.centre, view)
    seen = renderer.see(camera)
    rows, columns = np.nonzero(seen.face >= 0)
    faces = seen.face[rows, columns]
    points = surface_points(seen, camera, rows, columns)
    label_image = np.full(seen.face.shape, BACKGROUND, np.uint8)
    label_image[rows, columns] = parts.labels_at(mesh, faces, points)
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


def faces_towards(
    mesh: Mesh, faces: NDArray[np.int32], points: NDArray[np.float64], source: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether the triangles seen at `points` [N, 3] turn their outside to a light at `source` [3], bool [N]."""
    normals = mesh.normals[faces]
    towards: NDArray[np.bool_] = np.einsum("ij,ij->i", normals, source - points) > 0
    return towards
