"""The documentation names files, modules, commands, options and links that exist."""

from __future__ import annotations

import ast
import contextlib
import io
import itertools
import re
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path

import pytest
from benches.__main__ import ALL
from benches.__main__ import main as tools_main
from benches.bench import BENCHES
from benches.site.contents import OUTSIDE, sections
from benches.site.notebooks import as_markdown
from folders import DOCS, MADE_PAGES, PAGES, ROOT

import bodyseg_data
import bodyseg_model
from bodyseg_model.commands import main as bodyseg_main
from bodyseg_model.commands.cli import COMMANDS

DOCUMENTS = sorted([*ROOT.glob("*.md"), *PAGES, *(DOCS / "decisions").glob("*.md")])
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))

HOMES = {"bodyseg_data": ROOT, "bodyseg_model": ROOT, "benches": ROOT / "tools"}
"""Package -> the folder that holds it."""

ONLY_IN_A_CHECKOUT = ("bench", "card", "chart", "demo", "landmarks")

FILE = re.compile(r"(?<![\w./-])(?:bodyseg_data|bodyseg_model|tools|tests|docs)/(?:[\w./-]*[\w/])?")
PYTHON_FILE = re.compile(r"(?<![\w./-])[\w/]+\.py\b")
DOTTED_NAME = re.compile(rf"(?<![\w./-])(?:{'|'.join(HOMES)})(?:\.[A-Za-z_]\w*)+(?!/)")
MEMBER = re.compile(r"`([A-Z]\w+)\.([a-z]\w*)")
CLASS = re.compile(r"^ *class (\w+)", re.MULTILINE)
BENCH = re.compile(r"\b(?:tools/|`)bench ([a-z_]+)")
COMMAND = re.compile(
    r"(?:\btools/|^ *bodyseg |`bodyseg |-m bodyseg_model )(\w+(?:-\w+)*)(?![\w./-]| \d)([^`\n]*)", re.MULTILINE
)
"""A command's name, which is no folder, file or format ("bodyseg shards 5"), and the rest of its line."""

OPTION = re.compile(r"(?<=\s)--[a-z][a-z-]*")
LINK = re.compile(r"\]\(([^)\s]+)\)")
COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
EXAMPLE = re.compile(r"```python\n(.*?)```", re.DOTALL)


def defined_in(body: Sequence[ast.stmt]) -> Iterator[tuple[str, Sequence[ast.stmt]]]:
    """Names that statements define, each with the statements inside it."""
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name, node.body
        elif isinstance(node, ast.Import | ast.ImportFrom):
            yield from ((alias.asname or alias.name, ()) for alias in node.names)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            each = (name for target in targets for name in getattr(target, "elts", [target]))
            yield from ((name.id, ()) for name in each if isinstance(name, ast.Name))
        elif isinstance(node, ast.If):
            yield from defined_in([*node.body, *node.orelse])


@cache
def module_body(file: Path) -> Sequence[ast.stmt]:
    return ast.parse(file.read_text()).body


def classes_in(body: Sequence[ast.stmt]) -> Iterator[ast.ClassDef]:
    """Classes that statements define, at any depth."""
    for node in body:
        if isinstance(node, ast.ClassDef):
            yield node
        yield from classes_in(getattr(node, "body", ()))


def home_of(name: str, body: Sequence[ast.stmt]) -> str | None:
    """The module of the project from which statements, as of a door, import a name; None if they do not."""
    for node in body:
        if isinstance(node, ast.If) and (found := home_of(name, node.body)):
            return found
        if isinstance(node, ast.ImportFrom) and name in (alias.asname or alias.name for alias in node.names):
            return node.module if node.module and node.module.partition(".")[0] in HOMES else None
    return None


@cache
def is_defined(name: str) -> bool:
    """Whether a dotted name is a package, a module, or what one of them defines, down to a class's members."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        folder = HOMES[parts[0]].joinpath(*parts[:end])
        file = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
        if not file.is_file():
            continue
        body = module_body(file)
        if end < len(parts) and (home := home_of(parts[end], body)):
            return is_defined(".".join([home, *parts[end:]]))
        for before, part in itertools.pairwise(parts[end - 1 :]):
            held = dict(defined_in(body))
            if part not in held and part not in members(before):
                return False
            body = held.get(part, ())
        return True
    return False


def imported(text: str) -> Iterator[str]:
    """Dotted names that a document's examples import from the project."""
    for example in EXAMPLE.findall(text):
        for node in ast.walk(ast.parse(example)):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.partition(".")[0] in HOMES:
                yield from (f"{node.module}.{alias.name}" for alias in node.names)


