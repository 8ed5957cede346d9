"""`tools/bench` as a command: its figures appear whole or not at all."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest
from benches.__main__ import main


def test_figures_that_do_not_fit_on_the_disk_are_one_line_and_leave_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("benches.data.surface.clothes.bench_clothes", lambda progress: {"steps": "x" * 100})
    target = tmp_path / "figures.json"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50, before[1]))
    try:
        assert main(["bench", "clothes", "--json", str(target)]) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    lines = [line for line in capsys.readouterr().err.splitlines() if " steps, " not in line]
    assert lines == [f"tools/bench: cannot write {target}: File too large"]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["variants", "--runs", "x"], "bench variants needs --data"),
        (["variants", "--data", "x"], "bench variants needs --runs"),
        (["codec", "--alone"], "--alone is for bench variants, found it with bench codec"),
        (["render", "--num-workers", "2"], "--num-workers is for bench loader, workers, found it with bench render"),
        (["partition", "--views", "3"], "bench partition measures whole bodies: leave --views out"),
        (["clothes", "--figure", "x.png"], "bench clothes draws no figure: leave --figure out"),
    ],
)
def test_options_go_with_their_bench(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *words]) == 2
    assert message in capsys.readouterr().err
