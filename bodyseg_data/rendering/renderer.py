"""Renderers: their interface, range and triangle at every pixel of a camera, their registry, and the pixels that a mesh
can cover. A new renderer is a file in this folder and an entry of `RENDERERS`.

A renderer is constructed once for a mesh and renders it for many placed cameras. It gives geometry only; labels,
facing and stored integers are computed from that by the same code for every renderer (`packing/sampler.py`).

Rays are cast through the pixels of a mesh's outline only. Every triangle lies inside the bounding box of its three
corners' pixels. All boxes are filled at once, in blocks of pixels: each adds and subtracts 1 at its four corners, and
two cumulative sums fill it (the inverse of a summed-area table, Crow 1984).
"""

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import check_choice
from bodyseg_data.meshes import Mesh
from bodyseg_data.rigs import PlacedCamera

BLOCK_PX: Final = 2
"""Side of a block. Smaller blocks fit the outline better, larger ones are faster (docs/explanation/renderers.md)."""

_NEAR_PLANE_M: Final = 1e-3

RENDERERS: Final[dict[str, str]] = {
    "raster": "raster.RasterRenderer",
    "embree": "embree.EmbreeRenderer",
    "opengl": "opengl.OpenGLRenderer",
}
"""Name -> "module.Class" in this folder, imported when a renderer of that name is opened."""

if TYPE_CHECKING:
    RendererName = str
else:
    RendererName = Literal[tuple(RENDERERS)]


@dataclass(frozen=True)
class Surface:
    """The visible surface at each pixel of a camera.

    range: float32 [H, W], metres along the optical axis, 0 where there is no body.
    face: int32 [H, W], index of the visible triangle, -1 where there is no body.
    """

    range: NDArray[np.float32]
    face: NDArray[np.int32]


class Renderer(Protocol):
    """Renderer of one mesh. Rays go through pixel centres; no smoothing, no sampling within a pixel."""

    def render(self, camera: PlacedCamera) -> Surface:
        """Render the mesh for `camera`, which must be outside the body."""

    def ranges(self, camera: PlacedCamera, pixels: NDArray[np.intp]) -> NDArray[np.float32]:
        """Ranges that `render` gives at some pixels only, float32 [N], metres.

        pixels: int [N], row * columns + column, ascending. By default all pixels are rendered.
        """
        return self.render(camera).range.take(pixels)

    def close(self) -> None:
        """Release what is not Python's memory: by default there is nothing. Safe to call twice."""
        return


def open_renderer(name: str, mesh: Mesh) -> Renderer:
    """Construct the renderer called `name` for `mesh`. Raises BadConfig, or MissingLibrary without its libraries."""
    module, kind = RENDERERS[check_choice("the renderer", name, RENDERERS)].split(".")
    renderer: Renderer = getattr(import_module(f"{__package__}.{module}"), kind)(mesh)
    return renderer


class Outline:
    """The pixels covered by one mesh, for any camera. block_px: side of a block of pixels."""

    def __init__(self, mesh: Mesh, block_px: int = BLOCK_PX) -> None:
        used, corners = np.unique(mesh.faces, return_inverse=True)
        self._vertices = mesh.vertices[used]
        self._corners = np.ascontiguousarray(corners.reshape(-1, 3).T)
        self._block = block_px

    def covered(self, camera: PlacedCamera) -> NDArray[np.bool_]:
        """Mask of the pixels that the mesh can cover, bool [H, W]; it contains every pixel whose ray hits the mesh."""
        rows, columns = camera.camera.rows, camera.camera.columns
        local = camera.to_local(self._vertices).T
        if local[2].min() < _NEAR_PLANE_M:
            return np.ones((rows, columns), np.bool_)  # beside or behind the camera the projection is unbounded
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

    def _spans(self, coordinate: NDArray[np.float64], size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """First block of every face and the one after its last, [F] each, along an axis of `size` pixels.

        coordinate: of the vertices along that axis, pixels.
        """
        # The ray of pixel p passes p + 0.5. Pixels floor(a - 0.5) to floor(b - 0.5) + 1 include all whose rays hit a
        # span from a to b, with a margin of one pixel at either end for rounding.
        pixel = np.clip(np.floor(coordinate - 0.5), -2, size).astype(np.int16)
        a, b, c = (pixel.take(corner) for corner in self._corners)
        low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
        first = np.maximum(low, 0) // np.int16(self._block)
        last = np.minimum(high + np.int16(1), size - 1) // np.int16(self._block)
        return first.astype(np.intp), last.astype(np.intp) + 1
