"""Renderers and their registry: a new one is a file in this folder and an entry of `RENDERERS`."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Final, Literal

from bodyseg_data.core import BadConfig
from bodyseg_data.meshes import Mesh
from bodyseg_data.rendering.renderer import Renderer

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


def check_renderer(name: str) -> None:
    """Raise BadConfig unless a renderer is called `name`."""
    if name not in RENDERERS:
        raise BadConfig(f"the renderer must be one of {', '.join(RENDERERS)}, found {name!r}")


def open_renderer(name: str, mesh: Mesh) -> Renderer:
    """Construct the renderer called `name` for `mesh`. Raises BadConfig, or MissingLibrary without its libraries."""
    check_renderer(name)
    module, kind = RENDERERS[name].split(".")
    renderer: Renderer = getattr(import_module(f"{__package__}.{module}"), kind)(mesh)
    return renderer
