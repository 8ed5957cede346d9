"""The digest of code: what changes it, what does not, and which modules are found."""

from __future__ import annotations

import ast
import shutil
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from benches.result_cache import PACKAGES, SourceTree, code_digest, installed_versions
from folders import ROOT

from bodyseg_data.core import BadConfig

VARIANTS, ABLATION = "benches.model.variants.scores", "benches.model.ablation.conditions"
STABILITY = "bodyseg_model.stability.summary"


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of all packages, for one edit at a time."""
    folder = tmp_path_factory.mktemp("checkout")
    for name, source in {**{name: ROOT / name for name in PACKAGES}, "benches": ROOT / "tools" / "benches"}.items():
        shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__", "weights"))
    return folder


@pytest.fixture(scope="module")
def copied(checkout: Path) -> SourceTree:
    return SourceTree({name: checkout / name for name in (*PACKAGES, "benches")})


def digests(tree: SourceTree) -> dict[str, str]:
    return {"scores": tree.digest([VARIANTS, ABLATION]), "stability": tree.digest([STABILITY])}


ChangedBy = Callable[[Mapping[str, Callable[[str], str]]], set[str]]


@pytest.fixture
def changed_by(checkout: Path, copied: SourceTree) -> ChangedBy:
    """Whose digests edits change, file by file."""

    def changed(edits: Mapping[str, Callable[[str], str]]) -> set[str]:
        before = {checkout / file: (checkout / file).read_text() for file in edits}
        try:
            for (path, text), edit in zip(before.items(), edits.values(), strict=True):
                path.write_text(edit(text))
                assert path.read_text() != text
            after = digests(SourceTree({name: checkout / name for name in (*PACKAGES, "benches")}))
        finally:
            for path, text in before.items():
                path.write_text(text)
        return {name for name, digest in digests(copied).items() if digest != after[name]}

    return changed


def test_a_copy_has_the_digest_of_what_is_installed(copied: SourceTree) -> None:
    found = digests(copied)
    assert found == {"scores": code_digest(ABLATION, VARIANTS), "stability": code_digest(STABILITY)}
    assert found["scores"] != found["stability"]


def test_an_edited_artifact_makes_results_stale(changed_by: ChangedBy) -> None:
    assert changed_by({"bodyseg_data/artifacts/noise.py": one_number_more}) == {"scores", "stability"}


def one_number_more(text: str) -> str:
    """The first number that a module's function computes with, and one."""
    functions = [node for node in ast.parse(text).body if isinstance(node, ast.FunctionDef)]
    numbers = (each for node in functions for each in ast.walk(node) if isinstance(each, ast.Constant))
    number = next(each for each in numbers if isinstance(each.value, int | float))
    lines = text.splitlines(keepends=True)
    line = lines[number.lineno - 1]
    lines[number.lineno - 1] = f"{line[: number.col_offset]}{number.value + 1}{line[number.end_col_offset :]}"
    return "".join(lines)


def test_unrelated_commands_do_not(changed_by: ChangedBy) -> None:
    files = (
        "bodyseg_data/commands/inspect.py",
        "bodyseg_model/commands/stability.py",
        "bodyseg_model/training/loop.py",
    )
    assert changed_by(dict.fromkeys(files, lambda text: f"{text}\n_ONE_MORE = 1\n")) == set()


def test_words_and_layout_do_not(changed_by: ChangedBy) -> None:
    edits = {
        "bodyseg_data/artifacts/noise.py": lambda text: f"# A comment.\n\n\n{text}  # Another.\n",
        "bodyseg_data/artifacts/missing_data.py": lambda text: ast.unparse(ast.parse(text)),
        "bodyseg_model/evaluation/scores.py": lambda text: ast.unparse(OtherWords().visit(ast.parse(text))),
    }
    assert changed_by(edits) == set()


class OtherWords(ast.NodeTransformer):
    """Every docstring says something else, and so does every string below a constant."""

    def visit_Expr(self, node: ast.Expr) -> ast.Expr:
        return ast.Expr(ast.Constant("Other words.")) if isinstance(node.value, ast.Constant) else node


@pytest.mark.parametrize(
    ("file", "stale"),
    [
        ("bodyseg_data/rigs/paper.toml", {"scores", "stability"}),
        ("bodyseg_data/meshes/landmark_sets/open.json", {"scores", "stability"}),
    ],
)
def test_data_that_code_reads_counts(file: str, stale: set[str], changed_by: ChangedBy) -> None:
    assert changed_by({file: lambda text: f"{text}\n"}) == stale


