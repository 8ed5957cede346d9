"""Which pixels of a camera a mesh can cover: rays are cast nowhere else.

Every triangle lies inside the box around its three corners' pixels. The boxes are marked all at once, in blocks of
pixels: each adds and takes away at its four corners only, and two running sums fill it (a summed-area table, Crow 1984,
backwards).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.rig import PlacedCamera
from bodyseg_data.meshes.mesh import Mesh

BLOCK_PX: Final = 2
"""Side of a block. Smaller ones fit the outline more closely, larger ones are marked faster (docs/renderers.md)."""

_NEAR_PLANE_M: Final = 1e-3


class Outline:
    """The outline of one mesh from anywhere."""

    def __init__(self, mesh: Mesh, block_px: int = BLOCK_PX) -> None:
        used, corners = np.unique(mesh.faces, return_inverse=True)
        self._vertices = mesh.vertices[used]
        self._corners = np.ascontiguousarray(corners.reshape(-1, 3).T)
        self._block = block_px

    def covered(self, camera: PlacedCamera) -> NDArray[np.bool_]:
        """Every pixel whose ray can meet the mesh, and few others, bool [H, W]."""
        rows, columns = camera.camera.rows, camera.camera.columns
        local = camera.to_local(self._vertices).T
        if local[2].min() < _NEAR_PLANE_M:
            return np.ones((rows, columns), np.bool_)  # a body beside or behind the camera has no bounded outline
        scale = camera.camera.focal_px / local[2]
        x, y = (local[axis] * scale + camera.camera.centre_px[axis] for axis in (0, 1))
        (left, right), (top, bottom) = self._spans(x, columns), self._spans(y, rows)
        height, width = -(-rows // self._block), -(-columns // self._block)
        stride, size = width + 1, (height + 1) * (width + 1)
        top, bottom = top * stride, bottom * stride
        change = np.bincount(np.concatenate([top + left, bottom + right]), minlength=size)
        change -= np.bincount(np.concatenate([top + right, bottom + left]), minlength=size)
        boxes = change.reshape(height + 1, stride)[:-1, :-1].cumsum(axis=0).cumsum(axis=1) > 0
        return boxes.repeat(self._block, axis=0).repeat(self._block, axis=1)[:rows, :columns]

    def _spans(self, place: NDArray[np.float64], size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """For every face its first block and the one after its last along an axis of `size` pixels, [F] each."""
        # Pixel p is seen through p + 0.5. From floor(a - 0.5) to floor(b - 0.5) + 1 are all that a span from a to b can
        # meet, with a whole pixel to spare at either end for rays that rounding has moved.
        pixel = np.clip(np.floor(place - 0.5), -2, size).astype(np.int16)
        a, b, c = (pixel.take(corner) for corner in self._corners)
        low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
        first = np.maximum(low, 0) // np.int16(self._block)
        last = np.minimum(high + np.int16(1), size - 1) // np.int16(self._block)
        return first.astype(np.intp), last.astype(np.intp) + 1
