from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from benches.data.occlusion import quantisation, quantisation_figure
from benches.data.occlusion.quantisation import LIMIT, RESOLUTION_MM, STEPS_MM, bench_quantisation
from benches.data.occlusion.quantisation_figure import draw_quantisation
from folders import ROOT
from pictures import decoded, marks, part
from small_rig import SMALL

from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import load_rig

pytestmark = pytest.mark.usefixtures("quick_geodesics")

KEPT = ROOT / "docs" / "results" / "quantisation.json"


@pytest.fixture(scope="module")
def figures() -> dict[str, Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(quantisation, "load_rig", lambda: SMALL)
        return bench_quantisation(views=1)


def test_no_views_are_refused() -> None:
    with pytest.raises(BadConfig, match="at least one view must be measured, found 0"):
        bench_quantisation(views=0)


def test_coarser_steps_take_fewer_bytes_and_cast_the_same_shadows(figures: dict[str, Any]) -> None:
    rows = figures["steps"]
    assert [float(name) for name in rows] == list(STEPS_MM)
    sizes = [row["bytes"] for row in rows.values()]
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] < 0.75 * sizes[0]
    for row in rows.values():
        assert row["wrong_pixels"] == pytest.approx(row["false_lit"] + row["false_shadow"], abs=2e-6)
        assert 0 < row["wrong_pixels"] <= row["worst_view"] + 1e-6 < 0.02
        assert row["decode_ms"] > 0 and 0 < row["projector_bytes"] < row["bytes"]
    assert [row["gap_steps"] for row in rows.values()] == [60, 24, 12, 6, 3]


def test_the_default_rig_has_the_best_step_of_the_kept_results(figures: dict[str, Any]) -> None:
    kept = json.loads(KEPT.read_text())
    assert kept["best"] == kept["default"] == figures["default"] == f"{load_rig().range_step_mm:g}"
    assert kept["steps"].keys() == figures["steps"].keys()
    assert kept["steps"][kept["best"]]["wrong_pixels"] <= LIMIT == kept["limit"]
    assert float(kept["best"]) <= RESOLUTION_MM == kept["resolution_mm"]


def test_the_chart_is_drawn(figures: dict[str, Any], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    draw_quantisation(figures, tmp_path / "steps.png")
    picture = decoded(tmp_path / "steps.png")
    for panel in range(2):
        inside = part(picture, across=(panel / 2, (panel + 1) / 2))
        assert len(marks(inside, quantisation_figure._DEFAULT, 60)) == 1
        assert len(marks(inside, quantisation_figure._OTHERS, 20)) >= 1
        lines = [mark for mark in marks(inside, quantisation_figure._LIMIT) if mark.width > 200]
        assert bool(lines) == (panel == 1), "the limit is one of wrong shadows"
