"""`tools/install`: what it prints, and how it fails, with a pip that installs nothing."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from folders import ROOT

PYTHON = """#!/bin/sh
# Stands for Python: `-m venv FOLDER` makes an environment whose pip is the other script beside this one.
[ "$2" = venv ] || exit 1
mkdir -p "$3/bin" "$3/lib/python3.11/site-packages"
cp "$(dirname "$0")/pip" "$0" "$3/bin/"
"""

PIP = """#!/bin/sh
# Stands for pip: notes its arguments, and says and does as much as progress is read from. uv becomes what UV says.
[ "$1" != config ] || exit 1
site=$(dirname "$0")/../lib/python3.11/site-packages
echo "$@" >> "$(dirname "$0")/../calls"
case "$*" in *"$FAILING"*) echo "ERROR: no such package"; exit 3 ;; esac
case "$*" in *uv==*) [ -z "$UV" ] || { echo "$UV" > "$(dirname "$0")/uv"; chmod +x "$(dirname "$0")/uv"; } ;; esac
echo "Collecting one"; sleep "$PAUSE_S"
echo "Installing collected packages: one, two, three"; mkdir "$site/one-$$.dist-info"; sleep "$PAUSE_S"
"""


@pytest.fixture
def python(tmp_path: Path) -> Path:
    for name, text in (("python", PYTHON), ("pip", PIP)):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    return tmp_path / "python"


def install(
    python: Path, what: str, failing: str = "nothing at all", uv: str = "", pause_s: float = 0
) -> subprocess.CompletedProcess[str]:
    """pause_s: how long pip is at each part of its work, which is looked at every tenth of a second."""
    settings = {"BODYSEG_INSTALL_EVERY_S": "0", "FAILING": failing, "UV": uv, "PIP_INDEX_URL": "a/b"}
    environment = os.environ | settings | {"PAUSE_S": str(pause_s)}
    command = [str(ROOT / "tools" / "install"), str(python), str(python.parent / "venv"), what]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)


def test_every_step_is_a_line_with_its_progress(python: Path) -> None:
    done = install(python, "demo", pause_s=0.15)
    assert done.returncode == 0, done.stderr
    steps = [line for line in done.stdout.splitlines() if not line.startswith("    ")]
    firsts = [step.removeprefix("install: ").split()[0].partition("==")[0] for step in steps]
    assert firsts == ["virtual", "setuptools", "torch", "bodyseg,"]
    assert "    looking for packages, 1 found, " in done.stdout
    assert "    installing, 1 of 3 packages, " in done.stdout
    assert not done.stderr
    calls = (python.parent / "venv" / "calls").read_text().splitlines()
    assert calls[-1].endswith(f"--constraint {ROOT}/tools/requirements.lock --no-build-isolation --editable "
                              f"{ROOT}/tools/..[render]")  # fmt: skip
    assert all("--no-compile" in call for call in calls)


def test_a_step_that_fails_ends_the_installation_with_pips_words(python: Path) -> None:
    done = install(python, "demo", failing="--editable")
    assert done.returncode == 3
    assert "ERROR: no such package" in done.stderr
    assert done.stderr.splitlines()[-1] == "tools/install: this step failed: bodyseg, and packages for making shards"


def test_the_build_with_cuda_is_announced_where_there_is_no_other(python: Path) -> None:
    done = install(python, "demo", failing="+cpu")
    assert done.returncode == 0, done.stderr
    one_build_for_all = sys.platform != "linux" or shutil.which("nvidia-smi") is not None
    assert ("the standard one is installed, which is large" in done.stdout) != one_build_for_all


@pytest.mark.parametrize("status", [0, 2])
def test_packages_are_installed_by_uv_or_else_by_pip(python: Path, status: int) -> None:
    """uv is several times as fast; it does not know all that pip is set up for."""
    uv = f'#!/bin/sh\necho "uv $@" >> "$(dirname "$0")/../calls"; echo "Resolved 9 packages"; sleep 0.15; exit {status}'
    assert install(python, "demo", uv=uv).returncode == 0
    done = install(python, "all", uv=uv)
    assert done.returncode == 0 and "    fetching what is missing of 9 packages, " in done.stdout
    calls = (python.parent / "venv" / "calls").read_text().splitlines()
    by_uv = [call for call in calls if call.startswith("uv pip install --python ")]
    assert all("--default-index a/b " in call for call in by_uv)
    assert by_uv[-2].endswith(f"--no-build-isolation --editable {ROOT}/tools/..[render]")
    assert by_uv[-1].endswith(f"--requirement {ROOT}/tools/requirements.lock")
    assert calls[-1].startswith("uv pip" if status == 0 else "install --no-compile --requirement")
