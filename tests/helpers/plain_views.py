"""The plain way to take a view, which the fast one is held against: all rays of both frames, all pixels one way."""

from __future__ import annotations

from typing import Any

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray

from bodyseg_data.labels import BACKGROUND
from bodyseg_data.meshes import Mesh, Partition
from bodyseg_data.packing.sampler import faces_towards
from bodyseg_data.rendering import RasterRenderer, Surface
from bodyseg_data.rendering.embree import EmbreeRenderer
from bodyseg_data.rigs import PlacedCamera, Rig
from bodyseg_data.samples import View, steps


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
    faces, points = seen.face[rows, columns], camera.points(seen.range, rows, columns)
    labels = np.full(seen.face.shape, BACKGROUND, np.uint8)
    labels[rows, columns] = parts.labels_at(mesh, faces, points)
    facing = np.zeros(seen.face.shape, np.bool_)
    facing[rows, columns] = faces_towards(mesh, faces, points, projector.position)
    whole = steps(cast_whole_frame(mesh, projector).range, rig.range_step_m, "projector")
    return steps(seen.range, rig.range_step_m, "camera"), whole, labels, facing


def check_rays(mesh: Mesh, camera: PlacedCamera) -> int:
    """How many pixels see the body, once they are known to be the right ones."""
    renderer, whole = EmbreeRenderer(mesh), cast_whole_frame(mesh, camera)
    seen = renderer.render(camera)
    assert (seen.face.dtype, seen.range.dtype) == (np.int32, np.float32)
    np.testing.assert_array_equal(seen.face, whole.face)
    np.testing.assert_array_equal(seen.range, whole.range)
    some = np.flatnonzero(np.random.default_rng(1).random(whole.range.size) < 0.3)
    ranges = renderer.ranges(camera, some)
    assert ranges.dtype == np.float32
    np.testing.assert_array_equal(ranges, whole.range.take(some))
    return int((whole.face >= 0).sum())


def check_filled(mesh: Mesh, camera: PlacedCamera) -> int:
    """How many pixels see the body, once they are known to be those of the rays."""
    filled, cast = RasterRenderer(mesh).render(camera), cast_whole_frame(mesh, camera)
    assert (filled.face.dtype, filled.range.dtype) == (np.int32, np.float32)
    np.testing.assert_array_equal(filled.face >= 0, filled.range > 0)
    body = filled.face >= 0
    assert (body != (cast.face >= 0)).sum() <= 3, "single precision moves a ray by a thousandth of a pixel"
    both = body & (cast.face >= 0)
    assert (filled.face != cast.face)[both].sum() <= 5 + 0.005 * both.sum(), "rays that pass an edge"
    same = both & (filled.face == cast.face)
    if same.any():
        apart = np.abs(filled.range - cast.range)[same]
        assert np.median(apart) < 5e-7 and np.quantile(apart, 0.999) < 2e-5
    return int(body.sum())
