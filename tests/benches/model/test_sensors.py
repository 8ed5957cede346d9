"""`bench sensors` on plain figures and with a network that knows where a pixel is."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from benches.model.networks import sensors as bench
from benches.model.networks.sensors import METHODS, Scene, all_scenes, bench_sensors, label
from benches.model.networks.sensors_figure import draw_sensors
from fakes import Figures
from label_networks import Places
from PIL import Image
from shapes import figure

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.core.rig import load_rig
from bodyseg_data.rendering.raster import RasterRenderer
from bodyseg_model.networks.checkpoints import Trained
from bodyseg_model.segmentation.cameras import frame_camera

KINECT = frame_camera((480, 640), "a Kinect").camera


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """The pictures are many and small."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the bench says about two figures, from two azimuths, in four scenes."""
    scenes = [scene for scene in all_scenes() if (scene.distance_m, scene.turn_deg) in ((2.55, 0), (1.2, 0), (3.5, 24))]
    monkeypatch.setattr(bench, "all_scenes", lambda: scenes[:4])
    monkeypatch.setattr(bench, "AZIMUTHS_DEG", (0, 180))
    monkeypatch.setattr(bench, "open_source", lambda name: Figures())
    monkeypatch.setattr(bench, "load_network", lambda path: Trained(Places(0, 20), {}))
    done: list[tuple[int, int]] = []
    answer = bench_sensors(5, (Path("some/run"),), lambda *numbers: done.append(numbers))
    assert done == [(1, 2), (2, 2)], "figures have two bodies to test on"
    return answer


def test_every_scene_is_scored_by_every_method(figures: dict[str, Any]) -> None:
    assert (figures["network"], figures["bodies"], figures["azimuths_deg"]) == ("run", 2, [0, 180])
    places = [(scene["sensor"], scene["distance_m"], scene["turn_deg"]) for scene in figures["scenes"]]
    assert places == [("the paper's", 2.55, 0), ("Kinect v1", 1.2, 0), ("Kinect v1", 3.5, 24), ("Kinect v2", 1.2, 0)]
    for scene in figures["scenes"]:
        assert set(scene["accuracy"]) == set(METHODS)
        assert all(0 <= accuracy <= 1 for accuracy in scene["accuracy"].values())
    in_view = [scene["in_view"] for scene in figures["scenes"]]
    assert in_view[0] == in_view[2] == 1 and 0.5 < in_view[1] < 0.95


def test_the_figure_shows_it(figures: dict[str, Any], tmp_path: Path) -> None:
    draw_sensors(figures, tmp_path / "sensors.png")
    with Image.open(tmp_path / "sensors.png") as picture:
        assert picture.width > 1000
        colours = np.asarray(picture.convert("RGB")).reshape(-1, 3)
    for colour in ((0x1F, 0x4F, 0xA8), (0xC2, 0x5A, 0x00)):
        assert (colours == colour).all(axis=1).any()


def test_scenes_cover_sensors_distances_and_directions() -> None:
    scenes = all_scenes()
    assert len(scenes) == len(set(scenes))
    assert scenes[0].camera == load_rig().camera
    assert {scene.sensor for scene in scenes[1:]} == {"Kinect v1", "Kinect v2"}


def test_a_camera_looks_past_a_body_to_the_right() -> None:
    mesh = figure()
    across = {}
    for turn in (-20, 0, 20):
        placed = Scene("Kinect v1", KINECT, 3.0, turn).placed(mesh, 70)
        range_m = RasterRenderer(mesh).render(placed).range
        across[turn] = float(np.nonzero(range_m)[1].mean()) - 320
        assert np.linalg.norm(placed.position - mesh.centre) == pytest.approx(3.0)
    assert abs(across[0]) < 10
    assert across[20] == pytest.approx(-525 * np.tan(np.radians(20)), abs=15)
    assert across[-20] == pytest.approx(525 * np.tan(np.radians(20)), abs=15)


def test_methods_differ_in_what_the_network_is_shown() -> None:
    mesh = figure()
    range_m = RasterRenderer(mesh).render(Scene("Kinect v1", KINECT, 3.5, 24).placed(mesh, 0)).range
    shown = {}
    for method in METHODS:
        network = Places(0, 20)
        labels = label(network, range_m, KINECT, method)
        np.testing.assert_array_equal(labels == BACKGROUND, range_m == 0)
        shown[method] = network.seen[0][0, 0].numpy()
    np.testing.assert_array_equal(shown["as it is"], range_m)
    heights = {method: int((image > 0).any(1).sum()) for method, image in shown.items()}
    assert heights["scaled"] > 1.8 * heights["as it is"]
    widths = {method: int((image > 0).any(0).sum()) for method, image in shown.items()}
    assert widths["turned and scaled"] < widths["scaled"], "off the axis, pixels show less of an angle"


@pytest.mark.parametrize("views", [0, -1, 1.5])
def test_there_must_be_a_body(views: Any) -> None:
    with pytest.raises(BadConfig, match="the number of bodies must be a whole number of at least 1"):
        bench_sensors(views)
