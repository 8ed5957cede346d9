"""Renderers: what every pixel of a camera sees of one mesh.

A renderer is built once for a mesh and asked for many placed cameras. It answers with geometry only; what is made
of it (labels, facing, stored integers) is the same code for every renderer (`sampling.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.rig import PlacedCamera


@dataclass(frozen=True)
class Surface:
    """What a camera sees, pixel by pixel.

    range: float32 [H, W], metres along the optical axis, 0 where there is no body.
    face: int32 [H, W], index of the triangle seen, -1 where there is no body.
    """

    range: NDArray[np.float32]
    face: NDArray[np.int32]


class Renderer(Protocol):
    """Draws one mesh. Rays go through pixel centres; no smoothing, no sampling within a pixel."""

    def see(self, camera: PlacedCamera) -> Surface:
        """What `camera` sees of the mesh. The camera must stand outside the body."""

    def ranges(self, camera: PlacedCamera, pixels: NDArray[np.intp]) -> NDArray[np.float32]:
        """The range that `see` gives at some pixels only, float32 [N], metres.

        pixels: [N], row * columns + column, ascending.
        """

    def close(self) -> None:
        """Give back whatever the renderer holds. Safe to call twice."""
