"""Renderers alone: the time of a view's two images, and their error against exact rays.

The renderers are those of `bodyseg shard --renderer` and plain pyrender (`plain.py`), in turns in one process.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies import BodyRef
from bodyseg_data.core import MissingLibrary
from bodyseg_data.meshes import Mesh
from bodyseg_data.packing import Packing
from bodyseg_data.rendering import Renderer, open_renderer
from bodyseg_data.rendering.renderer import RENDERERS
from bodyseg_data.rigs import PlacedCamera, Rig
from bodyseg_data.samples import View

PLAIN: Final = "pyrender as it comes"
ROUNDS: Final = 3
_MARGIN_PX: Final = 1e-6
_EDGE: Final = 1e-12  # of a triangle's sides: no ray slips between two


class _ViewRenderer(Protocol):
    def render(self, view: View) -> NDArray[Any]:
        """Draw the camera's and the projector's image; the camera's ranges [H, W], metres."""

    def close(self) -> None: ...


class _Ours:
    def __init__(self, name: str, rig: Rig, mesh: Mesh) -> None:
        self._renderer: Renderer = open_renderer(name, mesh)
        self._rig, self._centre = rig, mesh.centre

    def render(self, view: View) -> NDArray[Any]:
        camera, projector = self._rig.placed(self._centre, view)
        seen = self._renderer.render(camera)
        self._renderer.render(projector)
        return seen.range

    def close(self) -> None:
        self._renderer.close()


class _Plain:
    def __init__(self, rig: Rig, mesh: Mesh) -> None:
        from benches.data.render.plain import PlainScenes

        self._scenes = PlainScenes(rig, mesh, np.zeros(len(mesh.vertices), np.uint8))

    def render(self, view: View) -> NDArray[Any]:
        return self._scenes.ranges(view)[0]

    def close(self) -> None:
        """A body's memory is freed by pyrender when the next one is drawn."""


@dataclass
class _Tally:
    """One renderer's sums over all bodies. apart: differences of ranges, mm. outline: pixels that only one sees."""

    seconds: float = 0.0
    apart: list[NDArray[np.float64]] = field(default_factory=list)
    outline: int = 0


def measure_renderers(
    packing: Packing, refs: Sequence[BodyRef], views: Sequence[View], checked: Sequence[View]
) -> dict[str, Any]:
    """Each way's figures by its name under "renderers", and one line under "renderers_missing" for each that is not
    installed. views: all that one body is rendered from. checked: those of which errors are counted.

    ms_per_view: of the processor, for the camera's and the projector's image, with what is made once a body; the median
    of three rounds, mean over bodies. range_error_mm, worst_mm: median and largest difference of the camera's ranges
    from `true_range` where both see the body. silhouette_error: share of the body's pixels that only one of them sees.
    """
    openers: dict[str, Callable[[Rig, Mesh], _ViewRenderer]] = {name: partial(_Ours, name) for name in RENDERERS} | {
        PLAIN: _Plain
    }
    tallies: dict[str, _Tally] = {}
    missing: dict[str, str] = {}
    seen = 0
    for ref in refs:
        mesh = packing.opened().build(ref).mesh
        wanted = [true_range(mesh, packing.rig.placed(mesh.centre, view)[0]) for view in checked]
        seen += sum(int((image > 0).sum()) for image in wanted)
        rounds: dict[str, list[float]] = {}
        for turn in range(ROUNDS):
            for name in [name for name in openers if name not in missing]:
                # A copy, so that what a mesh works out once is worked out, and counted, for every way.
                copy = Mesh(mesh.name, mesh.vertices, mesh.faces)
                try:
                    start = time.process_time()
                    renderer = openers[name](packing.rig, copy)
                except MissingLibrary as error:
                    missing[name] = str(error)
                    continue
                for view in views:
                    renderer.render(view)
                rounds.setdefault(name, []).append(time.process_time() - start)
                if turn == 0:
                    _compare(tallies.setdefault(name, _Tally()), [renderer.render(view) for view in checked], wanted)
                renderer.close()
        for name, seconds in rounds.items():
            tallies[name].seconds += statistics.median(seconds)
    renderers = {}
    for name, tally in tallies.items():
        apart = np.concatenate(tally.apart)
        renderers[name] = {
            "ms_per_view": round(1e3 * tally.seconds / (len(refs) * len(views)), 3),
            "range_error_mm": round(float(np.median(apart)), 6),
            "worst_mm": round(float(apart.max()), 4),
            "silhouette_error": round(tally.outline / seen, 6),
        }
    return {"renderers": renderers, "renderers_missing": missing, "default_renderer": packing.renderer}


def _compare(tally: _Tally, images: Sequence[NDArray[Any]], wanted: Sequence[NDArray[np.float64]]) -> None:
    for image, true_m in zip(images, wanted, strict=True):
        both = (image > 0) & (true_m > 0)
        tally.apart.append(np.abs(image[both] - true_m[both]) * 1e3)
        tally.outline += int(((image > 0) != (true_m > 0)).sum())


def true_range(mesh: Mesh, placed: PlacedCamera) -> NDArray[np.float64]:
    """Range of the nearest triangle through each pixel's centre, float64 [H, W], metres, 0 where there is none.

    For a mesh wholly in front of the camera. Each triangle is tested with the rays of all pixels in the box around it
    (T. Möller and B. Trumbore, Fast, minimum storage ray/triangle intersection, 1997), in double precision: slower
    than any renderer, and with nothing in common with one.
    """
    device = placed.camera
    corners = placed.to_local(mesh.vertices)[mesh.faces]
    pixels = placed.project(mesh.vertices)[0][mesh.faces] - 0.5  # where pixel centres are whole numbers
    size = np.array([device.columns, device.rows])
    first = np.clip(np.ceil(pixels.min(axis=1) - _MARGIN_PX), 0, size).astype(np.intp)
    spans = np.clip(np.floor(pixels.max(axis=1) + _MARGIN_PX) + 1, 0, size).astype(np.intp) - first
    counts = spans.clip(0).prod(axis=1)
    face = np.repeat(np.arange(len(counts)), counts)
    inside = np.arange(len(face)) - np.repeat(counts.cumsum() - counts, counts)
    rows, columns = np.divmod(inside, spans[face, 0])
    columns, rows = columns + first[face, 0], rows + first[face, 1]
    ways = np.ones((len(face), 3))
    ways[:, 0] = (columns + 0.5 - device.centre_px[0]) / device.focal_px
    ways[:, 1] = (rows + 0.5 - device.centre_px[1]) / device.focal_px
    a, b, c = corners[face].transpose(1, 0, 2)
    one, two = b - a, c - a
    across, along = np.cross(ways, two), np.cross(-a, one)
    with np.errstate(divide="ignore", invalid="ignore"):  # a triangle seen from its edge is met by no ray
        scale = 1 / np.einsum("ij,ij->i", one, across)
        u, v = -np.einsum("ij,ij->i", a, across) * scale, np.einsum("ij,ij->i", ways, along) * scale
        away = np.einsum("ij,ij->i", two, along) * scale
        met = (np.minimum(u, v) >= -_EDGE) & (u + v <= 1 + _EDGE) & (away > 0)
    image = np.full(device.rows * device.columns, np.inf)
    np.minimum.at(image, (rows * device.columns + columns)[met], away[met])
    image[np.isinf(image)] = 0
    return image.reshape(device.rows, device.columns)
