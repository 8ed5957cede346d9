"""Renderers: range and triangle at every pixel of a camera."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.rendering.raster import RasterRenderer
    from bodyseg_data.rendering.renderer import Renderer, RendererName, Surface, open_renderer
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
