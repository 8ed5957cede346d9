from __future__ import annotations

import json
from pathlib import Path

import pytest
from benches.charts.choices import CHOICES
from benches.charts.drawing import Picture
from benches.results import chart
from benches.results.chart import Options, run
from chart_figures import SOURCE, figures_of, write_figures_of
from PIL import Image

from bodyseg_data.core import BadConfig

pytest.importorskip("matplotlib")


@pytest.fixture
def results(tmp_path: Path) -> Path:
    folder = tmp_path / "results"
    folder.mkdir()
    return folder


def test_every_choice_is_drawn_and_told(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_figures_of(results)
    monkeypatch.setattr(chart, "draw", lambda choice, *_: Picture(choice.name.encode(), choice.title.encode()))
    out = tmp_path / "new" / "charts"
    assert run(Options(in_=results, out=out)) == 0
    names = [choice.name for choice in CHOICES]
    assert sorted(path.name for path in out.iterdir()) == sorted(
        ["charts.json", *(f"{name}.{kind}" for name in names for kind in ("svg", "png"))]
    )
    for choice in CHOICES:
        assert (out / f"{choice.name}.svg").read_text() == choice.name
        assert (out / f"{choice.name}.png").read_text() == choice.title
    told = json.loads((out / "charts.json").read_text())
    assert list(told["charts"]) == names and told["left_out"] == []
    assert told["charts"]["codec"]["sources"] == [{"file": "codec.json", **SOURCE}]
    assert capsys.readouterr().err == f"wrote {len(CHOICES)} charts into {out}\n"


def test_what_was_not_measured_is_left_out_by_name(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_figures_of(results, "codec")
    (results / "render.json").write_text(json.dumps(figures_of("render") | {"range_error_mm": None}))
    assert run(Options(in_=results, out=tmp_path / "out")) == 0
    lines = capsys.readouterr().err.splitlines()
    file = results / "occlusion.json"
    assert (
        f"chart shadow_test is left out: no occlusion.json, which `tools/bench occlusion --json {file}` makes" in lines
    )
    assert f"chart renderer is left out: nothing to compare in {results / 'render.json'}" in lines
    assert lines[-1] == f"wrote 1 charts into {tmp_path / 'out'}" and len(lines) == len(CHOICES)
    told = json.loads((tmp_path / "out" / "charts.json").read_text())
    Image.open(tmp_path / "out" / "codec.png").verify()
    assert (tmp_path / "out" / "codec.svg").read_text().endswith("</svg>\n")
    assert list(told["charts"]) == ["codec"] and len(told["left_out"]) == len(CHOICES) - 1


def test_nothing_to_draw_is_status_2(results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(Options(in_=results, out=tmp_path / "out")) == 2
    assert len(capsys.readouterr().err.splitlines()) == len(CHOICES) and not (tmp_path / "out").exists()


def test_every_processor_has_its_panels(results: Path, tmp_path: Path) -> None:
    others = {"2 cores of AMD EPYC (x86_64), 24 GiB": "amd-epyc-2-cores", "1 core of X (arm)": "x-1-core"}
    for hardware, name in others.items():
        (results / "processors" / name).mkdir(parents=True)
        (results / "processors" / name / "codec.json").write_text(
            json.dumps(figures_of("codec") | {"hardware": hardware})
        )
    assert run(Options(in_=results, out=tmp_path / "out")) == 0
    told = json.loads((tmp_path / "out" / "charts.json").read_text())["charts"]["codec"]
    assert [one["name"] for one in told["panels"]] == [
        "AMD EPYC, 2 cores: 60 samples of bare and dressed bodies",
        "X, 1 core: 60 samples of bare and dressed bodies",
    ]
    assert [(one["file"], one["hardware"]) for one in told["sources"]] == [
        (f"processors/{name}/codec.json", hardware) for hardware, name in others.items()
    ]
    drawn = (tmp_path / "out" / "codec.svg").read_text()
    assert all(f"·   {hardware}" in drawn for hardware in others)


@pytest.fixture
def not_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chart, "draw", lambda choice, *_: Picture(b"", b""))


@pytest.mark.usefixtures("not_drawn")
@pytest.mark.parametrize("field", ["hardware", "views", "codecs"])
def test_a_damaged_file_leaves_nothing_half_written(results: Path, tmp_path: Path, field: str) -> None:
    write_figures_of(results, "render", "codec")
    figures = figures_of("codec")
    del figures[field]
    (results / "codec.json").write_text(json.dumps(figures))
    with pytest.raises(BadConfig, match=rf"codec\.json .*{field}"):
        run(Options(in_=results, out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("not_drawn")
def test_folders_are_checked(results: Path, tmp_path: Path) -> None:
    write_figures_of(results, "codec")
    with pytest.raises(BadConfig, match=r"^--in must be a folder, found .*nowhere$"):
        run(Options(in_=tmp_path / "nowhere", out=tmp_path / "out"))
    with pytest.raises(BadConfig, match=r"^--out must be another folder than --in"):
        run(Options(in_=results, out=results / ".." / "results"))
    (tmp_path / "file").touch()
    with pytest.raises(BadConfig, match=r"^cannot make the folder .*file: File exists$"):
        run(Options(in_=results, out=tmp_path / "file"))


@pytest.mark.usefixtures("not_drawn")
def test_a_page_may_quote_what_was_drawn(results: Path, tmp_path: Path) -> None:
    write_figures_of(results, "codec")
    page = tmp_path / "index.md"
    page.with_name("index.md.in").write_text("{{ codec.command }} {{ charts.left_out[0] }}")
    assert run(Options(in_=results, out=tmp_path / "out", page=(page,))) == 0
    assert page.read_text() == f"{SOURCE['command']} artifacts"


@pytest.mark.usefixtures("not_drawn")
def test_a_page_without_a_template_is_refused(results: Path, tmp_path: Path) -> None:
    write_figures_of(results, "codec")
    with pytest.raises(BadConfig, match="--page needs a template of UTF-8 text: .*index.md.in"):
        run(Options(in_=results, out=tmp_path / "charts", page=(tmp_path / "index.md",)))
    assert not (tmp_path / "charts").exists(), "before the charts are drawn"
