"""`bench everyday` on two bodies."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from benches.data.surface import interpenetration
from benches.model.failures import everyday
from benches.model.failures.everyday import bench_everyday

from bodyseg_data.bodies import BodyRef
from bodyseg_data.bodies.sources.hard import HardBodies
from bodyseg_data.bodies.sources.open_bodies import MadeBodies, WideBodies


def few(source: type[MadeBodies], step: int) -> type[MadeBodies]:
    """The source with fewer bodies: posing all of them takes most of the time."""

    class Few(source):  # type: ignore[misc,valid-type]
        def bodies(self) -> Sequence[BodyRef]:
            return super().bodies()[::step]

    return Few


@pytest.mark.usefixtures("quick_geodesics")
def test_the_figures_are_those_of_the_bodies_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("anny", "embreex"):
        pytest.importorskip(package)
    monkeypatch.setattr(everyday, "WideBodies", few(WideBodies, 100))
    monkeypatch.setattr(everyday, "HardBodies", few(HardBodies, 5))
    monkeypatch.setattr(interpenetration, "_SOURCE_STEP", 400)
    steps: list[tuple[int, int]] = []
    figures = bench_everyday(2, lambda done, total: steps.append((done, total)))
    assert steps == [(1, 2), (2, 2)]
    assert figures["bodies"] == 2
    assert figures["attempts"] >= 1
    assert 0 < figures["seconds"]["mean"] <= figures["seconds"]["p95"]
    assert 0 <= figures["over_20_mm"] <= figures["over_10_mm"] <= 1
    assert 0 < figures["coverage"]["before"] <= figures["coverage"]["after"] <= 1
