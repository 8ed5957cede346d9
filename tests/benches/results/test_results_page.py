"""The pages of results that are committed: their numbers, their figures, their charts."""

from __future__ import annotations

import json
import re

import pytest
from benches.charts.choice import Choice
from benches.charts.choices import CHOICES
from benches.charts.processors import by_processor, figures_of, panels_of
from benches.charts.report import described
from benches.charts.scales import thousands
from benches.results.everything import PAGES
from benches.results.outdated import without_mark
from benches.results.page import render_page, sources_of
from folders import ROOT

from bodyseg_model.runtimes import BACKEND_HELP, FLIP_HELP

RESULTS = ROOT / "docs" / "results"
CHARTS = RESULTS / "charts"
EVERY_PAGE = pytest.mark.parametrize("page", PAGES)


OF_FRAMES = ("segment_real.png",)
"""Pictures of labelled frames, which show no figures."""


def text_of(name: str) -> str:
    return (RESULTS / name).read_text(encoding="utf-8")


def pictures() -> list[str]:
    return re.findall(r"!\[[^\]]*\]\(([^)]+)\)", "".join(map(text_of, PAGES)))


@EVERY_PAGE
def test_the_numbers_of_the_page_are_those_of_the_json(page: str) -> None:
    made = render_page(text_of(f"{page}.in"), RESULTS, {"outdated": ""})
    assert without_mark(text_of(page)) == made, "make page writes it anew"


@EVERY_PAGE
def test_no_number_of_ours_is_typed_by_hand(page: str) -> None:
    """What stands in the template itself are words, the paper's numbers and sizes of things that are no results."""
    template, place = text_of(f"{page}.in"), r"\{\{.+?\}\}|\{%.+?%\}"
    typed = re.sub(place, "", template)
    assert not re.findall(r"\d\.\d+ ?(?:ms|%|points|times)", typed.replace("81.3 %", ""))
    assert not re.findall(r"\d\.\d", " ".join(re.findall(place, template))), "nor hidden in an expression"


@pytest.mark.parametrize("picture", sorted({*pictures()} - {*OF_FRAMES}))
def test_every_figure_has_its_json(picture: str) -> None:
    path = RESULTS / picture
    assert path.is_file()
    if path.parent == CHARTS:
        told = json.loads((CHARTS / "charts.json").read_text())["charts"][path.stem]
        assert path.with_suffix(".png").is_file() and path.with_suffix(".svg").is_file()
        sources = [RESULTS / one["file"] for one in told["sources"]]
    else:
        sources = [next(file for file in path.parent.glob("*.json") if path.stem.startswith(file.stem))]
    for source in sources:
        content = json.loads(source.read_text())
        assert content["command"] and content["commit"] and content["hardware"]


@EVERY_PAGE
def test_every_link_leads_somewhere(page: str) -> None:
    for link in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", text_of(page)):
        assert "://" in link or (RESULTS / link).exists(), link


@pytest.mark.parametrize("choice", CHOICES, ids=lambda choice: choice.name)
def test_the_charts_are_of_the_figures_beside_them(choice: Choice) -> None:
    figures = figures_of(RESULTS, choice.stem)
    sources = [
        {"file": str(one.file.relative_to(RESULTS))}
        | {name: one.content[name] for name in ("command", "commit", "hardware")}
        for one in figures
    ]
    made = described(choice, panels_of(choice, figures), sources)
    told = json.loads((CHARTS / "charts.json").read_text())
    assert told["charts"][choice.name] == json.loads(json.dumps(made))
    assert told["left_out"] == []


def test_every_chart_is_in_the_page_on_charts() -> None:
    rows = re.findall(r"^\| `(\w+)` \|", (ROOT / "docs" / "reference" / "charts.md").read_text(), re.MULTILINE)
    assert sorted(rows) == sorted(choice.name for choice in CHOICES)


@pytest.mark.parametrize("workers", ["2", "0"])
@pytest.mark.parametrize("other", ["webdataset_png", "mds_raw", "litdata", "memory"])
def test_the_readme_states_the_range_over_processors(other: str, workers: str) -> None:
    """Of all rivals and both numbers of workers, also where ours is slower."""
    measured = [record["loader"] for record in by_processor(RESULTS) if "loader" in record]
    ratios = [figures["ours_all_over"][other][workers] for figures in measured]
    span = " to ".join(dict.fromkeys([f"{min(ratios):.1f}", f"{max(ratios):.1f}"]))
    start = "the same without workers" if workers == "0" else "against stored sets"
    (row,) = [line for line in (ROOT / "README.md").read_text().splitlines() if start in line]
    assert f" {span} times " in row