@pytest.mark.parametrize(
    ("module", "stale"),
    [
        ("bodyseg_data.artifacts.missing_data", {"scores", "stability"}),
        ("bodyseg_data.artifacts.lost_pixels", {"scores", "stability"}),
        ("bodyseg_data.artifacts.fused_loops", {"scores", "stability"}),  # by `import_module` in a function
        ("bodyseg_data.loading.range_images", {"scores", "stability"}),
        ("bodyseg_model.networks.compact", {"scores", "stability"}),
        ("bodyseg_model.evaluation.evaluation", {"scores", "stability"}),
        ("benches.result_cache", {"scores"}),
        ("bodyseg_data.bodies.sources.hard", {"stability"}),  # by a statement in a function
        ("bodyseg_data.meshes.partitioning", {"scores", "stability"}),  # parts of the template by landmarks
        ("bodyseg_data.commands.cli", set()),
        ("bodyseg_data.commands", set()),
        ("benches.model.ablation.figure", set()),
    ],
)
def test_modules_that_results_depend_on(module: str, stale: set[str], copied: SourceTree) -> None:
    known = {"scores": copied.imported_by([VARIANTS, ABLATION]), "stability": copied.imported_by([STABILITY])}
    assert {name for name, found in known.items() if module in found} == stale


def test_a_module_that_nothing_imports_does_not_count(tmp_path: Path) -> None:
    before = package(tmp_path, {"__init__.py": "", "start.py": ""}).digest(["house.start"])
    assert package(tmp_path, {"hall.py": ""}).digest(["house.start"]) == before
    assert package(tmp_path, {"start.py": "from house import hall"}).digest(["house.start"]) != before


def test_libraries_count_by_their_versions(tmp_path: Path) -> None:
    (tmp_path / "start.py").write_text("import torch.nn, json\nimport_module('anny')\nimport tqdm, numba")

    def with_versions(**versions: str) -> str:
        return SourceTree({"start": tmp_path / "start.py"}, lambda: versions).digest(["start"])

    first = with_versions(torch="2.4", anny="0.6", tqdm="4", numba="0.60")
    assert with_versions(torch="2.4", anny="0.6", tqdm="5", scipy="1") == first
    assert first != with_versions(torch="2.5", anny="0.6") != with_versions(torch="2.4") != first


def test_versions_are_those_installed() -> None:
    assert installed_versions()["numpy"] == [f"numpy {np.__version__}"]


def test_nothing_is_imported(tmp_path: Path) -> None:
    before = set(sys.modules)
    tree = package(tmp_path, {"__init__.py": "raise ImportError", "start.py": "import house.hall", "hall.py": "1 / 0"})
    assert tree.imported_by(["house.start"]) == ["house", "house.hall", "house.start"]
    assert not {name for name in set(sys.modules) - before if name.startswith("house")}


def package(folder: Path, files: dict[str, str]) -> SourceTree:
    for name, text in files.items():
        path = folder / "house" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return SourceTree({"house": folder / "house"})


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("import house.attic.box", {"house.attic", "house.attic.box"}),
        ("from house.attic import box", {"house.attic", "house.attic.box"}),
        ("from house.attic import lid", {"house.attic"}),
        ("from house.attic import *", {"house.attic"}),
        ("from house.attic.box import Lid", {"house.attic", "house.attic.box"}),
        ("from .attic import box", {"house.attic", "house.attic.box"}),
        ("from . import hall", {"house.hall"}),
        ("def f():\n    from house import hall", {"house.hall"}),
        ("if 0:\n    import house.hall", {"house.hall"}),
        ("import_module('house.hall')", {"house.hall"}),
        ("importlib.import_module('.hall', 'house')", {"house.hall"}),
        ("ROOMS = {'big': 'house.hall:Hall', 'small': 'house.attic.Lid'}", {"house.hall", "house.attic"}),
        ("ROOMS = {'big': 'hall'}", set()),
        ("ROOMS = {'big': 'hall'}\nimport_module(f'{__package__}.{ROOMS[x]}')", {"house.hall"}),
        ("import_module(f'house.attic.{x}')", {"house.attic", "house.attic.box", "house.attic.bag"}),
        ("'''house.hall'''", set()),
        ("from house.cellar import deep", {"house.cellar.deep"}),  # a folder without __init__.py
        ("import numpy, housing, json", set()),
        ("raise ValueError('house.: a message')", set()),
    ],
)
def test_imports_of_every_kind_are_followed(text: str, found: set[str], tmp_path: Path) -> None:
    tree = package(
        tmp_path,
        {
            "__init__.py": "",
            "hall.py": "",
            "attic/__init__.py": "lid = 1",
            "attic/box.py": "",
            "attic/bag.py": "",
            "cellar/deep.py": "",
            "start.py": text,
        },
    )
    assert set(tree.imported_by(["house.start"])) == {"house", "house.start"} | found


