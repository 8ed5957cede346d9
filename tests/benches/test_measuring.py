"""Times are medians of all rounds, and a figure says under which conditions it was taken."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest
from benches.measuring import Conditions, median_time, medians, threads_per_core


def test_the_median_of_the_rounds_counts_and_not_the_quickest(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 1.0, 10.0, 15.0, 20.0, 27.0])
    monkeypatch.setattr(time, "process_time", lambda: next(clock))
    assert median_time(lambda: "made", 3) == (5.0, "made")


def test_medians_of_trees() -> None:
    rounds = [
        {"ms": {"read": 3.0, "write": 9.0}, "right": 0.5, "name": "a", "gpu": None, "people": {"1": 2}},
        {"ms": {"read": 1.0, "write": 8.0}, "right": 0.5, "name": "a", "gpu": 1.0, "people": {"1": 4, "2": 7}},
        {"ms": {"read": 2.0, "write": 1.0}, "right": 0.5, "name": "a", "gpu": 2.0, "people": {"1": 3}},
    ]
    expected = {"ms": {"read": 2.0, "write": 8.0}, "right": 0.5, "name": "a", "gpu": None, "people": {"1": 3, "2": 7}}
    assert medians(rounds) == expected


@pytest.mark.parametrize(("text", "threads"), [("0\n", 1), ("0,64\n", 2), ("0-1", 2), ("0-1,8-9", 4), ("", None)])
def test_threads_that_share_a_core(text: str, threads: int | None, tmp_path: Path) -> None:
    (tmp_path / "siblings").write_text(text)
    assert threads_per_core(tmp_path / "siblings") == threads
    assert threads_per_core(tmp_path / "absent") is None


def test_the_load_is_that_before_and_after(monkeypatch: pytest.MonkeyPatch) -> None:
    loads = iter([0.251, 1.999])
    monkeypatch.setattr(os, "getloadavg", lambda: (next(loads), 0.0, 0.0))
    found = Conditions().to_json()
    assert (found["load_before"], found["load_after"]) == (0.25, 2.0)
    assert found["threads_per_core"] == threads_per_core()