def test_the_tables_read_every_kind_of_result() -> None:
    read = set(sources_of(text_of("tables.md.in")))
    assert set(sources_of(text_of("index.md.in"))) <= read, "the list of files, commands and commits is in the tables"
    by_now = {f"{bench}.json" for record in by_processor(RESULTS) for bench in record}
    assert "loader.json" in by_now
    assert {f"{choice.stem}.json" for choice in CHOICES} <= read | by_now | {"reduction.json", "partition.json"}
    assert {"stability.json", "ablation.json", "failures.json", "compact.json", "compact_hard.json"} <= read


@pytest.mark.parametrize(
    ("document", "results"),
    [("README.md", ["compact"]), ("docs/reference/model_card.md", ["compact", "compact_hard"])],
)
def test_readme_and_card_state_the_accuracy_of_the_network_that_ships(document: str, results: list[str]) -> None:
    text = (ROOT / document).read_text(encoding="utf-8")
    for name in results:
        accuracy = json.loads((RESULTS / f"{name}.json").read_text())["average_per_class_accuracy"]
        assert f"{100 * accuracy:.1f} %" in text, f"{name}.json"


@pytest.mark.parametrize("document", ["README.md", "docs/reference/model_card.md"])
def test_scores_of_people_lead_with_those_who_placed_no_label(document: str) -> None:
    text = (ROOT / document).read_text(encoding="utf-8")
    across, ships = (json.loads((RESULTS / f"{name}.json").read_text()) for name in ("cross_person", "people"))
    leading = f"**{100 * across['cross_person']['accuracy']:.1f} %**"
    in_sample = f"{100 * ships['scores']['all']['accuracy']:.1f} %"
    assert text.index("cross-person") < text.index(leading) < text.index(in_sample)
    assert f"{thousands(100 * across['in_sample_gain']['points'], 1)} points" in text


def test_the_card_states_the_scores_of_the_large_network() -> None:
    text = (ROOT / "docs" / "reference" / "model_card.md").read_text(encoding="utf-8")
    of_both, people, real = (
        json.loads((RESULTS / f"{name}.json").read_text()) for name in ("shipped", "people_large", "real_large")
    )
    large, compact = (of_both["networks"][name] for name in ("large", "compact"))
    scores = {
        "open test set": large["open"]["accuracy"],
        "hard": large["hard"]["accuracy"],
        "scans of two": people["scores"]["all"]["accuracy"],
        "frames of a Kinect": real["scores"]["accuracy"],
        "one place": real["agreement"]["same"],
    }
    for start, score in scores.items():
        (row,) = [line for line in text.splitlines() if line.startswith(f"| {start}")]
        assert row.rpartition(" | ")[2].startswith(f"{100 * score:.1f} %")
    assert f"{large['ms']['float32'] / compact['ms']['float32']:.1f} times the time" in text


def test_the_card_states_the_scores_on_real_people_with_what_they_are_worth() -> None:
    text = " ".join((ROOT / "docs" / "reference" / "model_card.md").read_text(encoding="utf-8").split())
    for ending in ("", "_flip_average"):
        people, real = (json.loads((RESULTS / f"{name}{ending}.json").read_text()) for name in ("people", "real"))
        for scores in (people["scores"]["all"], real["scores"]):
            assert f"{100 * scores['accuracy']:.1f} %" in text and f"{100 * scores['calibration_error']:.1f} %" in text
    assert "annotations of these twenty scans placed the open body's landmarks" in text and "doubtful" in text


def test_help_texts_state_what_was_measured() -> None:
    plain, flipped = (
        json.loads((RESULTS / f"people{ending}.json").read_text())["scores"]["all"]["accuracy"]
        for ending in ("", "_flip_average")
    )
    assert f" {100 * (flipped - plain):.1f} points more on real people" in FLIP_HELP
    ratios = [
        row["networks"][f"openvino {precision}"]["ms"] / row["networks"][f"torch {precision}"]["ms"]
        for record in by_processor(RESULTS)
        if "runtimes" in record
        for row in record["runtimes"]["times"]
        for precision in ("float32", record["segment"]["default"])  # bfloat16 where a processor has it
    ]
    assert f"openvino takes {min(ratios):.1f} to {max(ratios):.1f} times as long as torch" in BACKEND_HELP