def test_relative_imports_in_a_package_start_there(tmp_path: Path) -> None:
    attic = {"attic/__init__.py": "from . import box", "attic/box.py": "from .. import hall"}
    tree = package(tmp_path, {"__init__.py": "", "hall.py": "", **attic})
    assert tree.imported_by(["house.attic"]) == ["house", "house.attic", "house.attic.box", "house.hall"]


def test_modules_may_import_each_other(tmp_path: Path) -> None:
    files = {"__init__.py": "from house import b", "a.py": "import house.b", "b.py": "import house.a\nONE = 1"}
    tree = package(tmp_path, files)
    assert tree.imported_by(["house.a"]) == ["house", "house.a", "house.b"]
    other = package(tmp_path, {**files, "b.py": "import house.a\nONE = 2"})
    assert tree.digest(["house.a"]) != other.digest(["house.a"])


def test_names_are_followed_through_doors_and_no_others_of_a_room(copied: SourceTree) -> None:
    """`from bodyseg_data import loader` goes through the package's door and the room's."""
    found = set(copied.imported_by(["bodyseg_model.training.loop"]))
    assert {"bodyseg_data", "bodyseg_data.loading", "bodyseg_data.loading.loaders"} <= found
    assert "bodyseg_data.packing.packer" not in found
    few = set(copied.imported_by(["bodyseg_data.labels.label_map"]))
    assert "bodyseg_data.core.errors" in few and "bodyseg_data.core.randomness" not in few


def test_what_a_door_names_changes_no_result(changed_by: ChangedBy) -> None:
    assert changed_by({"bodyseg_data/core/__init__.py": lambda text: text.replace("BadMesh,", "")}) == set()


def test_files_are_those_beside_the_package_that_is_named(tmp_path: Path) -> None:
    def digest(asked: str, tables_a: str = "a", plain: str = "p") -> str:
        data = {"tables/a.txt": tables_a, "plain.txt": plain}
        return package(tmp_path, {"__init__.py": "", "start.py": asked, **data}).digest(["house.start"])

    folder, every, single = 'files("house") / "tables"', "files(__package__)", 'files("house") / "plain.txt"'
    assert digest(folder) == digest(folder, plain="other") != digest(folder, tables_a="other")
    assert digest(every) == digest(every, tables_a="other") != digest(every, plain="other")
    assert digest(single) == digest(single, tables_a="other") != digest(single, plain="other")
    assert digest('files("elsewhere") / "tables"') == digest('files("elsewhere") / "tables"', tables_a="other")


def test_a_module_outside_packages_can_be_asked_about(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "alone.py").write_text("from bodyseg_data.core import errors\nimport alone\n")
    tree = SourceTree({"alone": tmp_path / "alone.py", "bodyseg_data": ROOT / "bodyseg_data"})
    assert {"alone", "bodyseg_data", "bodyseg_data.core.errors"} <= set(tree.imported_by(["alone"]))
    monkeypatch.syspath_prepend(tmp_path)
    assert code_digest("alone") == tree.digest(["alone"])


@pytest.mark.parametrize("name", ["bodyseg_model.nowhere", "nowhere", "sys", "bodyseg_data.artifacts.sensors"])
def test_a_module_without_a_source_is_refused(name: str) -> None:
    with pytest.raises(BadConfig, match=f"the module '{name}' has no source"):
        code_digest(name)


def test_a_source_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    tree = package(tmp_path, {"__init__.py": "", "start.py": "def f(:\n"})
    with pytest.raises(BadConfig, match=r"cannot parse .*start\.py: invalid syntax"):
        tree.digest(["house.start"])
    binary = package(tmp_path, {"start.py": "x = 1"})
    (tmp_path / "house" / "start.py").write_bytes(b"\xff\x00")
    with pytest.raises(BadConfig, match=r"cannot parse .*start\.py"):
        binary.digest(["house.start"])


def test_data_that_cannot_be_read_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tree = package(tmp_path, {"__init__.py": "", "start.py": 'files("house") / "table.txt"', "table.txt": "1"})
    read = Path.read_bytes

    def read_bytes(path: Path) -> bytes:
        if path.name == "table.txt":
            raise OSError(5, "Input/output error")
        return read(path)

    monkeypatch.setattr(Path, "read_bytes", read_bytes)
    with pytest.raises(BadConfig, match=r"cannot read .*table\.txt: Input/output error"):
        tree.digest(["house.start"])
