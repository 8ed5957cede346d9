"""Ray casting with Intel's Embree; needs no system libraries."""

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.machine import required
from bodyseg_data.meshes import Mesh
from bodyseg_data.rendering.renderer import Outline, Renderer, Surface
from bodyseg_data.rigs import PlacedCamera

_FEATURE = "the embree renderer"
TriangleMesh = required("embreex.mesh_construction", _FEATURE).TriangleMesh
EmbreeScene = required("embreex.rtcore_scene", _FEATURE).EmbreeScene
_MISS_DISTANCE = np.float32(1e37)  # the distance that Embree's binding gives for a ray without a hit


class EmbreeRenderer(Renderer):
    """Renderer of one mesh by ray casting; its Embree tree is built once and serves any number of cameras."""

    def __init__(self, mesh: Mesh) -> None:
        # Single-precision rays are accurate to about 0.3 um at 2.5 m when coordinates are small, so the tree is built
        # around the body's centre. "Robust" traversal never lets a ray slip between two triangles.
        self._origin = mesh.centre
        self._scene = EmbreeScene(robust=True)
        TriangleMesh(self._scene, (mesh.vertices - self._origin).astype(np.float32), mesh.faces)
        self._covered = Outline(mesh).covered

    def render(self, camera: PlacedCamera) -> Surface:
        shape = camera.camera.rows, camera.camera.columns
        depth, face = np.zeros(shape, np.float32), np.full(shape, -1, np.int32)
        pixels = np.flatnonzero(self._covered(camera))
        if len(pixels):
            hits = self._scene.run(*self._rays(camera, pixels), output=True)
            face.ravel()[pixels] = hits["primID"]
            depth.ravel()[pixels] = np.where(hits["primID"] >= 0, hits["tfar"], np.float32(0))
        return Surface(depth, face)

    def ranges(self, camera: PlacedCamera, pixels: NDArray[np.intp]) -> NDArray[np.float32]:
        if not len(pixels):
            return np.zeros(0, np.float32)
        distances: NDArray[np.float32] = self._scene.run(*self._rays(camera, pixels), query="DISTANCE")
        distances[distances >= _MISS_DISTANCE] = 0
        return distances

    def _rays(self, camera: PlacedCamera, pixels: NDArray[np.intp]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Origins and directions of the rays through the centres of pixels, float32 [N, 3] each, body frame.

        Directions are `Camera.pixel_rays`, rotated; z = 1 in the camera's frame, so Embree's ray parameter is the
        range. A rotated ray is the sum of a term of its row and one of its column. The common origin is not copied.
        """
        device = camera.camera
        x, y = device.slopes
        right, down, forward = camera.axes
        rows, columns = np.divmod(pixels, device.columns)
        directions = np.empty((3, len(pixels)), np.float32)
        for axis in range(3):
            directions[axis] = (y * down[axis] + forward[axis]).take(rows) + (x * right[axis]).take(columns)
        origin = (camera.position - self._origin).astype(np.float32)
        return np.broadcast_to(origin, (len(pixels), 3)), directions.T