def anchors(text: str) -> set[str]:
    """The anchors that a page's headings get."""
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in HEADING.findall(text)}


def is_reached(link: str, text: str, folder: Path) -> bool:
    """Whether a link of a document in `folder` ends at a file, and at a heading of it if it names one."""
    if "://" in link or link.startswith("data:"):
        return True
    name, _, anchor = link.partition("#")
    target = folder / name if name else None
    if target is not None and not target.exists():
        return False
    return not anchor or anchor in anchors(text if target is None else target.read_text())


@cache
def python_files() -> list[str]:
    """Paths of all Python files of the project, with a slash before each."""
    homes = (ROOT / name for name in ("bodyseg_data", "bodyseg_model", "tools", "tests", "docs"))
    return [f"/{path.relative_to(ROOT).as_posix()}" for home in homes for path in home.rglob("*.py")]


@cache
def homes_of_classes() -> dict[str, list[Path]]:
    """Class -> the files of the project that define one of this name."""
    homes: dict[str, list[Path]] = {}
    for path in python_files():
        file = ROOT / path[1:]
        for name in CLASS.findall(file.read_text()):
            homes.setdefault(name, []).append(file)
    return homes


@cache
def members(kind: str) -> frozenset[str]:
    """Names that a class's body and those of its bases in the project define, together for classes of one name."""
    found: set[str] = set()
    for file in homes_of_classes().get(kind, ()):
        for node in classes_in(module_body(file)):
            if node.name == kind:
                found.update(name for name, _ in defined_in(node.body))
                found.update(*(members(base) for base in map(ast.unparse, node.bases) if base != kind))
    return frozenset(found)


def wrong_names(text: str, folder: Path) -> list[str]:
    """Files, modules, commands, benches and links of a document in `folder` that are not there."""
    wrong = [f"file {name}" for name in FILE.findall(text) if not (ROOT / name).exists()]
    known = python_files()
    wrong += [
        f"file {name}" for name in PYTHON_FILE.findall(text) if not any(path.endswith(f"/{name}") for path in known)
    ]
    wrong += [f"name {name}" for name in [*DOTTED_NAME.findall(text), *imported(text)] if not is_defined(name)]
    for kind, name in MEMBER.findall(text):
        if kind in homes_of_classes() and name not in members(kind):
            wrong.append(f"name {kind}.{name}")
    wrong += [f"command {name}" for name, _ in COMMAND.findall(text) if not (ROOT / "tools" / name).exists()]
    wrong += [f"bench {name}" for name in BENCH.findall(text) if name not in BENCHES and f"bench {name}" not in ALL]
    links = LINK.findall(COMMENT.sub("", text))
    return wrong + [f"target {link}" for link in links if not is_reached(link, text, folder)]


def test_whatever_a_document_names_exists() -> None:
    texts = {path: path.read_text() for path in DOCUMENTS} | {path: as_markdown(path.read_text()) for path in NOTEBOOKS}
    found = {str(path.relative_to(ROOT)): wrong_names(text, path.parent) for path, text in texts.items()}
    assert not {document: wrong for document, wrong in found.items() if wrong}


def test_files_that_docstrings_of_the_wheel_name_exist() -> None:
    sources = [path for home in ("bodyseg_data", "bodyseg_model") for path in (ROOT / home).rglob("*.py")]
    named = {path: set(FILE.findall(path.read_text())) for path in sources}
    assert not [f"{path}: {name}" for path, names in named.items() for name in names if not (ROOT / name).exists()]


