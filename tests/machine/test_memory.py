"""Peak memory of this process, and memory that is used again."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bodyseg_data.machine import host as memory
from bodyseg_data.machine import peak_mb


def test_the_peak_stays_when_memory_is_given_back() -> None:
    before = peak_mb()
    assert before > 10
    taken = np.ones(200_000_000, np.uint8)
    during = peak_mb()
    del taken
    after = peak_mb()
    assert during > 200 and after > during - 1 and during >= before  # Linux counts pages of threads late


@pytest.mark.parametrize(("system", "unit"), [("linux", 1024), ("darwin", 1)])
def test_without_proc_the_unit_is_that_of_the_system(system: str, unit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_file(path: Path) -> str:
        raise FileNotFoundError(path)

    monkeypatch.setattr(Path, "read_text", no_file)
    monkeypatch.setattr(sys, "platform", system)
    raw = memory.resource.getrusage(memory.resource.RUSAGE_SELF).ru_maxrss
    assert peak_mb() == pytest.approx(raw * unit / 1e6, abs=0.1)


def test_freed_memory_is_used_again_unless_the_user_has_chosen() -> None:
    if platform.libc_ver()[0] != "glibc":
        pytest.skip("only glibc's malloc can be told to keep memory")
    script = (
        "import resource, numpy as np; from bodyseg_data.machine.host import keep_freed_memory\n"
        "keep_freed_memory()\n"
        "def use(): [np.ones(30_000_000, np.uint8) for _ in range(4)]\n"
        "use(); use(); before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "for _ in range(5): use()\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)\n"
    )
    plain = {name: value for name, value in os.environ.items() if not name.startswith(("MALLOC_", "GLIBC_"))}
    faults = [
        int(
            subprocess.run(
                [sys.executable, "-c", script], check=True, capture_output=True, env={**plain, **chosen}
            ).stdout
        )
        for chosen in ({}, {"MALLOC_TRIM_THRESHOLD_": "131072"})
    ]
    assert faults[0] < 1000 < faults[1], "the second gives all back, five times 120 MB"
