"""The baseline that makes a labelled set: plain pyrender, three full frames a view, a PNG file an image.

The bodies, views and parts are those of a packing. Camera range and projector range are depth passes; the labels are a
pass of flat colours, one a triangle. Files are 16-bit PNGs in the rig's steps and 8-bit PNGs of labels.
"""

from __future__ import annotations

from functools import lru_cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from bodyseg_data.bodies import BodyRef
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.meshes import Mesh
from bodyseg_data.packing import Packing
from bodyseg_data.packing.sampler import sample_key
from bodyseg_data.rigs import PlacedCamera, Rig
from bodyseg_data.samples import View, steps

import_module("bodyseg_data.rendering.opengl")  # lets pyrender draw without a display, or says what is absent
pyrender: Any = import_module("pyrender")


def plain_run(packing: Packing, body: BodyRef, views: tuple[View, ...], folder: Path) -> int:
    """Render all views of one body into files, in whichever process; how many bytes they have."""
    source = packing.opened()
    built = source.build(body)
    scenes = PlainScenes(packing.rig, built.mesh, built.partition().labels)
    size = 0
    for view in views:
        key = sample_key(source.name, body, view)
        for name, image in scenes.take(view).items():
            path = folder / f"{key}.{name}.png"
            Image.fromarray(image).save(path)
            size += path.stat().st_size
    return size


class PlainScenes:
    """One body for pyrender. labels: uint8 [V], parts of vertices."""

    def __init__(self, rig: Rig, mesh: Mesh, labels: NDArray[np.uint8]) -> None:
        self._rig, self._mesh = rig, mesh
        corners = mesh.vertices[mesh.faces].reshape(-1, 3)
        grey = labels[mesh.faces[:, 0]].repeat(3).astype(np.float32) / 255
        colours = np.stack([grey, grey, grey, np.ones_like(grey)], axis=1)
        self._scene = pyrender.Scene(bg_color=(1.0, 1.0, 1.0, 1.0))
        self._scene.add(pyrender.Mesh([pyrender.Primitive(positions=corners, color_0=colours)]))
        self._eye = self._scene.add(pyrender.PerspectiveCamera(1.0))
        self._canvas = _canvas(rig.camera.columns, rig.camera.rows)

    def take(self, view: View) -> dict[str, NDArray[Any]]:
        """Camera range and projector range, uint16, in steps; labels, uint8."""
        seen, lit = self.ranges(view)
        flags = pyrender.RenderFlags
        colour, _ = self._draw(self._rig.placed(self._mesh.centre, view)[0], flags.FLAT | flags.SKIP_CULL_FACES)
        labels = np.where(seen > 0, colour[..., 0], BACKGROUND).astype(np.uint8)
        step_m = self._rig.range_step_m
        ranges = {name: steps(seen_m, step_m, name) for name, seen_m in (("range", seen), ("projector", lit))}
        return {**ranges, "labels": labels}

    def ranges(self, view: View) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Camera range and projector range, float32 [H, W], metres, 0 where there is no body."""
        camera, projector = self._rig.placed(self._mesh.centre, view)
        seen, lit = (self._draw(device, pyrender.RenderFlags.DEPTH_ONLY) for device in (camera, projector))
        return seen, lit

    def _draw(self, placed: PlacedCamera, flags: int) -> Any:
        device = placed.camera
        pose = np.eye(4)
        pose[:3, :3] = (placed.axes * [[1], [-1], [-1]]).T  # OpenGL's cameras have y up and look along -z
        pose[:3, 3] = placed.position
        self._eye.camera = pyrender.IntrinsicsCamera(
            device.focal_px, device.focal_px, *device.centre_px, znear=0.5, zfar=6.0
        )
        self._scene.set_pose(self._eye, pose)
        self._canvas.viewport_width, self._canvas.viewport_height = device.columns, device.rows
        return self._canvas.render(self._scene, flags)


@lru_cache(maxsize=1)
def _canvas(columns: int, rows: int) -> Any:
    """A process opens OpenGL once; pyrender frees a body's memory when the next one is drawn."""
    return pyrender.OffscreenRenderer(columns, rows)
