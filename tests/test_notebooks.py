"""The notebooks run from their first cell to their last on a small set, and are kept with their outputs."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import pytest
from benches.demo import Options
from folders import ROOT
from nbformat import v4

NOTEBOOKS: Final = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))

SHORT: Final = {"STEPS": 1, "BATCH_SIZE": 1, "TEST_IMAGES": 1}
"""Parameters that make a training short."""


def read(path: Path) -> Any:
    return v4.reads(path.read_text(encoding="utf-8"))


def with_parameters(source: str, values: dict[str, Any]) -> str:
    """A cell of parameters with other values for those that it has."""
    names = [line.partition(" = ")[0] for line in source.splitlines()]
    return "\n".join(f"{name} = {values[name]!r}" for name in names)


def with_short_parameters(notebook: Any, shards: Path) -> list[Any]:
    """The cells of code, the one of parameters changed to a small set and a short training."""
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    (parameters,) = (cell for cell in cells if "parameters" in cell.metadata.get("tags", ()))
    parameters.source = with_parameters(parameters.source, {"SHARDS": str(shards), **SHORT})
    return cells


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_cells_of_a_notebook_run(
    path: Path, small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here: a kernel takes seconds to start and to import what the other tests have, and runs the same code."""
    import matplotlib.pyplot as plt

    shown: list[int] = []
    monkeypatch.setattr(plt, "show", lambda: shown.extend(plt.get_fignums()))
    monkeypatch.chdir(tmp_path)
    module = ModuleType("cells")
    monkeypatch.setitem(sys.modules, module.__name__, module)  # where dataclasses look for their module
    for number, cell in enumerate(with_short_parameters(read(path), small_set)):
        exec(compile(cell.source, f"{path.name}, cell {number}", "exec"), module.__dict__)
    assert bool(shown) == ("plt.show()" in path.read_text())
    plt.close("all")


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_as_it_ran(path: Path) -> None:
    cells = [cell for cell in read(path).cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == [*range(1, len(cells) + 1)]
    outputs = [output for cell in cells for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not any(output.output_type == "error" for output in outputs)
    assert path.stat().st_size < 200_000
    assert "/tmp/" not in path.read_text()


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_names_the_set_that_its_outputs_show(path: Path) -> None:
    """That of `make demo`, whose views go all around a body."""
    packed = f"bodyseg shard --source open --meshes {Options.meshes} --views {Options.views} --azimuth-span 360"
    assert f"`{packed} --out demo/shards`" in path.read_text()
