"""Ray casting with Intel's Embree: the default renderer; needs nothing from the system."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.errors import MissingLibrary
from bodyseg_data.mesh import Mesh
from bodyseg_data.rendering import Surface
from bodyseg_data.rig import PlacedCamera

try:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene
except ImportError as error:
    raise MissingLibrary(
        f"the embree renderer needs the package 'embreex': pip install 'bodyseg[render]' ({error})"
    ) from error

_NEAR_PLANE_M = 1e-3


class EmbreeRenderer:
    """One mesh in an Embree tree, built once and asked for any number of cameras."""

    def __init__(self, mesh: Mesh) -> None:
        # Single-precision rays are accurate to about 0.3 um at 2.5 m when coordinates are small, so the tree is built
        # around the body's centre. "Robust" traversal never lets a ray slip between two triangles.
        self._origin = mesh.centre
        self._scene = EmbreeScene(robust=True)
        TriangleMesh(self._scene, (mesh.vertices - self._origin).astype(np.float32), mesh.faces)
        self._used = mesh.surface_vertices

    def see(self, camera: PlacedCamera) -> Surface:
        rows, columns = camera.camera.rows, camera.camera.columns
        depth = np.zeros((rows, columns), np.float32)
        face = np.full((rows, columns), -1, np.int32)
        window = self._window(camera)
        ways = _ways(camera, window)
        if ways.size:
            hits = self._cast(camera, ways.reshape(-1, 3))
            seen = hits["primID"].reshape(ways.shape[:2])
            face[window] = seen
            depth[window] = np.where(seen >= 0, hits["tfar"].reshape(ways.shape[:2]), np.float32(0))
        return Surface(depth, face)

    def lit(self, points: NDArray[np.float64], source: NDArray[np.float64], gap_m: float = 1e-4) -> NDArray[np.bool_]:
        """Exact shadow rays: which of `points` [N, 3] a light at `source` [3] reaches, bool [N].

        A point counts as lit if nothing crosses the segment from the source up to `gap_m` metres before the point;
        the gap keeps a point from being shaded by the very triangle it lies on.
        """
        if not len(points):
            return np.zeros(0, np.bool_)
        ways = points - source
        origins = np.broadcast_to((source - self._origin).astype(np.float32), ways.shape)
        reach = 1 - gap_m / np.linalg.norm(ways, axis=1)
        answer = self._scene.run(
            np.ascontiguousarray(origins), ways.astype(np.float32), dists=reach.astype(np.float32), query="OCCLUDED"
        )
        lit: NDArray[np.bool_] = answer < 0  # Embree's binding answers 0 for blocked, -1 for free
        return lit

    def close(self) -> None:
        """Nothing is held outside Python's own memory."""

    def _cast(self, camera: PlacedCamera, ways: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        origins = np.broadcast_to((camera.position - self._origin).astype(np.float32), ways.shape)
        hits: dict[str, NDArray[np.float32]] = self._scene.run(np.ascontiguousarray(origins), ways, output=True)
        return hits

    def _window(self, camera: PlacedCamera) -> tuple[slice, slice]:
        """Rows and columns outside which no ray can meet the body: rays are cast only where the body can be."""
        everything = (slice(0, camera.camera.rows), slice(0, camera.camera.columns))
        if (camera.to_local(self._used)[:, 2] < _NEAR_PLANE_M).any():
            return everything  # a body beside or behind the camera has no bounded outline
        pixels, _ = camera.project(self._used)
        low = np.floor(pixels.min(axis=0)).astype(int) - 1
        high = np.ceil(pixels.max(axis=0)).astype(int) + 1
        return (
            slice(int(np.clip(low[1], 0, camera.camera.rows)), int(np.clip(high[1], 0, camera.camera.rows))),
            slice(int(np.clip(low[0], 0, camera.camera.columns)), int(np.clip(high[0], 0, camera.camera.columns))),
        )


def _ways(camera: PlacedCamera, window: tuple[slice, slice]) -> NDArray[np.float32]:
    """Directions through the pixel centres of a window, float32 [h, w, 3], body frame.

    They are `Camera.pixel_rays`, turned; z = 1 in the camera's frame, so Embree's ray parameter is the range itself.
    Written out, because a matrix product this tall is spread over all cores, where workers then wait for each other.
    """
    device, (rows, columns) = camera.camera, window
    y = (np.arange(rows.start, rows.stop) + 0.5 - device.centre_px[1]) / device.focal_px
    x = (np.arange(columns.start, columns.stop) + 0.5 - device.centre_px[0]) / device.focal_px
    right, down, forward = camera.axes
    ways: NDArray[np.float64] = (y[:, None] * down + forward)[:, None] + (x[:, None] * right)[None]
    return ways.astype(np.float32)
