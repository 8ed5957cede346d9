"""`bench sensors` on plain figures and with a network that labels by position."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benches.model import chosen
from benches.model.networks import sensors as bench
from benches.model.networks.sensors import METHODS, Scene, all_scenes, bench_sensors
from benches.model.networks.sensors_figure import _COLOURS, draw_sensors
from fakes import Figures
from label_networks import Places
from pictures import decoded, marks, part
from shapes import figure

from bodyseg_data.rendering import RasterRenderer
from bodyseg_model.networks import Trained
from bodyseg_model.recordings import frame_camera

KINECT = frame_camera((480, 640), "a Kinect").camera


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Results of the bench for two figures, from behind, in four scenes."""
    scenes = [scene for scene in all_scenes() if (scene.distance_m, scene.turn_deg) in ((2.55, 0), (1.2, 0), (3.5, 24))]
    monkeypatch.setattr(bench, "all_scenes", lambda: scenes[:4])
    monkeypatch.setattr(bench, "AZIMUTHS_DEG", (180,))
    monkeypatch.setattr(bench, "open_source", lambda name: Figures())
    monkeypatch.setattr(chosen, "load_network", lambda path: Trained(Places(0, 20), {}))
    done: list[tuple[int, int]] = []
    answer = bench_sensors(5, (Path("some/run"),), lambda *numbers: done.append(numbers))
    assert done == [(1, 2), (2, 2)], "figures have two bodies to test on"
    return answer


def test_every_scene_is_scored_by_every_method(figures: dict[str, Any], tmp_path: Path) -> None:
    assert (figures["network"], figures["bodies"], figures["azimuths_deg"]) == ("run", 2, [180])
    places = [(scene["sensor"], scene["distance_m"], scene["turn_deg"]) for scene in figures["scenes"]]
    assert places == [("the paper's", 2.55, 0), ("Kinect v1", 1.2, 0), ("Kinect v1", 3.5, 24), ("Kinect v2", 1.2, 0)]
    for scene in figures["scenes"]:
        assert set(scene["accuracy"]) == set(METHODS)
        assert all(0 <= accuracy <= 1 for accuracy in scene["accuracy"].values())
    in_view = [scene["in_view"] for scene in figures["scenes"]]
    assert in_view[0] == in_view[2] == 1 and 0.5 < in_view[1] < 0.95
    draw_sensors(figures, tmp_path / "sensors.png")
    picture = part(decoded(tmp_path / "sensors.png"), down=(0, 0.8))  # without the legend
    near, turned = (
        marks(part(picture, across=half), _COLOURS["as it is"], 8, within=60) for half in ((0, 0.5), (0.5, 1))
    )
    assert len(near) >= 2 and len(turned) >= 1, "two sensors near by, one body aside"


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
