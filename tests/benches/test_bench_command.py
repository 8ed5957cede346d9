"""`tools/bench` as a command: its figures appear whole or not at all."""

from __future__ import annotations

import resource
import subprocess
from pathlib import Path

import pytest
from benches.__main__ import main
from benches.charts.processors import by_processor, folder_name
from folders import ROOT

from bodyseg_data.machine import hardware


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
    lock = subprocess.run(["git", "rev-parse", "--git-path", "index.lock"], capture_output=True, text=True, cwd=ROOT)
    assert lock.returncode or not (ROOT / lock.stdout.strip()).exists(), "asking for the commit locks nothing"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["variants", "--runs", "x"], "bench variants needs --data"),
        (["variants", "--data", "x"], "bench variants needs --runs"),
        (["codec", "--alone"], "--alone is for bench people, found it with bench codec"),
        (
            ["render", "--num-workers", "2"],
            "--num-workers is for bench packing, cluster, far, loader, open_data, workers, gpu, found it",
        ),
        (["partition", "--views", "3"], "bench partition measures whole bodies: leave --views out"),
        (["codec", "--results", "x", "--json", "x.json"], "--results names both files: leave --json and --figure out"),
        (["codec", "--results", "nowhere"], "--results must be a folder, found nowhere"),
        (["codec", "--views", "0"], "--views must be a whole number of at least 1, found 0"),
        (["steady", "--data", "x", "--views", "1"], "--views must be a whole number of at least 2, found 1"),
        (["clothes", "--figure", "x.png"], "bench clothes draws no figure: leave --figure out"),
    ],
)
def test_options_go_with_their_bench(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *words]) == 2
    assert message in capsys.readouterr().err


def test_results_go_to_the_folder_of_the_processor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.setattr("benches.data.surface.clothes.bench_clothes", lambda progress: {"steps": 1})
    monkeypatch.setattr("benches.data.codec.bench.bench_codec", lambda progress: {"steps": 2})
    monkeypatch.setattr("benches.data.codec.figure.draw_codec", lambda figures, path: path.write_text("drawn"))
    assert main(["bench", "clothes", "--results", str(tmp_path)]) == 0
    assert main(["bench", "codec", "--results", str(tmp_path)]) == 0
    folder = tmp_path / "processors" / folder_name(hardware())
    assert sorted(path.name for path in folder.iterdir()) == ["clothes.json", "codec.json", "codec.png"]
    assert [one["codec"]["steps"] for one in by_processor(tmp_path)] == [2]
    assert by_processor(tmp_path)[0]["codec"]["command"] == f"tools/bench codec --results {tmp_path}"


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "processors").touch()
    assert main(["bench", "codec", "--results", str(tmp_path)]) == 2
    assert f"cannot make the folder {tmp_path}/processors/" in capsys.readouterr().err
