"""Processes that tests start: to interrupt them, or two ranks of torchrun."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

from folders import HELPERS


def start_interruptible(command: Sequence[str], **options: Any) -> subprocess.Popen[Any]:
    """Start a process that SIGINT and SIGTERM end, as one in a terminal; options: those of Popen.

    Background jobs of a script are started with SIGINT ignored, and what they start inherits that, which `bodyseg`
    leaves as it is. Handlers are not inherited: a new program has the default action in their place.
    """
    ignored = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) == signal.SIG_IGN]
    try:
        for number in ignored:
            signal.signal(number, lambda number, frame: None)
        return subprocess.Popen(command, **options)
    finally:
        for number in ignored:
            signal.signal(number, signal.SIG_IGN)


def run_on_two_ranks(worker: str, *words: str) -> str:
    """Run a worker of this folder on two ranks by torchrun, and return what it wrote to stderr."""
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    done = subprocess.run(
        [*torchrun, str(HELPERS / worker), *words],
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        timeout=200,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stderr
