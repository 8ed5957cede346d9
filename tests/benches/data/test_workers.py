from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from benches.data.workers import bench
from benches.data.workers.figure import draw_workers
from benches.data.workers.memory import process_tree, tree_mb
from benches.data.workers.subject import Setup
from PIL import Image

from bodyseg_data.core import BadSample


@pytest.fixture(scope="module")
def figures(small_set: Path) -> dict[str, Any]:
    """A whole measurement of loaders of batches of 3."""
    ticks: list[tuple[int, int]] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "VARIANTS", ("all",))
        # Not "fork": the process of the tests has threads, and a fork of it may die of what they held.
        patch.setattr(bench, "START_METHOD", "forkserver")
        found = bench.measure(
            small_set,
            (1,),
            batch=3,
            rounds=8,  # the system counts processor time in hundredths of a second: fewer rounds may take none
            progress=lambda done, total: ticks.append((done, total)),
        )
    assert ticks == [(done, len(ticks)) for done in range(1, len(ticks) + 1)]
    return found


def test_every_kind_of_workers_is_measured(figures: dict[str, Any]) -> None:
    rows = figures["rows"]
    assert [(row["method"], row["workers"]) for row in rows] == [
        ("thread", 1),
        ("fork", 1),
        ("forkserver", 1),
    ]
    for row in rows:
        assert len(row["rounds_of"]) == 8 and min(row["rounds_of"]) > 0
        assert row["processor_ms_per_sample"] > 0 and row["peak_mb"] > 50
        assert row["opening_ms"] > 0
    assert figures["thread_over_process"]["all"]["1"] > 0
    assert (figures["samples"], figures["batch"], figures["rounds"]) == (24, 3, 8)


def test_the_figure_shows_it(figures: dict[str, Any], tmp_path: Path) -> None:
    draw_workers(figures, tmp_path / "workers.png")
    with Image.open(tmp_path / "workers.png") as image:
        assert image.width > 1000


def test_other_images_are_seen(small_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "START_METHOD", "forkserver")
    with pytest.raises(BadSample, match=r"^0 workers \(thread\) deliver other images than were stored$"):
        bench._rounds(small_set, [Setup("all", "thread", 0)], 5, 1, {"other": 1}, lambda: None)


def test_memory_is_that_of_the_whole_tree() -> None:
    program = "import sys; held = bytearray(b'x' * (30 << 20)); print(flush=True); sys.stdin.read()"
    before = tree_mb(os.getpid())
    if before is None:
        pytest.skip("no /proc/*/smaps_rollup")
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        assert child.pid in process_tree(os.getpid())
        assert (tree_mb(os.getpid()) or 0) > before + 25
    assert tree_mb(child.pid) is None
