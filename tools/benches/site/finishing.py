"""The last changes to a page of the site: short code stays whole, and pictures lead to their files."""

from __future__ import annotations

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
