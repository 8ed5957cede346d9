"""Signals that end a command, put off while something must not be left half done."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

ENDING: Final = (signal.SIGINT, signal.SIGTERM)
"""Signals that ask a command to end."""


@contextmanager
def signals_held(only_first: bool = False) -> Iterator[None]:
    """Put off the handling of SIGINT and SIGTERM until the context ends, in the main thread.

    only_first: a second signal is handled at once, for contexts that may last. Other threads receive no signals, so
    nothing is put off there.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []

    def put_off(number: int, frame: FrameType | None) -> None:
        if came and only_first:
            restore()
            signal.raise_signal(came.pop())
        else:
            came.append(number)

    def restore() -> None:
        for number, action in before.items():
            signal.signal(number, action)

    before = {number: signal.signal(number, put_off) for number in ENDING}
    try:
        yield
    finally:
        restore()
        for late in came:
            signal.raise_signal(late)
