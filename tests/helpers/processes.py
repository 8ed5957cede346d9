"""Processes that tests start in order to interrupt them."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Sequence
from typing import Any


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
