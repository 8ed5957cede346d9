"""The paper's rig, and meshes as its devices see them through each renderer."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from shapes import ball

from bodyseg_data.core import MissingLibrary
from bodyseg_data.meshes import Mesh
from bodyseg_data.rendering import Surface, open_renderer
from bodyseg_data.rigs import PlacedCamera, load_rig
from bodyseg_data.samples import View

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
