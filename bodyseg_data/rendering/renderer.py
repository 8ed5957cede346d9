"""Renderers: what every pixel of a camera sees of one mesh.

A renderer is built once for a mesh and asked for many placed cameras. It answers with geometry only; what is made
of it (labels, facing, stored integers) is the same code for every renderer (`sampling.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.meshes.mesh import Mesh
from bodyseg_data.core.rig import PlacedCamera

RendererName = Literal["raster", "embree", "opengl"]


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


def check_renderer(name: str) -> None:
    """Raise BadConfig unless a renderer is called `name`."""
    if name not in get_args(RendererName):
        raise BadConfig(f"the renderer must be one of {', '.join(get_args(RendererName))}, found {name!r}")


def open_renderer(name: str, mesh: Mesh) -> Renderer:
    """The renderer called `name` for `mesh`. Raises BadConfig, or MissingLibrary if it needs what is not installed."""
    check_renderer(name)
    if name == "opengl":
        from bodyseg_data.rendering.opengl import OpenGLRenderer

        return OpenGLRenderer(mesh)
    if name == "embree":
        from bodyseg_data.rendering.embree import EmbreeRenderer

        return EmbreeRenderer(mesh)
    from bodyseg_data.rendering.raster import RasterRenderer

    return RasterRenderer(mesh)
