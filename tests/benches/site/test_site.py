"""What the site adds to the documents: an order of pages, and pages of commands, modules and notebooks."""

from __future__ import annotations

import json

import pytest
from benches.site.commands import described_commands
from benches.site.contents import linked_inside, moved_inside, sections, with_toctrees
from benches.site.docstrings import as_rst, parameters, with_defaults
from benches.site.finishing import SHORT, keep_numbers_whole, link_pictures, mark_short_code
from benches.site.modules import documentation, public_names, room_page, rooms
from benches.site.notebooks import as_markdown
from docutils import nodes
from docutils.utils import new_document

import bodyseg_data
import bodyseg_model
from bodyseg_data.commands.cli import load_command
from bodyseg_model.commands.cli import COMMANDS

OVERVIEW = """# Title

## Start

- [One](one.md): the first, beside [another](two.md)
- [Elsewhere](https://example.org/page.md)
<!-- - [To come](three.md) -->

## Notes

No list.
"""


def test_the_lists_of_an_overview_are_the_order_of_pages() -> None:
    assert sections(OVERVIEW) == {"Start": ["one.md"], "Notes": []}
    filled = with_toctrees(OVERVIEW)
    assert filled.startswith(OVERVIEW)
    assert filled.count("```{toctree}") == 1
    assert ":caption: Start\n\none.md\n```" in filled


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("[a](../CONTRIBUTING.md#rules)", "[a](generated/contributing.md#rules)"),
        ("[a](../../CHANGELOG.md)", "[a](../generated/changelog.md)"),
        ("[the rig](../bodyseg_data/rigs/paper.toml), [b](b.md)", "the rig, [b](b.md)"),
    ],
)
def test_links_out_of_docs_lead_to_pages_of_the_site(before: str, after: str) -> None:
    assert linked_inside(before) == after


def test_files_beside_docs_become_pages_with_links_that_hold() -> None:
    text = "[a](docs/how-to/rig.md), [b](CHANGELOG.md), [c](README.md#ten-lines)"
    assert moved_inside(text) == "[a](../how-to/rig.md), [b](changelog.md), [c](../index.md)"


def test_every_command_is_described_with_every_option_and_default() -> None:
    text = described_commands(COMMANDS)
    for name, (place, summary) in COMMANDS.items():
        assert f"## bodyseg {name}\n\n{summary[0].upper()}" in text
        assert load_command(place).EXAMPLE in text
    assert "| `--out` | path | required | " in text
    assert "| `--views` | whole number |  | " in text
    assert "| `--distances` | whole number, one or several | `215 255 295` | " in text
    assert "| `--renderer` | `raster`, `embree`, `opengl` | `raster` | " in text
    assert "| `--resume` | switch |  | " in text
    assert "| `FOLDER` | text | required | " in text
    assert "| **Rooms (--source rooms)** |  |  |  |\n| `--samples` | whole number |  | number of rooms |" in text


def test_every_room_and_public_name_has_a_place() -> None:
    found = rooms()
    assert found["bodyseg_data.loading"][0] == "bodyseg_data.loading"
    assert "bodyseg_data.loading.transforms" in found["bodyseg_data.loading"]
    assert "bodyseg_model.networks" in found and "bodyseg_data.commands" not in found
    page = room_page("a.b", ["a.b", "a.b.c"])
    assert page.startswith("# a.\u200bb\n") and "## c\n" in page and page.count(".. automodule:: a.b") == 2
    table = public_names()
    for package in (bodyseg_data, bodyseg_model):
        assert all(f"`{name} <{package.__name__}." in table for name in package.__all__)
    assert "`loader <bodyseg_data.loading.loaders.loader>`" in table, (
        "the link leads to the file's page, not the door's"
    )
    assert "|  |" not in table
    assert "| Writes scenes as a set of shards into the folder `out` |" in table, "without the code below"


