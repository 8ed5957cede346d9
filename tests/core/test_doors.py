"""Doors of rooms, on a package of three files: from source, from bytecode alone, and without either."""

from __future__ import annotations

import asyncio
import importlib
import py_compile
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

import bodyseg_data
import bodyseg_model
from bodyseg_data.core import BodysegError
from bodyseg_data.core.doors import lazy_door, signals_held

DOOR = """
from __future__ import annotations
from typing import TYPE_CHECKING
from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from house.hall import Lamp as Lamp, switch
    from house.attic import box
    from house.shed import whole
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
"""


HALL = "Lamp, switch = 'lamp', 'on'"
SHED = "import signal\nsignal.raise_signal(signal.SIGINT)\nwhole = True\n"


@pytest.fixture(params=["source", "bytecode"])
def house(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    folder = tmp_path / "house"
    folder.mkdir()
    files = {"__init__": DOOR, "hall": HALL, "attic": "raise RuntimeError('dust')", "shed": SHED}
    for name, text in files.items():
        path = folder / f"{name}.py"
        path.write_text(text)
        if request.param == "bytecode":  # as in a frozen application
            py_compile.compile(str(path), str(path.with_suffix(".pyc")))
            path.unlink()
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("house")
    for name in [name for name in sys.modules if name.partition(".")[0] == "house"]:
        del sys.modules[name]


def test_names_are_those_imported_for_type_checkers_and_come_on_first_use(house: ModuleType) -> None:
    assert house.__all__ == ["Lamp", "box", "switch", "whole"]
    assert {"Lamp", "box", "switch", "__name__"} <= set(dir(house))
    assert "house.hall" not in sys.modules
    assert (house.Lamp, house.switch) == ("lamp", "on")
    assert "house.attic" not in sys.modules
    with pytest.raises(RuntimeError, match="dust"):
        house.box  # noqa: B018


def test_an_interrupt_waits_until_a_file_is_imported(house: ModuleType) -> None:
    """In a program that handles SIGTERM, as commands do."""
    before = {number: signal.signal(number, signal.default_int_handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with pytest.raises(KeyboardInterrupt):
            house.whole  # noqa: B018
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert sys.modules["house.shed"].whole and house.whole


def test_asyncio_hears_once_of_a_signal_that_is_put_off() -> None:
    async def told() -> list[str]:
        heard = list[str]()
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, heard.append, "ended")
        with signals_held():
            signal.raise_signal(signal.SIGTERM)
        await asyncio.sleep(0.05)
        return heard

    assert asyncio.run(told()) == ["ended"]


def test_other_names_are_refused(house: ModuleType) -> None:
    with pytest.raises(AttributeError, match="module 'house' has no attribute 'lamp'"):
        house.lamp  # noqa: B018
    with pytest.raises(ImportError, match="cannot import name 'TYPE'"):
        exec("from house import TYPE")


def test_a_package_without_such_imports_is_refused() -> None:
    with pytest.raises(ImportError, match="house needs its bytecode: the imports under TYPE_CHECKING"):
        exec("lazy_door('house')", {"lazy_door": lazy_door})


def test_errors_that_commands_and_functions_raise_are_public() -> None:
    public = {name: getattr(package, name) for package in (bodyseg_data, bodyseg_model) for name in package.__all__}
    kinds = {kind.__name__ for kind in BodysegError.__subclasses__() if "bodyseg" in kind.__module__}
    assert len(kinds) > 8 and kinds <= set(public)
    assert issubclass(public["MissingLibrary"], ImportError), "as who guards an import expects"
