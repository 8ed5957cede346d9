"""The interface of renderers: range and triangle at every pixel of a camera.

A renderer is constructed once for a mesh and renders it for many placed cameras. It gives geometry only; labels,
facing and stored integers are computed from that by the same code for every renderer (`packing/sampler.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.rig import PlacedCamera


@dataclass(frozen=True)
class Surface:
    """The visible surface at each pixel of a camera.

    range: float32 [H, W], metres along the optical axis, 0 where there is no body.
    face: int32 [H, W], index of the visible triangle, -1 where there is no body.
    """

    range: NDArray[np.float32]
    face: NDArray[np.int32]


class Triangles(Protocol):
    """Triangles in a body's frame. vertices: float64 [V, 3], metres. faces: int32 [F, 3], vertex indices."""

    @property
    def vertices(self) -> NDArray[np.float64]: ...

    @property
    def faces(self) -> NDArray[np.int32]: ...


class Renderer(Protocol):
    """Renderer of one mesh. Rays go through pixel centres; no smoothing, no sampling within a pixel."""

    def render(self, camera: PlacedCamera) -> Surface:
        """Render the mesh for `camera`, which must be outside the body."""

    def ranges(self, camera: PlacedCamera, pixels: NDArray[np.intp]) -> NDArray[np.float32]:
        """Ranges that `render` gives at some pixels only, float32 [N], metres.

        pixels: int [N], row * columns + column, ascending.
        """

    def close(self) -> None:
        """Release the renderer's resources. Safe to call twice."""
