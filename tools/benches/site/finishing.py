"""The last changes to a page of the site: short code and numbers stay whole, and pictures lead to their files."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Final

from docutils import nodes

SHORT: Final = 28
"""Most letters of code that is never broken between two lines; a telephone's line holds more."""

_PICTURES: Final = "_images"
"""Folder of the site into which Sphinx copies pictures."""


def mark_short_code(page: nodes.document) -> None:
    """Give code of at most `SHORT` letters in running text the class that the style sheet keeps whole."""
    for code in page.findall(nodes.literal):
        if len(code.astext()) <= SHORT:
            code["classes"].append("short")


_INSIDE: Final = re.compile(r"(?<=\d) (?=\d{3}\b|%|±|×)|(?<=[±×]) (?=\d)")
"""Blanks inside of "1 957 696", "88.5 %", "72.2 ± 0.9 %" and "640 × 480"."""


def keep_numbers_whole(page: nodes.document) -> None:
    """Let no line end inside of a number, before its per cent, or at the sign between two."""
    for text in [*page.findall(nodes.Text)]:
        whole = _INSIDE.sub("\N{NO-BREAK SPACE}", text)
        if whole != text and not isinstance(text.parent, nodes.literal | nodes.FixedTextElement):
            text.parent.replace(text, nodes.Text(whole))


def link_pictures(page: nodes.document, name: str, files: Mapping[str, str]) -> None:
    """Link pictures to their files, so that a chart can be read in its full size on a narrow screen.

    name: of the page, with the folders that it is in. files: path of a picture below docs -> its name on the site.
    """
    above = "../" * name.count("/")
    for picture in [*page.findall(nodes.image)]:
        if picture["uri"] in files and not isinstance(picture.parent, nodes.reference):
            link = nodes.reference(refuri=f"{above}{_PICTURES}/{files[picture['uri']]}")
            picture.replace_self(link)
            link += picture
