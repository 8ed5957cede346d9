"""Renders that exist: readers of folders that other programs wrote, each a layout of its own."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.renders.images import read_array
    from bodyseg_data.renders.layouts import LayoutName, open_renders
    from bodyseg_data.renders.source import ProjectorRanges, Render, RenderSource
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
