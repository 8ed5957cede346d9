"""The page of results: numbers out of JSON, and the page that is committed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from benches.charts.page import render_page, sources_of

from bodyseg_data.core.errors import BadConfig

CONTENT = {
    "share": 0.88557,
    "ms": {"ours": 10.98, "theirs": 215.2},
    "bytes": 1957696,
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
        ("a.json share %1", "88.6"),
        ("a.json ms.ours .2", "10.98"),
        ("a.json bytes 0", "1 957 696"),
        ("a.json command text", "tools/bench network"),
        ("a.json times[task=scores][threads=2].ms 0", "3"),
        ("a.json times.0.ms 0", "5"),
        ("a.json codecs.ours, compiled.ms .2", "0.25"),
        ("a.json ms.theirs / ms.ours .1", "19.6"),
    ],
)
def test_places_are_filled(folder: Path, place: str, shown: str) -> None:
    assert render_page(f"a {{{{{place}}}}} b", folder) == f"a {shown} b"


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("a.json gone %1", "{{a.json gone %1}} cannot be filled: KeyError: 'gone'"),
        ("a.json times[task=labels].ms 0", "LookupError: no entry has task = labels"),
        ("a.json command 0", "TypeError: 'tools/bench network' is no number"),
        ("a.json ms text", "is neither text nor a number"),
        ("a.json share]x 0", "is no path from its character 6 on"),
        ("a.json share", "a place must be a file, a path and a format"),
        ("none.json share 0", "none.json, which is not there"),
        ("broken.json share 0", "broken.json must be JSON"),
    ],
)
def test_a_place_that_cannot_be_filled_is_named(folder: Path, place: str, message: str) -> None:
    with pytest.raises(BadConfig) as caught:
        render_page(f"{{{{{place}}}}}", folder)
    assert message in str(caught.value)


def test_sources_are_listed_once() -> None:
    assert sources_of("{{b.json x 0}} {{a.json y 0}} {{b.json z 0}} {{sources}}") == ["a.json", "b.json"]


def test_tables_are_made_of_records(folder: Path) -> None:
    (folder / "t.json").write_text('{"rows": [{"what": "noise", "points": -1.5}, {"what": "all", "points": 0}]}')
    expected = "| what | points |\n| --- | --- |\n| noise | -1.5 |\n| all | 0 |"
    assert render_page("{{t.json rows table}}", folder) == expected
    assert render_page("{{t.json rows[what=all] table}}", folder) == expected.replace("| noise | -1.5 |\n", "")


def test_columns_are_chosen_and_formatted(folder: Path) -> None:
    rows = (
        '[{"what": "noise", "share_of_wrong": 0.125, "lift": null}, {"what": "pose", "share_of_wrong": 1, "lift": 2}]'
    )
    (folder / "t.json").write_text(f'{{"rows": {rows}}}')
    expected = "| what | share of wrong, % | lift |\n| --- | --- | --- |\n| noise | 12.5 |  |\n| pose | 100.0 | 2.0 |"
    assert render_page("{{t.json rows table what share_of_wrong:%1 lift:.1}}", folder) == expected


def test_every_file_says_where_it_is_from(folder: Path) -> None:
    (folder / "b.json").write_text('{"x": 1, "command": "tools/bench b", "commit": "0123", "hardware": "2 cores"}')
    table = render_page("{{b.json x 0}}\n{{sources}}", folder).splitlines()
    assert table[1] == "| file | command | commit | hardware |"
    assert table[3] == "| [b.json](b.json) | `tools/bench b` | 0123 | 2 cores |"
    with pytest.raises(BadConfig, match="a.json must say its command, commit, hardware"):
        render_page("{{a.json share %1}} {{sources}}", folder)
