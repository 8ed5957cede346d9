"""Order and links of the site's pages, from the lists of links of docs/index.md and of the other overviews."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Final

OVERVIEWS: Final = ("index", "decisions/README")
"""Documents whose lists of links give the order of the site's pages; the first is the front page."""

OUTSIDE: Final[Mapping[str, str]] = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
"""Files beside docs that are pages of the site -> their names among the generated pages."""

GENERATED: Final = "generated"
"""Folder inside docs for pages that are written by each build."""

_HEADING: Final = re.compile(r"^## (.+)$", re.MULTILINE)
_ENTRY: Final = re.compile(r"^ *- [^\n]*?\]\(([^)#:\n]+\.(?:md|ipynb))[)#]", re.MULTILINE)
_COMMENT: Final = re.compile(r"<!--.*?-->", re.DOTALL)
_SOURCE: Final = re.compile(r"\[([^\]]+)\]\((?:\.\./)+(?:bodyseg_data|bodyseg_model|tools|tests)[^)]*\)")


def sections(text: str) -> dict[str, list[str]]:
    """Return heading -> the pages of its list in their order: the first link of every entry."""
    parts = _HEADING.split(_COMMENT.sub("", text))
    return {title: _ENTRY.findall(body) for title, body in zip(parts[1::2], parts[2::2], strict=True)}


def with_toctrees(text: str) -> str:
    """Return an overview with a hidden table of contents for each of its sections that lists pages."""
    trees = [_toctree(title, pages) for title, pages in sections(text).items() if pages]
    return "\n".join([text, *trees])


def _toctree(title: str, pages: Sequence[str]) -> str:
    return "\n".join(["```{toctree}", ":hidden:", f":caption: {title}", "", *pages, "```", ""])


def linked_inside(text: str) -> str:
    """Return the text of a page of docs with its links out of docs bent to pages of the site.

    A link to a source file becomes its text: the site shows modules, but no files.
    """
    for name, page in OUTSIDE.items():
        text = text.replace(f"](../{name}", f"]({GENERATED}/{page}").replace(f"/../{name}", f"/{GENERATED}/{page}")
    return _SOURCE.sub(r"\1", text)


def moved_inside(text: str) -> str:
    """Return the text of a file beside docs as a page among the generated ones, with its links bent to match."""
    for name, page in OUTSIDE.items():
        text = text.replace(f"]({name}", f"]({page}")
    text = re.sub(r"\]\(README\.md[^)]*\)", "](../index.md)", text)
    return _SOURCE.sub(r"\1", re.sub(r"\]\(docs/", "](../", text))
