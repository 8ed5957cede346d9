"""The plain way to take a view, which the fast one is held against: all rays of both frames, all pixels one way."""

from __future__ import annotations

from typing import Any

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from bodyseg_data.mesh import Mesh
from bodyseg_data.partition import Partition
from bodyseg_data.parts import BACKGROUND
from bodyseg_data.rendering import Surface
from bodyseg_data.rendering.sampling import faces_towards, surface_points
from bodyseg_data.rig import PlacedCamera, Rig
from bodyseg_data.sample import steps
from bodyseg_data.views import View


def cast_whole_frame(mesh: Mesh, camera: PlacedCamera) -> Surface:
    scene: Any = EmbreeScene(robust=True)
    TriangleMesh(scene, (mesh.vertices - mesh.centre).astype(np.float32), mesh.faces)
    device = camera.camera
    y = (np.arange(device.rows) + 0.5 - device.centre_px[1]) / device.focal_px
    x = (np.arange(device.columns) + 0.5 - device.centre_px[0]) / device.focal_px
    right, down, forward = camera.axes
    ways = ((y[:, None] * down + forward)[:, None] + (x[:, None] * right)[None]).astype(np.float32).reshape(-1, 3)
    origins = np.tile((camera.position - mesh.centre).astype(np.float32), (len(ways), 1))
    hits = scene.run(origins, ways, output=True)
    face = hits["primID"].reshape(device.rows, device.columns)
    depth = np.where(face >= 0, hits["tfar"].reshape(face.shape), 0)
    return Surface(depth.astype(np.float32), face)


def take_whole_frames(
    rig: Rig, mesh: Mesh, parts: Partition, view: View
) -> tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray[np.uint8], NDArray[np.bool_]]:
    """Camera range, whole projector range, labels and facing bits."""
    camera, projector = rig.placed(mesh.centre, view)
    seen = cast_whole_frame(mesh, camera)
    rows, columns = np.nonzero(seen.face >= 0)
    faces, points = seen.face[rows, columns], surface_points(seen, camera, rows, columns)
    labels = np.full(seen.face.shape, BACKGROUND, np.uint8)
    labels[rows, columns] = parts.labels_at(mesh, faces, points)
    facing = np.zeros(seen.face.shape, np.bool_)
    facing[rows, columns] = faces_towards(mesh, faces, points, projector.position)
    whole = steps(cast_whole_frame(mesh, projector).range, "projector")
    return steps(seen.range, "camera"), whole, labels, facing
