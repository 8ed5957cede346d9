"""The examples of docs/how-to/recordings.md run as they stand."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import image, write_mcap
from fake_cameras import FakeRealSense
from pngs import RAMP

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "recordings.md"


def test_every_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", FakeRealSense())
    monkeypatch.syspath_prepend(str(PAGE.parents[1] / "examples"))
    path = write_mcap(tmp_path / "a.mcap", [image(RAMP, "16UC1")])
    known: dict[str, Any] = {
        "arrays": [np.zeros((4, 6), np.uint16)],
    }
    examples = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    for example in examples:
        exec(compile(example.replace('"frames.npy"', repr(str(path))), str(PAGE), "exec"), dict(known))
    assert len(examples) == 3
    first, second, third = capsys.readouterr().out.splitlines()
    assert first.startswith("a 1.0 None 65.") and second == "live-000000 (4, 6)"
    assert third.startswith("1.0 Intrinsics(fx=100.0") and third.endswith("(60, 84)")
