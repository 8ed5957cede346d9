from __future__ import annotations

import sys

import pytest
from benches.data.render import scaling
from fakes import Figures

from bodyseg_data.bodies import SOURCES
from bodyseg_data.core import MissingLibrary


def test_every_cost_of_a_view_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """With plain figures and a worker in this process, which need no time to start."""
    monkeypatch.setitem(SOURCES, "open", Figures)
    monkeypatch.setattr(scaling, "CLUSTER", {**scaling.CLUSTER, "processes": False, "protocol": "tcp"})
    for name, count in (("_BODIES", 1), ("_WRITTEN_BODIES", 3), ("_SENT_BODIES", 2)):
        monkeypatch.setattr(scaling, name, count)
    steps: list[tuple[int, int]] = []
    found = scaling.bench_scaling(2, lambda done, total: steps.append((done, total)))
    assert steps == [(1, 3), (2, 3), (3, 3)]
    assert list(found) == ["views", "render_ms", "write_ms", "bytes", "manifest_bytes", "dask_ms"]
    assert all(value > 0 for value in found.values())
    assert 5_000 < found["bytes"] < 200_000
    assert 30 < found["manifest_bytes"] < 5_000, "a small set's manifest is mostly its rig"


def test_without_dask(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingLibrary, match=r"pip install 'bodyseg\[cluster\]'"):
        scaling._fetch(scaling.Packing("open"), scaling.Rendered([], ()))
