"""`bench reduction` writes what it promises, and its chart can be drawn from that."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benches.data.surface import reduction as benches
from benches.data.surface.reduction_figure import _COLOURS, draw_reduction
from fakes import Figures
from pictures import decoded, marks, part
from shapes import figure
from small_rig import SMALL

from bodyseg_data.bodies import SOURCES, Body, BodyRef

COARSE = figure(subdivisions=2)
BODY = Body(COARSE, np.linspace(0, len(COARSE.vertices) - 1, 33).astype(np.int64))  # some on every piece


class PosedFigures(Figures):
    """The figure as two postures and another person, as the bench chooses them."""

    def bodies(self) -> Sequence[BodyRef]:
        return [
            BodyRef("A", "A", "A-0", "arms_crossed", "train"),
            BodyRef("A", "A", "A-1", "deep_squat", "train"),
            BodyRef("people", "people", "people-0", "standing", "train"),
        ]

    def build(self, body: BodyRef) -> Body:
        return BODY


@pytest.fixture(scope="module")
def figures(pymeshlab: Any) -> dict[str, Any]:
    steps: list[tuple[int, int]] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(SOURCES, "open", PosedFigures)
        patch.setattr(benches, "load_rig", lambda: SMALL)
        patch.setattr(benches, "SHARES", (1.0, 0.5))
        patch.setattr(benches, "TOLERANCES_MM", (0.2,))
        patch.setattr(benches, "EDGE_MM", 100)
        patch.setattr(benches, "GROWN_MM", ())
        patch.setattr(benches, "SCAN", 2400)
        patch.setattr(benches, "HALF_A_SCAN", 2000)
        made = benches.bench_reduction(1, progress=lambda done, total: steps.append((done, total)))
    assert steps == [(done, 4) for done in range(1, 5)]
    return made


def test_every_kind_has_its_rows(figures: dict[str, Any]) -> None:
    assert set(figures["kinds"]) == {"open", "smooth scan", "rough scan"}
    for kind in figures["kinds"].values():
        assert [row["share"] for row in kind["shares"]] == [1.0, 0.5]
        assert [row["tolerance_mm"] for row in kind["tolerances"]] == [0.2]
        for row in (*kind["shares"], *kind["tolerances"]):
            assert row["views_per_second"] > 0
            assert row["p95_mm"] <= row["max_mm"]


def test_a_whole_mesh_has_no_error_and_coarser_ones_have_more(figures: dict[str, Any]) -> None:
    for kind in figures["kinds"].values():
        whole, half = kind["shares"]
        for error in ("rms_mm", "p95_mm", "max_mm", "silhouette", "labels", "facing", "other_surface"):
            assert whole[error] == 0
        assert half["p95_mm"] > 0
        assert half["triangles"] < 0.6 * whole["triangles"]
        assert whole["reduce_ms"] == 0 < half["reduce_ms"]
        assert kind["tolerances"][0]["p95_mm"] <= 1.3 * 0.2  # probes and views are not the same pixels


def test_the_chart_is_drawn(figures: dict[str, Any], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    draw_reduction(figures, tmp_path / "chart.png")
    picture = decoded(tmp_path / "chart.png")
    for kind in figures["kinds"]:
        for half in ((0.0, 0.5), (0.5, 1.0)):
            assert marks(part(picture, across=half), _COLOURS[kind], 20), (kind, half)
    assert not marks(picture, _COLOURS["mit"], 60), "no MIT frames were measured"
