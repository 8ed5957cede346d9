"""The examples of docs/how-to/add_your_own.md run as they are written."""

from __future__ import annotations

import re
import runpy
import shutil
from pathlib import Path

import pytest
from folders import ROOT

EXAMPLES = re.findall(
    r"^## (.+?)$.*?```python\n(.*?)```", (ROOT / "docs" / "how-to" / "add_your_own.md").read_text(), re.M | re.S
)


@pytest.mark.parametrize(("title", "code"), EXAMPLES, ids=[title for title, _ in EXAMPLES])
def test_the_example_runs(
    title: str, code: str, figures_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(figures_set, tmp_path / "shards")
    monkeypatch.chdir(tmp_path)
    Path("example.py").write_text(code)
    runpy.run_path("example.py")
    assert re.findall(r"^assert ", code, re.M), "an example shows what it gives"


def test_every_kind_of_addition_has_an_example() -> None:
    titles = " ".join(title for title, _ in EXAMPLES)
    assert all(word in titles for word in ("artifact", "transform", "Labels", "mixture", "source"))
