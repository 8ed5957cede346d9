"""The paper's rig, and meshes as its devices see them through each renderer."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from shapes import ball

from bodyseg_data.core.errors import MissingLibrary
from bodyseg_data.core.rig import PlacedCamera, load_rig
from bodyseg_data.core.views import View
from bodyseg_data.meshes.mesh import Mesh
from bodyseg_data.rendering import open_renderer
from bodyseg_data.rendering.renderer import Surface

RIG = load_rig()
FRONT = View(255, 0)


def skip_without_opengl() -> None:
    try:
        open_renderer("opengl", ball(subdivisions=0)).close()
    except MissingLibrary as error:
        pytest.skip(str(error))


def see(renderer: str, mesh: Mesh, *cameras: PlacedCamera) -> list[Surface]:
    opened = open_renderer(renderer, mesh)
    try:
        return [opened.render(camera) for camera in cameras]
    finally:
        opened.close()


def body_rays(camera: PlacedCamera) -> NDArray[np.float64]:
    return camera.camera.pixel_rays() @ camera.axes