def test_names_of_nothing_are_found() -> None:
    text = """
# One heading

See `bodyseg_data/loading/nowhere.py`, `nowhere.py`, `Loader.nothing`, `Loader.state_dict()`,
`bodyseg_data.loading.Loader.nothing`, `tools/nothing`,
[a page](nowhere.md), [a heading](#two-headings), and tools/bench nothing. There are `bodyseg_data/loading/loaders.py`,
`loaders.py`, `bodyseg_data.loading.Loader.state_dict`, `bodyseg_data.RangeImages.batches`, `tools/shard --plan`,
[a page](glossary.md#glossary), [a heading](#one-heading) and `tools/bench codec`.

```python
from bodyseg_data.loading.loaders import Loader, Nothing
```
"""
    assert wrong_names(text, DOCS) == [
        "file bodyseg_data/loading/nowhere.py",
        "file tools/nothing",
        "file bodyseg_data/loading/nowhere.py",
        "file nowhere.py",
        "name bodyseg_data.loading.Loader.nothing",
        "name bodyseg_data.loading.loaders.Nothing",
        "name Loader.nothing",
        "command nothing",
        "bench nothing",
        "target nowhere.md",
        "target #two-headings",
    ]


def test_every_decision_is_in_the_index() -> None:
    folder = DOCS / "decisions"
    index = (folder / "README.md").read_text()
    pages = {path.name for path in folder.glob("*.md")} - {"README.md"}
    assert set(LINK.findall(index)) == pages | {"../explanation/architecture.md"}
    titles = {name: (folder / name).read_text().partition("\n")[0].partition(". ")[2] for name in pages}
    assert not [name for name, title in titles.items() if f"- [{name[:4]}]({name}) {title}" not in index]


def test_the_front_page_lists_every_page_of_the_site() -> None:
    folder = DOCS
    listed = [page for pages in sections((folder / "index.md").read_text()).values() for page in pages]
    there = {*PAGES, *MADE_PAGES, *folder.glob("notebooks/*.ipynb")} - {folder / "index.md"}
    there |= {folder / "decisions" / "README.md", *(ROOT / name for name in OUTSIDE)}
    assert len(listed) == len(set(listed))
    assert {(folder / page).resolve() for page in listed} == there


def options_on_command_lines() -> dict[str, set[str]]:
    """Command -> the options that the documents' command lines give it."""
    found: dict[str, set[str]] = {}
    for document in DOCUMENTS:
        for name, rest in COMMAND.findall(document.read_text().replace("\\\n", " ")):
            found.setdefault(name, set()).update(OPTION.findall(rest.partition(" # ")[0]))
    return found


def options_of(name: str) -> set[str]:
    """The options that a command's help lists, or those of a group's commands."""
    out = io.StringIO()
    group = [each.split() for each in (*COMMANDS, *ALL) if each.startswith(f"{name} ")]
    for words in [*group, [name]] if name in ONLY_IN_A_CHECKOUT else group or [[name]]:
        with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
            (tools_main if name in ONLY_IN_A_CHECKOUT else bodyseg_main)([*words, "--help"])
    return set(re.findall(r"--[a-z][a-z-]*", out.getvalue()))


def test_commands_have_the_options_that_documents_give_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")  # no option's name is wrapped
    given = options_on_command_lines()
    assert {"--source", "--plan"} <= given["shard"]
    assert "--json" in options_of("bench")
    wrong = {name: options - options_of(name) for name, options in given.items() if options}
    assert not {name: options for name, options in wrong.items() if options}


def test_documents_and_programs_beside_them_import_from_the_two_doors_alone() -> None:
    texts = {path: path.read_text() for path in PAGES} | {path: as_markdown(path.read_text()) for path in NOTEBOOKS}
    programs = sorted((DOCS / "examples").glob("*.py"))
    texts |= {path: f"```python\n{path.read_text()}```" for path in programs}
    past = {
        str(path.relative_to(DOCS)): [name for name in imported(text) if name.count(".") > 1]
        for path, text in texts.items()
    }
    assert programs and not {name: names for name, names in past.items() if names}


def test_names_that_pages_call_are_those_of_the_doors() -> None:
    """In the running text; blocks of Python run in test_code_blocks.py. Names of other libraries are theirs."""
    others = {"Arm", "CombinedStreamingDataset", "DataLoader", "Stream", "Trainer"}  # of a mesh, LitData, torch, ...
    found = set[str]()
    for page in PAGES:
        text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        for code in re.findall(r"`([^`\n]+)`", text):
            found |= set(re.findall(r"(?<![\w./\"-])([A-Z][a-z]+(?:[A-Z][a-z]*)*)(?=[(.])", code))
    assert found - others <= {*bodyseg_data.__all__, *bodyseg_model.__all__}
