"""Extension of Sphinx that docs/conf.py names: pages of modules and commands, notebooks, and the order of all pages."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from docutils import nodes
from myst_parser.parsers.sphinx_ import MystParser
from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx

from benches.site.commands import described_commands
from benches.site.contents import GENERATED, OUTSIDE, OVERVIEWS, linked_inside, moved_inside, with_toctrees
from benches.site.docstrings import as_rst, parameters, with_defaults
from benches.site.finishing import keep_numbers_whole, link_pictures, mark_short_code
from benches.site.modules import public_names, room_page, rooms
from benches.site.notebooks import as_markdown
from bodyseg_model.commands.cli import COMMANDS

_COMMANDS_MARK: Final = "<!-- every command with its options -->"
_NAMES_MARK: Final = "<!-- every public name -->"
_ROOMS_MARK: Final = "<!-- every room with its modules -->"


class Notebook(MystParser):
    """Parser of notebooks, which reads them as Markdown."""

    supported = ("notebook",)

    def parse(self, inputstring: str, document: Any) -> None:
        """Read a notebook's JSON into a document."""
        super().parse(as_markdown(inputstring), document)


def setup(app: Sphinx) -> dict[str, bool]:
    """Connect this extension to Sphinx."""
    app.add_source_suffix(".ipynb", "notebook")
    app.add_source_parser(Notebook)
    app.add_lexer("rooms", TextLexer)  # the list of rooms in architecture.md, which tests read
    app.connect("builder-inited", write_pages)
    app.connect("autodoc-process-docstring", convert_docstring)
    app.connect("autodoc-process-signature", convert_signature)
    app.connect("source-read", fill_page)
    app.connect("doctree-resolved", finish_page)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def write_pages(app: Sphinx) -> None:
    """Write the pages that docs does not hold: the rooms' modules, and files that lie beside docs."""
    folder = Path(app.srcdir) / GENERATED
    folder.mkdir(exist_ok=True)
    for outside, page in OUTSIDE.items():
        _write(folder / page, moved_inside((Path(app.srcdir).parent / outside).read_text()))
    for room, modules in rooms().items():
        _write(folder / f"{room}.md", room_page(room, modules))


def _write(path: Path, text: str) -> None:
    if not path.exists() or path.read_text() != text:  # an unchanged page is not built again
        path.write_text(text)


def convert_docstring(_: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]) -> None:
    """Put reStructuredText in the place of a docstring's lines."""
    lines[:] = as_rst(lines, parameters(value))


def convert_signature(*given: Any) -> tuple[str | None, str | None]:
    """Return a signature and what it returns, the last two arguments, with defaults that are Python."""
    signature, returned = given[-2:]
    return signature and with_defaults(signature), returned


def fill_page(_: Sphinx, name: str, source: list[str]) -> None:
    """Bend a page's links to the site, and put into it what its marks ask for."""
    if name.startswith(f"{GENERATED}/"):
        return
    text = linked_inside(source[0])
    if name in OVERVIEWS:
        text = with_toctrees(text)
    if _COMMANDS_MARK in text:
        text = text.replace(_COMMANDS_MARK, described_commands(COMMANDS))
    if _NAMES_MARK in text:
        text = text.replace(_NAMES_MARK, public_names())
    if _ROOMS_MARK in text:
        pages = "\n".join(f"/{GENERATED}/{room}" for room in rooms())
        text = text.replace(_ROOMS_MARK, f"```{{toctree}}\n:maxdepth: 1\n\n{pages}\n```")
    source[0] = text


def finish_page(app: Sphinx, page: nodes.document, name: str) -> None:
    """Change a page whose links are resolved, before it is written."""
    mark_short_code(page)
    keep_numbers_whole(page)
    link_pictures(page, name, {path: file for path, (_, file) in app.env.images.items()})
