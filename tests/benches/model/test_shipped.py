"""`bench shipped`: what it writes of both networks, and averaging where a network is unsure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from benches.model.networks import network_times, shipped  # noqa: E402
from small_training import TINY  # noqa: E402

from bodyseg_model.networks import Trained, build  # noqa: E402


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, small_set: Path) -> None:
    """Untrained networks, a small set in place of people's scans, and one round of times."""

    def packed(bodies: Any, views: int, folder: Path) -> None:
        (folder / "set").symlink_to(small_set)

    def untrained(file: Path) -> Trained:
        return Trained(build("compact", TINY, len(file.stem)).eval(), {})

    frame = np.full((32, 24), 2.5, np.float32)
    monkeypatch.setattr(shipped, "packed_views", packed)
    monkeypatch.setattr(shipped, "annotated_bodies", lambda people, poses: [])
    monkeypatch.setattr(shipped, "typical_frames", lambda count: [frame] * count)
    monkeypatch.setattr(network_times, "MOST_ROUNDS", 1)
    monkeypatch.setattr(network_times, "WARM_S", 0.0)
    monkeypatch.setattr(shipped, "load_network", untrained)


@pytest.mark.usefixtures("small")
def test_both_networks_are_scored_and_timed_in_three_ways(small_set: Path) -> None:
    found = shipped.bench_shipped(str(small_set), str(small_set), small_set, images=5)
    ways = "", shipped.UNSURE, shipped.FLIP
    assert list(found["networks"]) == [name + way for name in ("compact", "large") for way in ways]
    assert [name for name, row in found["networks"].items() if row["default"]] == ["compact"]
    assert found["images"] == {"open": 5, "hard": 5, "people": 5}
    for name in ("compact", "large"):
        plain, unsure, flip = (found["networks"][name + way] for way in ways)
        assert unsure["averaged"]["people"] == pytest.approx(0.4), "two of five are below the median"
        for precision, ms in unsure["ms"].items():
            low, high = sorted((plain["ms"][precision], flip["ms"][precision]))
            assert low <= ms <= high
        assert plain["parameters"] == flip["parameters"] > 0
        for test in ("open", "hard", "people"):
            assert 0 <= unsure[test]["accuracy"] <= 1 and unsure[test]["gross_errors"]["mean_mm"] > 0


def test_images_that_are_less_sure_are_averaged() -> None:
    once = [shipped.Answer(np.eye(33, dtype=np.int64), shipped.GrossErrors(), sure) for sure in (0.2, 0.9, 0.5)]
    twice = [one._replace(confidence=1.0) for one in once]
    assert [one.confidence for one in shipped.where_unsure(once, twice, 0.5)] == [1.0, 0.9, 0.5]