def test_short_code_is_marked_and_pictures_lead_to_their_files() -> None:
    page = new_document("page")
    short, long = nodes.literal(text="x" * SHORT), nodes.literal(text="x" * (SHORT + 1))
    linked = nodes.reference(refuri="elsewhere")
    linked += nodes.image(uri="chart.png")
    page += [short, long, nodes.image(uri="chart.png"), nodes.image(uri="https://example.org/a.png"), linked]
    mark_short_code(page)
    link_pictures(page, "results/index", {"chart.png": "chart1.png"})
    assert (short["classes"], long["classes"]) == (["short"], [])
    assert [link["refuri"] for link in page.findall(nodes.reference)] == ["../_images/chart1.png", "elsewhere"]
    assert len([*page.findall(nodes.image)]) == 3
    assert isinstance(page[3], nodes.image), "a picture of another site stays as it is"


def test_no_line_ends_inside_of_a_number() -> None:
    page = new_document("page")
    code = "--sizes 10 100"
    said = nodes.paragraph("", "1 957 696 weights, 72.2 ± 0.9 % of 640 × 480 in 12 runs: ")
    said += nodes.literal("", code)
    page += [said, nodes.literal_block("", code)]
    keep_numbers_whole(page)
    shown = page.astext().replace("\N{NO-BREAK SPACE}", "_")
    assert shown == f"1_957_696 weights, 72.2_±_0.9_% of 640_×_480 in 12 runs: {code}\n\n{code}"


def test_documentation_is_that_of_classes_functions_and_constants() -> None:
    assert documentation("bodyseg_data.labels.classes", "BACKGROUND").startswith(
        "The label of a pixel that shows nothing"
    )
    assert documentation("bodyseg_data.loading.loaders", "loader")
    with pytest.raises(LookupError, match=r"^bodyseg_data.labels.label_map does not define nothing$"):
        documentation("bodyseg_data.labels.label_map", "nothing")


def test_docstrings_keep_their_code_and_lose_no_character() -> None:
    lines = [
        "Scores *all* |x| of a_ `b*`; first: a number.",
        "",
        "    code * 2",
        "",
        "- a list",
        "  goes on *",
        "",
        "Text",
    ]
    assert as_rst(lines, ["first"]) == [
        r"Scores \*all\* \|x\| of a\_ `b*`; **first**: a number.",
        *("", "::", "", "    code * 2", ""),
        *("- a list", r"  goes on \*", "", "Text"),
    ]
    assert as_rst(["a formula:", "", "    x | y", "at once"]) == [
        "a formula:",
        "",
        "::",
        "",
        "    x | y",
        "",
        "at once",
    ]


def test_parameters_are_those_of_the_signature() -> None:
    assert parameters(as_rst) == ["lines", "names"]
    assert parameters("no function") == []
    assert parameters(dict.fromkeys) == [] or "iterable" in parameters(dict.fromkeys)


def test_defaults_without_a_python_form_leave_a_signature_that_sphinx_reads() -> None:
    given = "(drawn: ~typing.Any = <factory>, classes: Classes = Classes('parts33', 33 classes), at: int = 3)"
    assert with_defaults(given) == "(drawn: ~typing.Any = ..., classes: Classes = ..., at: int = 3)"


def test_a_notebook_becomes_text_code_and_outputs() -> None:
    outputs = [
        {"output_type": "stream", "name": "stdout", "text": "said\n"},
        {"output_type": "stream", "name": "stderr", "text": "progress\n"},
        {"output_type": "execute_result", "data": {"text/plain": "7"}, "metadata": {}, "execution_count": 1},
        {"output_type": "display_data", "data": {"image/png": "QUJD\n", "text/plain": "<Image>"}, "metadata": {}},
    ]
    cells = [
        {"cell_type": "markdown", "metadata": {}, "source": "# Title"},
        {"cell_type": "code", "metadata": {}, "source": "3 + 4", "outputs": outputs, "execution_count": 1},
    ]
    notebook = {"nbformat": 4, "nbformat_minor": 4, "metadata": {}, "cells": cells}
    text = as_markdown(json.dumps(notebook))
    assert text.startswith("# Title\n\n```python\n3 + 4\n```\n")
    assert "```text\nsaid\n```" in text and "```text\n7\n```" in text
    assert "(data:image/png;base64,QUJD)" in text and "<Image>" not in text
    assert "progress" not in text
