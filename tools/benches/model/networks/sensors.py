"""`bench sensors`: accuracy of a network on frames of other cameras, by how the frames are resampled before.

Bodies of the open set's test split are drawn as each camera would see them, with nothing round them and no artifact:
what is measured is geometry alone. docs/results/segment.md has the results.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from benches.measuring import evenly_spaced
from benches.model.chosen import chosen_network
from bodyseg_data.bodies import open_source
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.meshes import Mesh, Partition
from bodyseg_data.rendering import Renderer, open_renderer
from bodyseg_data.rigs import Camera, PlacedCamera, axes_at, load_rig
from bodyseg_model.evaluation import ConfusionMatrix
from bodyseg_model.networks import Trained, predict
from bodyseg_model.recordings import other_sensors
from bodyseg_model.segmentation import view_body

Method = Literal["as it is", "scaled", "turned and scaled"]
METHODS: Final[tuple[Method, ...]] = get_args(Method)

KNOWN: Final = "the paper's"
KNOWN_AT_M: Final = 2.55  # one of the three distances of training
DISTANCES_M: Final = (1.2, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5)
DIRECTIONS_DEG: Final = (-24, -16, -8, 8, 16, 24)
ASIDE_AT_M: Final = 3.5  # from nearer, arms would be out of view at 24 degrees
AZIMUTHS_DEG: Final = (0, 50, 110, 180, 220, 300)

Image = NDArray[np.float32]
Labels = NDArray[np.uint8]


@dataclass(frozen=True)
class Scene:
    """A camera that stands at some distance from a body's middle and looks past it to the right, by `turn_deg`."""

    sensor: str
    camera: Camera
    distance_m: float
    turn_deg: int = 0

    def placed(self, mesh: Mesh, azimuth_deg: int) -> PlacedCamera:
        """The camera where a body is seen from an azimuth."""
        axes = axes_at(azimuth_deg - self.turn_deg)
        return PlacedCamera(self.camera, axes, mesh.centre - self.distance_m * axes_at(azimuth_deg)[2])


def all_scenes() -> list[Scene]:
    """The known camera as it is known; the others at all distances, and past a body in all directions."""
    scenes = [Scene(KNOWN, load_rig().camera, KNOWN_AT_M)]
    for sensor in other_sensors():
        scenes += [Scene(sensor.title, sensor.camera, distance) for distance in DISTANCES_M]
        scenes += [Scene(sensor.title, sensor.camera, ASIDE_AT_M, turn) for turn in DIRECTIONS_DEG]
    return scenes


def bench_sensors(
    views: int = 12,
    runs: Sequence[Path] = (),
    progress: ProgressCallback = silent,
) -> dict[str, Any]:
    """Average per-class accuracy in each scene by every one of `METHODS`.

    views: bodies, each seen from all of `AZIMUTHS_DEG`. runs: the network is in the first of them; without, it
    is the one that ships. in_view: the share of the bodies' vertices that the frames hold, hidden ones counted. Raises
    BadConfig for no network, MissingLibrary without Anny.
    """
    network_name, trained = chosen_network(runs)
    scenes = all_scenes()
    tallies = [{method: ConfusionMatrix() for method in METHODS} for _ in scenes]
    in_view: list[list[float]] = [[] for _ in scenes]
    source = open_source("open")
    bodies = evenly_spaced([body for body in source.bodies() if body.split == "test"], views)
    for done, body in enumerate(bodies, start=1):
        built = source.build(body)
        parts, renderer = built.partition(), open_renderer("raster", built.mesh)
        for scene, tally, shares in zip(scenes, tallies, in_view, strict=True):
            for azimuth in AZIMUTHS_DEG:
                placed = scene.placed(built.mesh, azimuth)
                range_m, truth = _see(renderer, built.mesh, parts, placed)
                shares.append(_share_in_view(built.mesh, placed))
                for method in METHODS:
                    tally[method].add(truth, label(trained, range_m, scene.camera, method))
        renderer.close()
        progress(done, len(bodies))
    return {
        "network": network_name,
        "bodies": len(bodies),
        "azimuths_deg": list(AZIMUTHS_DEG),
        "scenes": [
            {
                "sensor": scene.sensor,
                "distance_m": scene.distance_m,
                "turn_deg": scene.turn_deg,
                "in_view": round(float(np.mean(shares)), 4),
                "accuracy": {method: round(matrix.average_per_class_accuracy(), 4) for method, matrix in tally.items()},
            }
            for scene, tally, shares in zip(scenes, tallies, in_view, strict=True)
        ],
    }


def label(trained: Trained, range_m: Image, camera: Camera, method: Method) -> Labels:
    """Labels [H, W] of a frame of one body without background, [H, W], metres."""
    network = trained.network
    if method == "as it is":
        return predict(network, torch.from_numpy(range_m)[None, None]).labels[0].numpy()
    pixels = np.flatnonzero(range_m)
    view = view_body(range_m, pixels, camera, trained.rig, turn_rad=0.0 if method == "scaled" else None)
    labels = np.full(range_m.shape, BACKGROUND, np.uint8)
    labels.ravel()[pixels] = view.back(predict(network, torch.from_numpy(view.range_m)[None, None]).labels[0].numpy())
    return labels


def _see(renderer: Renderer, mesh: Mesh, parts: Partition, placed: PlacedCamera) -> tuple[Image, Labels]:
    """Range image of a body by a camera, metres, and the labels of its parts."""
    seen = renderer.render(placed)
    rows, columns = np.nonzero(seen.face >= 0)
    truth = np.full(seen.face.shape, BACKGROUND, np.uint8)
    truth[rows, columns] = parts.labels_at(mesh, seen.face[rows, columns], placed.points(seen.range, rows, columns))
    return seen.range, truth


def _share_in_view(mesh: Mesh, placed: PlacedCamera) -> float:
    """The share of a mesh's vertices inside the frame."""
    points, _ = placed.project(mesh.vertices)
    return float(((points >= 0) & (points < (placed.camera.columns, placed.camera.rows))).all(axis=1).mean())
