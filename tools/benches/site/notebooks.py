"""Notebooks as pages: their text, their code and their kept outputs as one Markdown text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from nbformat import v4


def as_markdown(text: str) -> str:
    """Return the Markdown of a notebook's JSON; pictures among its outputs become data addresses."""
    notebook = v4.reads(text)
    return "\n".join(line for cell in notebook.cells for line in _cell(cell))


def _cell(cell: Mapping[str, Any]) -> Iterator[str]:
    if cell["cell_type"] == "markdown":
        yield from (cell["source"], "")
        return
    yield from ("```python", cell["source"], "```", "")
    for output in cell["outputs"]:
        yield from _output(output)


def _output(output: Mapping[str, Any]) -> Iterator[str]:
    data = output.get("data", {})
    if "image/png" in data:
        yield from (f"![output](data:image/png;base64,{data['image/png'].replace(chr(10), '')})", "")
        return
    shown = output["text"] if output.get("name") == "stdout" else data.get("text/plain", "")
    if shown.strip():  # not what a command says of its progress
        yield from ("```text", shown.rstrip("\n"), "```", "")
