"""The steps that are declared: their commands can be read, and every result of today belongs to one."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from benches.__main__ import main
from benches.bench import BENCHES
from benches.bench import Options as BenchOptions
from benches.landmarks.command import Options as LandmarkOptions
from benches.model.networks.baselines import with_baselines
from benches.results.chart import Options as ChartOptions
from benches.results.everything import PAGES, PROCESSORS, everything
from benches.results.outdated import outdated, stale_results, without_mark
from benches.results.page import render_page, sources_of
from benches.results.records import Records
from benches.results.running import duration
from benches.results.step import Graph, Places, Step
from benches.results.trainings import OTHER_RUNS, SEEDS
from folders import ROOT
from made_steps import Workshop, a_result, a_set, a_training

from bodyseg_data.commands.cli import load_command
from bodyseg_data.commands.options import parse
from bodyseg_data.core import BadConfig
from bodyseg_model.commands.cli import COMMANDS

RESULTS = ROOT / "docs" / "results"


@pytest.fixture(scope="module")
def graph() -> Graph:
    return everything()


def options_of(step: Step) -> type:
    program, name = step.words[:2]
    if program == "bodyseg":
        return load_command(COMMANDS[name][0]).Options
    tools = {"tools/bench": BenchOptions, "tools/chart": ChartOptions, "tools/landmarks": LandmarkOptions}
    return tools[program]


def test_every_declared_command_can_be_read(graph: Graph) -> None:
    """Those with words, but for numbers and names of files, that no longer one of the same command has."""
    known: set[tuple[str, ...]] = set()
    with with_baselines():
        for step in sorted(graph.steps.values(), key=lambda step: -len(step.words)):
            program, name = step.words[:2]
            assert program != "tools/bench" or name in BENCHES, step.command
            words = step.words[2:] if program == "bodyseg" else step.words[1:]
            plain = [re.sub(r"\b(runs|sets|results|data|processors)/\S+|\d+", "", word) for word in words]
            of = (program, name) if program == "bodyseg" else (program,)
            has = {(*of, word) for word in plain} - {(program, name)}
            if not has <= known:
                assert parse(options_of(step), words, step.name, "", "") is not None, step.command
            known |= has


def test_only_benches_that_draw_are_asked_for_a_figure(graph: Graph) -> None:
    asked = {step.words[1] for step in graph.steps.values() if "--figure" in step.words}
    assert asked and not {name for name in asked if BENCHES[name].figure is None}


def test_every_result_is_of_a_step(graph: Graph) -> None:
    """Whatever a document quotes can become stale, and `--list` says so."""
    made = {name for step in graph.steps.values() for _, name in step.results}
    kept = {path.relative_to(RESULTS).as_posix() for path in RESULTS.rglob("*.json") if path.parent.name != "charts"}
    assert kept - {"steps.json"} <= made
    for page in PAGES:
        assert {*sources_of((RESULTS / f"{page}.in").read_text())} <= made
    pictures = {path.name for path in RESULTS.glob("*.png")} & {f"{Path(name).stem}.png" for name in made}
    assert pictures <= made


def test_what_a_processor_decides_is_measured_on_that_processor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], graph: Graph
) -> None:
    steps = [step for step in graph.steps.values() if step.processor]
    assert {step.processor for step in steps} == {*PROCESSORS} and all(step.alone for step in steps)
    assert all(step.name.startswith(f"processors/{step.processor}/") for step in steps)
    elsewhere = Step("x", "results", ("true",), (("results/x.json", "x.json"),), processor="another")
    shop = Workshop(tmp_path)
    shop.steps = [elsewhere]
    assert shop.run(list=True) == 1
    assert "needs the processor another" in capsys.readouterr().out


def test_trainings_and_seeds_of_every_network_are_declared(graph: Graph) -> None:
    names = [name for name, step in graph.steps.items() if step.kind == "training"]
    assert sum(name.startswith("runs/full/") for name in names) == SEEDS * (5 + len(OTHER_RUNS))
    for folder, count in (("full", 3), ("paper", 3), ("paper_alexnet", 2), ("networks", 3), ("alexnet", 3)):
        of_folder = [name.rpartition("-")[0] for name in names if name.startswith(f"runs/{folder}/")]
        assert {of_folder.count(name) for name in of_folder} == {count}


def test_steps_read_what_their_commands_name(graph: Graph) -> None:
    assert graph.inputs(graph.steps["failures_open"]) == ("sets/open18", "runs/networks/compact-0", "sets/hard18")
    assert graph.external(graph.steps["people"]) == ("data/faust", "shipped")
    assert graph.external(graph.steps["stability_hidden"]) == ("shipped",)
    architectures = graph.inputs(graph.steps["architectures"])
    assert {"runs/networks/compact-2", "runs/networks/deeplab_half-0"} <= {*architectures}
    ablation = graph.inputs(graph.steps["ablation"])
    assert {"runs/networks/compact-1", "runs/ablation/views_1-0", "sets/bare233"} <= {*ablation}
    assert graph.inputs(graph.steps["cross_person"]) == ("runs/placed_by-0", "runs/placed_by-1")
    packed = graph.steps["sets/placed_by_1_wide"]
    assert graph.external(packed) == ("tools/benches/model/people/placed_by_1.json",)
    assert graph.inputs(graph.steps["runs/placed_by-1"])[0] == packed.name
    assert graph.external(graph.steps["page"]) == tuple(f"docs/results/{page}.in" for page in PAGES)


def test_code_is_that_of_the_command(graph: Graph) -> None:
    steps = graph.steps
    assert steps["sets/hard18"].code == ("bodyseg_data.commands.shard",)
    assert steps["failures_open"].code == ("benches.model.failures.bench",)
    assert steps["page"].code == ("benches.results.chart",)


def test_the_list_of_a_fresh_checkout(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [
        "bench",
        "all",
        "--list",
        "--work",
        str(tmp_path / "work"),
        "--results",
        str(tmp_path),
        "--only",
        "sets/hard18",
        "people",
    ]
    assert main(words) == 1
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == ["sets/hard18", "stale", "never", "made"]
    assert lines[1][:2] == ["people", "blocked"] and lines[1][2] == f"{tmp_path}/work/data/faust"
    assert not (tmp_path / "work").exists()


def test_the_help_of_the_command_is_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "all", "--help"]) == 0
    assert "--accept" in capsys.readouterr().out
    assert main(["bench", "--help"]) == 0
    assert "--accept" not in capsys.readouterr().out


def test_a_step_of_the_product_runs_in_any_folder(tmp_path: Path) -> None:
    """The checkout's programs are found from the work folder."""
    shop = Workshop(tmp_path)
    shop.steps = [Step("x", "results", ("tools/bench", "nothing"), (("results/x.json", "x.json"),), modules=("x",))]
    assert shop.run() == 1
    assert 'tools/bench: Invalid value "nothing"' in (tmp_path / "work" / "logs" / "x.log").read_text()


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ([a_set(), a_set()], "steps need different names, found sets/a 2 times"),
        ([a_training("runs/x"), a_set()], "runs/x must stand behind sets/a, whose products it reads"),
        (
            [
                a_result("x", "runs/x"),
                Step("twin", "results", ("true",), (("results/x.json", "x.json"),)),
            ],
            "docs/results/x.json is made by two steps, x and twin",
        ),
    ],
)
def test_graphs_are_checked(steps: list[Step], message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        Graph(steps)


def test_words_name_files_of_four_folders() -> None:
    places = Places(Path("/work"), Path("/external"), Path("/checkout/docs/results"))
    assert places.path("tools/bench") == ROOT / "tools" / "bench"
    found = [str(places.path(word)) for word in ("data/mit", "docs/results/a.json", "docs/results", "runs/x-0")]
    assert found == ["/external/mit", "/checkout/docs/results/a.json", "/checkout/docs/results", "/work/runs/x-0"]


@pytest.mark.parametrize(("seconds", "text"), [(95, "95 s"), (720, "12 min"), (12240, "3.4 h")])
def test_times_have_two_digits(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_a_page_names_what_the_code_of_today_did_not_make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b", "c"):
        (tmp_path / f"{name}.json").write_text('{"n": 1}')
    template = "{{ outdated }}\n{{ a.n | number }}{{ b.n | number }}{{ c.n | number }}\n"
    stale = {"a.json", "b.json", "other.json"}
    monkeypatch.setattr("benches.results.page.stale_results", lambda folder: stale)
    page = render_page(template, tmp_path)
    first, *_, last = page.splitlines()
    assert "earlier code" in first and "[a.json](a.json), [b.json](b.json)." in first
    assert "c.json" not in first and "other" not in first and last == "111"
    assert without_mark(page) == render_page(template, tmp_path, {"outdated": ""}) == "\n111\n"
    assert outdated(stale, ["c.json"]) == ""
    of_processors = [f"processors/{name}/network.json" for name in ("one", "two")]
    assert outdated(of_processors, of_processors).count("tables.md#by-processor") == 1


def test_a_result_without_a_record_is_stale(tmp_path: Path) -> None:
    found = stale_results(tmp_path)
    assert {"occlusion.json", "compact.json"} <= found
    assert "index.md" not in found, "the pages are made of what is there"


def test_the_records_that_are_committed_are_of_declared_steps(graph: Graph) -> None:
    records = Records(graph, Places(Path("nowhere"), Path("nowhere"), RESULTS))
    for name in json.loads((RESULTS / "steps.json").read_text())["steps"]:
        assert records.get(graph.steps[name]) is not None
