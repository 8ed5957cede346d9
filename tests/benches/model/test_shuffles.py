"""`bench shuffles`: trainings that differ in the order of samples alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benches.model import shuffles

from bodyseg_data import RangeImages


def test_orders_are_compared_with_the_global_one(small_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shuffles, "SETTINGS", {"patch": 16, "widths": [8], "blocks": [1]})
    found = shuffles.bench_shuffles(str(small_set), seeds=1, steps=1, images=2)
    assert list(found["orders"]) == ["global", "blocks", "stored"] and found["test_images"] == 2
    assert found["orders"]["global"]["over_global"]["mean"] == 0
    scores = [row["accuracy"]["mean"] for row in found["orders"].values()]
    assert found["orders"]["stored"]["over_global"]["mean"] == pytest.approx(scores[2] - scores[0], abs=2e-5)


def test_the_control_is_read_as_it_is_stored(small_set: Path) -> None:
    stored = shuffles._InStoredOrder(small_set, "none", "train").requests(3, "blocks").part(0, 16)
    assert [index for _, index in stored] == list(range(16)) and {epoch for epoch, _ in stored} == {3}
    mixed = RangeImages(small_set, "none", "train").requests(3).part(0, 16)
    assert np.diff([index for _, index in mixed]).min() < 0
