"""The notebooks run from their first cell to their last on a small set, and are kept with their outputs."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import pytest
from benches.demo import Options
from folders import ROOT
from nbclient import NotebookClient
from nbformat import v4
from traitlets.config import Config

NOTEBOOKS: Final = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))

SHORT: Final = {"STEPS": 2, "BATCH_SIZE": 2, "TEST_IMAGES": 2}
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


def test_the_notebooks_run(small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One after the other in one kernel, whose start takes seconds, each without the names of the others."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.chdir(tmp_path)  # where kernel and client meet, by files
    cells = []
    for path in NOTEBOOKS:
        cells += [v4.new_code_cell("%reset -f"), *with_short_parameters(read(path), small_set)]
    over_files = Config({"KernelManager": {"transport": "ipc"}})  # not over ports, of which it warns
    whole = v4.new_notebook(cells=cells)
    # The kernel is killed behind the last cell: left to end by itself, it takes seconds.
    client = NotebookClient(whole, timeout=120, kernel_name="python3", config=over_files, shutdown_kernel="immediate")
    client.execute()
    assert len(NOTEBOOKS) == 3 and all(cell.execution_count for cell in whole.cells)


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
