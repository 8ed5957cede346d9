"""Doors of rooms: the public names of a package, each imported on first use, so that importing a room stays cheap."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_door(package: str, names: Mapping[str, str]) -> tuple[Callable[[str], Any], list[str]]:
    """Return the `__getattr__` and `__all__` of a package's `__init__` (PEP 562).

    package: its dotted name. names: module of the package -> its public names, with spaces between. The same names
    stand in the `__init__` under `TYPE_CHECKING`, where type checkers and readers find them; a test compares the two.
    """
    homes = {name: f"{package}.{module}" for module, public in names.items() for name in public.split()}

    def found(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(homes[name]), name)

    return found, sorted(homes)
