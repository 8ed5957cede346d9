from __future__ import annotations

import sys
from pathlib import Path

import pytest
from benches.data.render import cluster
from benches.data.render.cluster import Costs, at_scale
from fakes import Figures
from small_rig import SMALL

from bodyseg_data.bodies import SOURCES
from bodyseg_data.core import MissingLibrary
from bodyseg_data.packing import Packing


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # distributed closes its loops late
def test_clusters_are_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setitem(SOURCES, "open", Figures)
    monkeypatch.setattr(cluster, "_VIEWS", 2)
    monkeypatch.setattr(cluster, "_IDLE_S", 0.05)
    monkeypatch.setattr(cluster, "_PROCESSES", False)
    monkeypatch.setattr(cluster, "Packing", lambda *words, **options: Packing(*words, **{**options, "rig": SMALL}))
    steps: list[tuple[int, int]] = []
    found = cluster.bench_cluster(2, (1, 2), lambda done, total: steps.append((done, total)))
    assert steps == [(1, 2), (2, 2)]
    assert found["views"] == 4
    assert found["equal"]
    one, two = found["clusters"]
    assert (one["workers"], two["workers"]) == (1, 2)
    for row in (one, two):
        assert row["worker_ms"] >= 0  # 0 where idle processes took as much
        assert set(row["idle_ms"]) == {"worker", "scheduler", "packer"}
        assert row["predicted_s"] >= 0
    assert 100 < found["job_bytes"] < found["result_bytes"]


def test_a_thousand_machines_are_predicted_from_costs_that_were_measured() -> None:
    assert at_scale(Costs(20, 0.05, 0.2)) == {"workers": 1000, "views_a_second": 5000, "useful_workers": 100}
    assert at_scale(Costs(20, 0.0, 0.2)) is None
    assert at_scale(Costs(20, 0.05, 0.0)) is None


def test_the_slowest_part_sets_the_time() -> None:
    costs = Costs(worker=20, scheduler=0.05, packer=0.2)
    assert costs.seconds(1000, 10) == pytest.approx(2), "the workers"
    assert costs.seconds(1000, 1000) == pytest.approx(0.2), "the process that packs"
    assert Costs(20, 0.5, 0.2).seconds(1000, 1000) == pytest.approx(0.5), "the scheduler"
    assert costs.seconds(1000, 4, processors=2) == pytest.approx(10.125), "two processors for all"


def test_without_dask(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingLibrary, match=r"pip install 'bodyseg\[cluster\]'"):
        cluster.bench_cluster(1, (1,))
