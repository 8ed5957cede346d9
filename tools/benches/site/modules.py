"""Pages of modules: one a room, with what the docstrings of its modules say, and a table of the public names."""

from __future__ import annotations

import ast
import inspect
import pkgutil
from collections.abc import Iterator, Sequence
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import Final

import bodyseg_data
import bodyseg_model

PACKAGES: Final = (bodyseg_data, bodyseg_model)

_COMMANDS: Final = "commands"
"""The room that the page of commands describes."""

_MAY_BREAK: Final = "\u200b"
"""A space without width, at which a long title may be broken."""


def rooms() -> dict[str, list[str]]:
    """Return room -> the names of its modules, the room itself first."""
    return {
        f"{package.__name__}.{room.name}": [*_modules(package, room.name)]
        for package in PACKAGES
        for room in pkgutil.iter_modules(package.__path__)
        if room.ispkg and room.name != _COMMANDS
    }


def _modules(package: ModuleType, room: str) -> Iterator[str]:
    name = f"{package.__name__}.{room}"
    yield name
    for module in pkgutil.walk_packages([f"{folder}/{room}" for folder in package.__path__], f"{name}."):
        yield module.name


def room_page(room: str, modules: Sequence[str]) -> str:
    """Return the Markdown page of a room: what each of its modules documents, under the module's name."""
    lines = [f"# {room.replace('.', '.' + _MAY_BREAK)}", ""]
    for module in modules:
        lines += [f"## {module.removeprefix(f'{room}.')}", ""] if module != room else []
        lines += ["```{eval-rst}", f".. automodule:: {module}", "```", ""]
    return "\n".join(lines)


def public_names() -> str:
    """Return a table of the names that each package promises, each with the first sentence that documents it."""
    lines = []
    for package in PACKAGES:
        lines += [f"## {package.__name__}", "", "| name | meaning |", "| --- | --- |"]
        for name in package.__all__:
            home = home_of(package.__name__, name)
            text = " ".join(documentation(home, name).partition("\n\n")[0].split())  # code may follow
            lines.append(f"| {{py:obj}}`{name} <{home}.{name}>` | {text.partition('. ')[0].rstrip('.:')} |")
        lines.append("")
    return "\n".join(lines)


def home_of(module: str, name: str) -> str:
    """Return the module that defines what `module` offers by this name, through as many doors as there are."""
    source = _imported(module).get(name)
    return module if source is None else home_of(source, name)


@cache
def _imported(module: str) -> dict[str, str]:
    """Name -> the module that `module` imports it from, the first one."""
    nodes = [node for node in ast.walk(_tree(module)) if isinstance(node, ast.ImportFrom)]
    return {alias.name: node.module for node in reversed(nodes) if node.module for alias in node.names}


@cache
def _tree(module: str) -> ast.Module:
    return ast.parse(inspect.getsource(import_module(module)))


def documentation(module: str, name: str) -> str:
    """Return the docstring of what a module defines by this name, also that of a constant, which stands below it."""
    statements = _tree(module).body
    for node, after in zip(statements, [*statements[1:], None], strict=True):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name:
            return ast.get_docstring(node) or ""
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if any(isinstance(target, ast.Name) and target.id == name for target in targets):
            below = after.value if isinstance(after, ast.Expr) else None
            return str(below.value) if isinstance(below, ast.Constant) else ""
    raise LookupError(f"{module} does not define {name}")
