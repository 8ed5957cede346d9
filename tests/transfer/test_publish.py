"""The commands of docs/how-to/publish.md: a set goes to a hub of the tests' own, and comes back."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest
from benches import __main__ as tools
from folders import DOCS
from servers import TOKEN, web_server

from bodyseg_data import RangeImages
from bodyseg_model.commands import main

TEXT = (DOCS / "how-to" / "publish.md").read_text().partition("\n## ")[0].replace("OWNER/NAME", "owner/name")


def test_a_set_is_published_and_pulled(small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("huggingface_hub")
    pytest.importorskip("aiohttp")
    monkeypatch.chdir(tmp_path)
    shutil.copytree(small_set, "shards")
    first, upload, last = re.fullmatch(r"(.*?)    (hf upload .*?)\n(.*)", TEXT, re.DOTALL).groups()  # type: ignore[union-attr]
    commands = [
        [shlex.split(line) for line in re.findall(r"^    (?:bodyseg |tools/)(.*)$", part, re.M)]
        for part in (first, last)
    ]
    assert [[words[0] for words in part] for part in commands] == [["verify", "card"], ["pull", "verify"]]
    verify, card = commands[0]
    assert main(verify) == 0 and tools.main(card) == 0
    name, folder, place = shlex.split(upload)[2:5]
    assert (name, place) == ("owner/name", ".")
    with web_server(Path(folder)) as hub:
        monkeypatch.setenv("HF_ENDPOINT", hub.url("").rstrip("/"))
        monkeypatch.setenv("HF_TOKEN", TOKEN)
        assert all(main(words) == 0 for words in commands[1])
        (code,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
        exec(compile(code, "publish.md", "exec"), {})
    assert {file.name for file in Path("copy").iterdir()} == {file.name for file in Path("shards").iterdir()}
    assert RangeImages("copy", "none").keys == RangeImages("shards", "none").keys
