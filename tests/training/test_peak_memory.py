"""Peak memory in the log of a training."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bodyseg_model.commands import main


@pytest.mark.parametrize(("method", "processes"), [("process", 1), ("thread", 0)])
def test_the_log_has_the_peaks_of_all_processes(figures_set: Path, tmp_path: Path, method: str, processes: int) -> None:
    settings = json.dumps({"patch": 16, "widths": [12, 16], "blocks": [1, 1]})
    words = ["--data", str(figures_set), "--out", str(tmp_path / "run"), "--settings", settings, "--steps", "2"]
    words += ["--batch-size", "2", "--num-workers", "1", "--worker-method", method, "--log-every", "1"]
    assert main(["train", *words]) == 0
    lines = [json.loads(line)["peak_mb"] for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert len(lines) == 2
    for line in lines:
        assert line["process"] > 50, "this process alone takes more"
        assert [peak > 50 for peak in line["workers"]] == [True] * processes
    assert lines[1]["process"] >= lines[0]["process"], "a peak never falls"
