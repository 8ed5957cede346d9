"""The page of results: numbers out of JSON, and the page that is committed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from benches.results.page import render_page, sources_of

from bodyseg_data.core import BadConfig

CONTENT = {
    "share": 0.88557,
    "flag": True,
    "ms": {"ours": 10.98, "theirs": 215.2},
    "bytes": 1957696,
    "scores": {"gross_errors": {"beyond_30_mm": 0.0512, "beyond_60_mm": 0.0207, "mean_mm": 7.21}},
    "command": "tools/bench network",
    "codecs": {"ours, compiled": {"ms": 0.25}},
    "times": [{"task": "scores", "threads": 1, "ms": 5}, {"task": "scores", "threads": 2, "ms": 3}],
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "a.json").write_text(json.dumps(CONTENT))
    (tmp_path / "broken.json").write_text("{")
    return tmp_path


@pytest.mark.parametrize(
    ("place", "shown"),
    [
        ("a.share | percent(1)", "88.6"),
        ("a.share | percent", "89"),
        ("a.ms.ours | number(2)", "10.98"),
        ("-a.ms.ours | number(1)", "−11.0"),
        ("(a.ms.ours - a.ms.ours - 0.01) | number(1)", "0.0"),
        ("a.bytes | number", "1 957 696"),
        ("a.command", "tools/bench network"),
        ('(a.times | find(task="scores", threads=2)).ms | number', "3"),
        ("a.times[0].ms | number", "5"),
        ('a.codecs["ours, compiled"].ms | number(2)', "0.25"),
        ("(a.ms.theirs / a.ms.ours) | number(1)", "19.6"),
        ("charts.left_out[0]", "codec"),
        ("a.scores | gross", "5.1 % beyond 30 mm and 2.1 % beyond 60 mm, 7.2 mm on average"),
        ("a.ms | gross", "not measured"),
        ("range.command", "a file may be called as a function of Jinja2"),
    ],
)
def test_places_are_filled(folder: Path, place: str, shown: str) -> None:
    (folder / "range.json").write_text('{"command": "a file may be called as a function of Jinja2"}')
    assert render_page(f"a {{{{ {place} }}}} b\n", folder, {"charts": {"left_out": ["codec"]}}) == f"a {shown} b\n"


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("a.gone | percent(1)", "cannot be filled: 'dict object' has no attribute 'gone'"),
        ("a.gone", "cannot be filled: 'dict object' has no attribute 'gone'"),
        ("a.times[2].ms | number", "cannot be filled: list object has no element 2"),
        ('(a.times | find(task="labels")).ms | number', "cannot be filled: no entry has task = labels"),
        ("a.command | number", "cannot be filled: tools/bench network is no number"),
        ("a.flag | percent", "cannot be filled: True is no number"),
        ("a.share", "cannot be filled: 0.88557 is no text and has no format"),
        ("(1 / 0) | number", "cannot be filled: division by zero"),
        ("[] | table", "cannot be filled: a table needs an entry"),
        ("a.command | table", "cannot be filled: 'str' object has no attribute 'values'"),
        ("a.share | number(", "is no Jinja2: unexpected '}'"),
        ("a.share | per_cent", "is no Jinja2: No filter named 'per_cent'."),
    ],
)
def test_a_place_that_cannot_be_filled_is_named_by_its_line(folder: Path, place: str, message: str) -> None:
    with pytest.raises(BadConfig) as caught:
        render_page(f"# Results\n\n{{{{ {place} }}}}", folder)
    assert str(caught.value).startswith(f"line 3 of the template {message}")


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("gone.share | number", "cannot read .*gone.json: No such file or directory"),
        ("broken.share | number", "broken.json is not JSON: "),
    ],
)
def test_a_file_that_cannot_be_read_is_named(folder: Path, place: str, message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        render_page(f"{{{{ {place} }}}}", folder)


def test_sources_are_listed_once() -> None:
    template = "{{ b.x }} {{ a.y }} {{ b.z }} {% for row in c.rows %}{{ row.t }}{% endfor %} {{ sources }}"
    assert sources_of(template) == ["a.json", "b.json", "c.json"]


def processor(folder: Path, name: str, hardware: str, **figures: object) -> None:
    (folder / "processors" / name).mkdir(parents=True, exist_ok=True)
    origin = {"command": "tools/bench it", "commit": "0123", "hardware": hardware}
    (folder / "processors" / name / "it.json").write_text(json.dumps(origin | figures))


def test_processors_stand_side_by_side(folder: Path) -> None:
    processor(folder, "b-2-cores", "2 cores of B (x86_64), 4 GiB", over={"png": 4.43})
    processor(folder, "a-1-core", "1 cores of A (x86_64), 4 GiB", over={"png": 2.36, "raw": 0.5})
    (folder / "processors" / "a-1-core" / "other.json").write_text('{"hardware": "1 cores of A", "x": 1}')

    def shown(place: str) -> str:
        return render_page(f"{{{{ {place} }}}}", folder)

    assert shown('processors | each("it", "over", "png") | span(1)') == "2.4 to 4.4"
    assert shown('processors | each("it", "over", "png") | span') == "2 to 4"
    assert shown('processors | each("other", "x") | span(1)') == "1.0"
    assert shown("processors[0].name + processors[1].folder") == "A, 1 coreb-2-cores"
    rows = render_page("{{ a.command }} {% for one in processors %}{{ one.name }} {% endfor %}", folder)
    assert rows == "tools/bench network A, 1 core B, 2 cores "
    assert sources_of("{{ a.x }} {{ processors }} {{ sources }}") == ["a.json"]
    (folder / "processors" / "a-1-core" / "other.json").unlink()
    table = render_page("{{ processors[0].name }}\n{{ sources }}", folder)
    assert "| [processors/b-2-cores/it.json](processors/b-2-cores/it.json) | `tools/bench it` | 0123 | 2 cores" in table
    for place, message in {
        'processors | each("it", "over", "raw") | span': "'raw'",
        'processors | each("none", "x") | span': "a span needs a number",
        'processors | each("it", "command") | span': "tools/bench it is no number",
    }.items():
        with pytest.raises(BadConfig, match=f"line 1 of the template cannot be filled: {message}"):
            shown(place)


def test_a_result_in_the_folder_of_another_processor_is_refused(folder: Path) -> None:
    processor(folder, "b-2-cores", "2 cores of A (x86_64), 4 GiB")
    with pytest.raises(
        BadConfig, match=r"it.json was measured on 2 cores of A .*: it belongs into processors/a-2-cores$"
    ):
        render_page("{{ processors[0].name }}", folder)
    processor(folder, "b-2-cores", "a fast machine")
    with pytest.raises(BadConfig, match=r"^hardware must read 'N cores of PROCESSOR .*', found 'a fast machine'$"):
        render_page("{{ processors[0].name }}", folder)


def test_tables_are_made_of_records(folder: Path) -> None:
    (folder / "t.json").write_text('{"rows": [{"what": "noise", "points": -1.5}, {"what": "all", "points": 0}]}')
    expected = "| what | points |\n| --- | --- |\n| noise | -1.5 |\n| all | 0 |"
    assert render_page("{{ t.rows | table }}", folder) == expected
    chosen = render_page('{{ t.rows | selectattr("what", "equalto", "all") | table }}', folder)
    assert chosen == expected.replace("| noise | -1.5 |\n", "")


def test_every_file_says_where_it_is_from(folder: Path) -> None:
    origin = '"command": "tools/bench b", "commit": "0123", "hardware": "2 cores"'
    (folder / "b.json").write_text(f'{{"x": 1, {origin}}}')
    table = render_page("{{ b.x | number }}\n{{ sources }}", folder).splitlines()
    assert table[1] == "| file | command | commit | hardware | load before · after |"
    assert table[3] == "| [b.json](b.json) | `tools/bench b` | 0123 | 2 cores | – |"
    for loads, shown in {
        '"load_before": 0.254': "0.25 · –",
        '"load_before": 0, "load_after": 2': "0.00 · 2.00",
    }.items():
        (folder / "b.json").write_text(f'{{"x": 1, {origin}, {loads}}}')
        row = render_page("{{ b.x | number }}\n{{ sources }}", folder).splitlines()[3]
        assert row == f"| [b.json](b.json) | `tools/bench b` | 0123 | 2 cores | {shown} |"
    with pytest.raises(BadConfig, match="a.json must say its command, commit, hardware"):
        render_page("{{ a.share | percent }} {{ sources }}", folder)
