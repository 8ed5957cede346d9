"""Doors of rooms: the public names of a package, each imported on first use, so that importing a room stays cheap."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from types import CodeType, SimpleNamespace
from typing import Any


def lazy_door(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` (PEP 562) for the package whose `__init__` calls this.

    Its names are those that the `__init__` imports under `TYPE_CHECKING`; the call stands in the `else` of that, so
    that type checkers see plain imports, and report a name that is not there. Raises ImportError where a compiler has
    dropped the branch of type checkers, as some that make machine code do.
    """
    frame = sys._getframe(1)
    homes = {name: home for name, home in _all_imports(frame.f_code).items() if name not in frame.f_globals}
    if not homes:
        raise ImportError(f"{package} needs its bytecode: the imports under TYPE_CHECKING, which name what it offers")

    def found(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(homes[name]), name)

    def listed() -> list[str]:
        return sorted({*frame.f_globals, *homes})

    return found, listed, sorted(name for name in homes if not name.startswith("__"))


def _all_imports(code: CodeType) -> dict[str, str]:
    """Return name -> module of what the code of an `__init__` imports, under `TYPE_CHECKING` too.

    The code runs once more, as type checkers read it and with an import that only takes notes. Unlike a search of the
    source, this works where there is bytecode alone, and needs no parser.
    """
    homes: dict[str, str] = {}

    def note(module: str, _globals: object, _locals: object, names: Sequence[str], _level: int) -> SimpleNamespace:
        noted = dict.fromkeys(names, module)
        homes.update(noted)
        return SimpleNamespace(**noted)  # its TYPE_CHECKING is a text, which is true

    with suppress(Exception):  # where a compiler has left other code than type checkers read
        exec(code, {"__builtins__": {"__import__": note}})
    return homes
