from __future__ import annotations

import json
from typing import Any

import pytest
from benches.data.occlusion import quantisation
from benches.data.occlusion.quantisation import LIMIT, RESOLUTION_MM, STEPS_MM, bench_quantisation
from folders import ROOT
from small_rig import SMALL

from bodyseg_data.rigs import load_rig

pytestmark = pytest.mark.usefixtures("quick_geodesics")

KEPT = ROOT / "docs" / "results" / "quantisation.json"


@pytest.fixture(scope="module")
def figures() -> dict[str, Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(quantisation, "load_rig", lambda: SMALL)
        return bench_quantisation(views=1)


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
