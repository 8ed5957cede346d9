"""`bench things`: which network and score it measures."""

from __future__ import annotations

from typing import Any

import pytest
from benches.model.things import bench

from bodyseg_model.segmentation import PersonScore, shipped_score


def test_the_shipped_score_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[PersonScore] = []

    def measured(network: Any, score: PersonScore, count: int, progress: Any) -> dict[str, Any]:
        asked.append(score)
        return {"rooms": count, "weights": sum(weight.numel() for weight in network.parameters())}

    monkeypatch.setattr(bench, "people_and_things", measured)
    figures = bench.bench_things(views=50)
    assert (figures["network"], figures["rooms"]) == ("shipped", 50) and figures["weights"] > 1_000_000
    assert asked == [shipped_score()]
