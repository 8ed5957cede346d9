"""`bench shuffles`: trainings that differ in the order of samples alone."""

from __future__ import annotations

from pathlib import Path

import pytest
from benches.model import shuffles


def test_orders_are_compared_with_the_global_one(small_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shuffles, "SETTINGS", {"patch": 16, "widths": [8], "blocks": [1]})
    found = shuffles.bench_shuffles(str(small_set), seeds=1, steps=1, images=2)
    assert list(found["orders"]) == ["global", "blocks"] and found["test_images"] == 2
    assert found["orders"]["global"]["over_global"]["mean"] == 0
    scores = [row["accuracy"]["mean"] for row in found["orders"].values()]
    assert found["orders"]["blocks"]["over_global"]["mean"] == pytest.approx(scores[1] - scores[0], abs=2e-5)
