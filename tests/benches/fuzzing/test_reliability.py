from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from benches.fuzzing import bench as reliability
from benches.fuzzing.bench import bench_reliability


def test_every_broken_promise_counts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def damage(folder: Path, step: Any) -> dict[str, Any]:
        for _ in range(4):
            step()
        return {"cut": {"damages": 3, "faults": ["silence"]}, "flipped": {"damages": 2, "faults": []}}

    def interruptions(folder: Path, step: Any) -> dict[str, Any]:
        for _ in range(24):
            step()
        return {"killed": {"interruptions": 1, "faults": ["half-written"]}}

    def campaign(target: str, seed: int, numbers: range, kernels: str = "auto") -> dict[str, Any]:
        figures = {"inputs": len(numbers), "read": 1, "refused": 2, "longest_s": 0.1, "memory_of_allowed": 0.2}
        return {**figures, "outcome": kernels if target == "bsi" else "", "faults": ["crash"] * (target == "tar")}

    monkeypatch.setattr(reliability, "measure_damage", damage)
    monkeypatch.setattr(reliability, "measure_interruptions", interruptions)
    monkeypatch.setattr(reliability, "campaign", campaign)
    monkeypatch.setattr(reliability, "find_spec", lambda name: True)
    steps: list[tuple[int, int]] = []
    found = bench_reliability(200, lambda done, total: steps.append((done, total)))
    assert steps == [(number, len(steps)) for number in range(1, len(steps) + 1)]
    assert found["damages"] == 5
    assert found["inputs"] == 200
    assert found["faults"] == 4, "silence, half-written, crash, and loops that differ"
    assert "otherwise than NumPy's" in found["fuzzing"]["bsi"]["faults"][0]
    assert found["fuzzing"]["sample"]["faults"] == []
