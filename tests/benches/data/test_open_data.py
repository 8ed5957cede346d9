"""`bench open_data` writes what it promises, on scenes of a few pixels."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from benches.data import open_data
from small_rig import SMALL

from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import Rig

# Webdataset leaves its tars open; `bench loader` has the same.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")

RIG = replace(
    SMALL,
    camera=replace(SMALL.camera, rows=16, columns=20, centre_px=(10.0, 8.0), focal_px=20.0),
    projector=replace(SMALL.projector, rows=16, columns=20, centre_px=(10.0, 8.0), focal_px=20.0),
    range_step_mm=1.0,
)


def scenes(count: int) -> tuple[Rig, list[dict[str, Any]]]:
    """A wall with a box before it, a little farther away in each scene."""
    found = []
    for number in range(count):
        seen = np.full((16, 20), 2.5 + number / 100, np.float32)
        seen[4:10, 6:12] = 2.0
        seen[:2] = 0
        labels = np.where(seen == 2.0, 1, 0).astype(np.uint8)
        found.append(
            {"key": f"s-{number}", "range_m": seen, "labels": labels, "projector_range_m": np.roll(seen, 2, 1)}
        )
    return RIG, found


def test_writing_bytes_and_loaders_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("webdataset")
    monkeypatch.setattr(open_data, "rendered", scenes)
    monkeypatch.setattr(open_data, "ROUNDS", 1)
    monkeypatch.setattr(open_data, "BATCH", 2)
    steps: list[tuple[int, int]] = []
    found = open_data.bench_open_data(8, (0,), lambda done, total: steps.append((done, total)))
    assert steps == [(done, 6) for done in range(1, 7)]
    json.dumps(found)
    assert found["image"] == [16, 20]
    assert found["measured_share"] == 0.875
    assert found["writing"].keys() == open_data.WRITTEN.keys()
    for row in found["writing"].values():
        assert row.keys() == {"samples_per_second", "of_the_encoder", "bytes"}
        assert min(row["samples_per_second"].values()) > 0
    assert found["writing"]["none"]["bytes"] <= found["writing"]["exact"]["bytes"]
    assert set(found["artifacts_ms"]) == {"none", "occ", "noise", "md", "all"}
    rates = found["samples_per_second"]
    assert rates["ours_all"].keys() == rates["webdataset_raw"].keys() == {"0"}
    assert found["processor_ms_per_sample"]["ours_all"].keys() == {"0"}
    assert found["ours_all_over"]["webdataset_png"]["0"] > 0
    assert found["bytes_per_sample"]["memory"] == 16 * 20 * 5
    assert all(found["bytes_per_sample"][name] is None and rates[name]["0"] is None for name in found["missing"])


def test_too_few_scenes_for_the_workers_are_refused() -> None:
    with pytest.raises(BadConfig, match="at least 32 samples are needed with 2 workers, found 20"):
        open_data.bench_open_data(20, (0, 2))
