"""`bench sensor_fit` on a plain figure and a few cases."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from benches.model.sensor_fit import bench
from benches.model.sensor_fit.bench import all_cases, bench_sensor_fit, summarise
from benches.model.sensor_fit.figure import draw_sensor_fit
from benches.model.sensor_fit.recordings import Scene
from fakes import Figures
from pictures import decoded, marks

from bodyseg_data.rigs import load_rig


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Results for one figure, four cases and one scene, with a quarter of the pixels."""
    rig = load_rig(bench.RIG)
    small = replace(rig, camera=rig.camera.scaled(0.5), projector=rig.projector.scaled(0.5))
    names = ("nothing", "noise 3 mm", "noise 1 mm, steps of 8 mm", "shadow 0.2 m")
    chosen = [case for case in all_cases() if case.name in names]
    monkeypatch.setattr(bench, "all_cases", lambda: chosen)
    monkeypatch.setattr(bench, "SCENES", (Scene(4),))
    monkeypatch.setattr(bench, "load_rig", lambda name: small)
    monkeypatch.setattr(bench, "open_source", lambda name: Figures())
    done: list[tuple[int, int]] = []
    answer = bench_sensor_fit(1, lambda *numbers: done.append(numbers))
    assert done == [(number, 4) for number in range(1, 5)]
    return answer


def test_known_strengths_are_compared_with_those_found(figures: dict[str, Any], tmp_path: Path) -> None:
    rows = {(row["case"], row["scene"]): row for row in figures["rows"]}
    assert set(figures["summary"]) == {"4 still"} and len(rows) == 4
    assert rows["nothing", "4 still"]["figures"] == [] == rows["nothing", "4 still"]["others_needed"]
    (noise,) = rows["noise 3 mm", "4 still"]["figures"]
    assert noise["true"] == 3.0 and abs(noise["error"]) < 0.1
    (shadow,) = rows["shadow 0.2 m", "4 still"]["figures"]
    assert shadow["figure"] == "baseline_m" and abs(shadow["error"]) < 0.1
    (coarse,) = rows["noise 1 mm, steps of 8 mm", "4 still"]["figures"]
    assert coarse["true"] == pytest.approx((1 + 64 / 12) ** 0.5) and abs(coarse["error"]) < 0.1
    assert figures["summary"]["4 still"]["within"] == figures["summary"]["4 still"]["figures"] == 3
    draw_sensor_fit(figures, tmp_path / "sensor_fit.png")
    picture = decoded(tmp_path / "sensor_fit.png")
    bands = marks(picture, "#e9eee4", 40)
    left, right = min(mark.left for mark in bands), max(mark.right for mark in bands)
    points = [mark for mark in marks(picture, "#8a8a8a", 12) if mark.top >= min(mark.top for mark in bands)]
    assert points and all(left <= mark.middle[0] <= right for mark in points), "all strengths were found closely"


def test_figures_that_are_not_found_are_counted() -> None:
    errors = [{"error": None}, {"error": -0.3}, {"error": 0.05}]
    summary = summarise([{"scene": "1 still", "figures": errors, "others_needed": ["noise"]}])
    wanted = {"figures": 3, "within": 1, "beyond": 1, "not_found": 1, "others_needed": 1}
    assert summary == {"1 still": wanted}
