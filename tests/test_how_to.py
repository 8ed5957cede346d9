"""The examples of docs/how-to/add_your_own.md run as they are written."""

from __future__ import annotations

import re
import runpy
import shutil
from pathlib import Path

import pytest
from folders import ROOT

TEXT = (ROOT / "docs" / "how-to" / "add_your_own.md").read_text()
SECTIONS = dict(re.findall(r"^## (.+?)$(.*?)(?=^## |\Z)", TEXT, re.M | re.S))
EXAMPLES = {title: "".join(re.findall(r"```python\n(.*?)```", text, re.S)) for title, text in SECTIONS.items()}
ENTRIES = re.compile(r"""```toml\n\[project\.entry-points\."(.+?)"\]\n(.*?)```""", re.S)


def installed(text: str, folder: Path) -> str:
    """Lay out what `pip install` makes of the entry points in a section; returns the name of its module."""
    for group, lines in ENTRIES.findall(text):
        info = folder / "mine-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
        entries = lines.replace('"', "")
        (info / "entry_points.txt").write_text(f"[{group}]\n{entries}")
        return str(entries.partition("= ")[2].partition(":")[0])
    return "example"


@pytest.mark.parametrize("title", EXAMPLES)
def test_the_example_runs(title: str, figures_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(figures_set, tmp_path / "shards")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    file = Path(f"{installed(SECTIONS[title], tmp_path)}.py")
    file.write_text(EXAMPLES[title])
    runpy.run_path(str(file), run_name="__main__")
    assert re.findall(r"^ *assert ", EXAMPLES[title], re.M), "an example shows what it gives"


def test_every_kind_of_addition_has_an_example() -> None:
    titles = " ".join(EXAMPLES)
    assert all(word in titles for word in ("artifact", "source"))
