"""The built wheel: what it holds, and that it streams outside the checkout."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from folders import ROOT

STREAM = """
import sys
import bodyseg_data, bodyseg_model
folder, lines = sys.argv[1:]
assert bodyseg_data.__file__.startswith(folder) and bodyseg_model.__file__.startswith(folder)
found = {}
exec(lines, found)
assert len(found["images"]) == 36 and len(found["names"]) == 36 % 20
assert len(set(next(iter(found["batches"]))["key"])) == 20
from bodyseg_data.rigs.rig import load_rig
from bodyseg_data.meshes.landmarks import load_landmarks
from bodyseg_model.networks.checkpoints import load_network
load_rig("paper"), load_landmarks("open"), load_network()
try:
    import benches
except ImportError:
    print("streamed")
"""


TOP = ("CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "Makefile", "README.md")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a copy: building leaves files beside its sources."""
    copy = tmp_path_factory.mktemp("source") / "project"
    for name in ("bodyseg_data", "bodyseg_model", "tools"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"), symlinks=True)
    for name in ("docs", "tests", ".ci", ".github"):
        (copy / name).symlink_to(ROOT / name)
    for name in (*TOP, "pyproject.toml", "MANIFEST.in"):
        shutil.copy(ROOT / name, copy)
    build = "import setuptools.build_meta as backend; backend.build_wheel('dist')"
    done = subprocess.run([sys.executable, "-c", build], cwd=copy, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    (built,) = (copy / "dist").glob("*.whl")
    return built


def test_the_wheel_holds_both_packages_and_nothing_else(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {name.partition("/")[0].partition("-")[0] for name in names} == {"bodyseg_data", "bodyseg_model", "bodyseg"}
    sources = {
        path.relative_to(ROOT).as_posix()
        for package in ("bodyseg_data", "bodyseg_model")
        for path in (ROOT / package).rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    }
    assert {name for name in names if ".dist-info/" not in name} == sources
    metadata = zipfile.ZipFile(wheel).read(next(name for name in names if name.endswith("/METADATA"))).decode()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert f"Version: {project['version']}" in metadata
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)


def test_the_description_of_the_package_stands_alone(wheel: Path) -> None:
    """It is read on PyPI, where paths of the checkout lead nowhere."""
    archive = zipfile.ZipFile(wheel)
    header, _, text = (
        archive.read(next(name for name in archive.namelist() if name.endswith("/METADATA"))).decode().partition("\n\n")
    )
    assert "Description-Content-Type: text/markdown" in header and text.startswith("# bodyseg")
    links = re.findall(r"\]\(([^)]*)\)", text)
    assert all(link.startswith("https://") for link in links)


def test_the_source_distribution_holds_what_is_built_and_tested(wheel: Path) -> None:
    """Building the wheel lists the files of a source distribution."""
    listed = set((wheel.parents[1] / "bodyseg.egg-info" / "SOURCES.txt").read_text().splitlines())
    folders = ("bodyseg_data", "bodyseg_model", "docs", "tests", "tools", ".ci", ".github")
    skipped = ("__pycache__", "_build", "generated", ".ipynb_checkpoints")
    wanted = {
        path.relative_to(ROOT).as_posix()
        for folder in folders
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and not any(name in path.parts for name in skipped)
    }
    assert wanted | {*TOP, "MANIFEST.in", "pyproject.toml"} <= listed
    assert not any(name.endswith(".pyc") for name in listed)


def test_the_lines_of_the_readme_run_from_the_wheel_outside_the_checkout(wheel: Path, tmp_path: Path) -> None:
    (lines,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    lines = lines.replace("range(2)", "range(1)")
    site, elsewhere = tmp_path / "site", tmp_path / "elsewhere"
    elsewhere.mkdir()
    zipfile.ZipFile(wheel).extractall(site)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | {
        "PYTHONPATH": str(site),
        "BODYSEG_KERNELS": "numpy",  # compiled loops are kept by their path: here all would be compiled anew
    }
    done = subprocess.run(
        [sys.executable, "-c", STREAM, str(site), lines],
        cwd=elsewhere, env=environment, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert (done.returncode, done.stdout.strip()) == (0, "36 images\nstreamed"), done.stderr
