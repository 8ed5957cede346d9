"""How torch's threads wait for each other."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from bodyseg_data.machine import wait_briefly


def test_threads_wait_briefly_unless_the_user_has_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY"):
        monkeypatch.delenv(name, raising=False)
    with monkeypatch.context() as patched:
        patched.setenv("OMP_WAIT_POLICY", "active")
        wait_briefly()
        assert "GOMP_SPINCOUNT" not in os.environ
    monkeypatch.setenv("GOMP_SPINCOUNT", "7")
    wait_briefly()
    assert os.environ["GOMP_SPINCOUNT"] == "7"
    monkeypatch.delenv("GOMP_SPINCOUNT")
    wait_briefly()
    assert os.environ["GOMP_SPINCOUNT"] == "10000"


def test_a_command_says_so_before_torch_is_loaded() -> None:
    code = (
        "import sys; from bodyseg_model.commands.cli import main; assert 'torch' not in sys.modules; "
        "main(['sensor', 'list']); import os; print(os.environ['GOMP_SPINCOUNT'])"
    )
    clean = {name: value for name, value in os.environ.items() if name not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=clean)
    assert done.stdout.splitlines()[-1] == "10000"
