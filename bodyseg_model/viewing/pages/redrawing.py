"""Drawing in a thread of its own, of which only the newest request counts."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class Redrawing:
    """Calls `draw` after requests, from one thread. Requests that arrive while it draws are answered by one more call.

    least_s: time from one call to the next at least, so that a slider that is dragged does not fill a connection.
    """

    def __init__(self, draw: Callable[[], None], least_s: float = 0.1) -> None:
        self._draw, self._least_s = draw, least_s
        self._changed = threading.Condition()
        self._requested = self._drawn = 0
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="redrawing", daemon=True)
        self._thread.start()

    def request(self) -> None:
        """Ask for a drawing; returns at once."""
        with self._changed:
            self._requested += 1
            self._changed.notify_all()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until all that was requested before is drawn; False if that took longer, or this is closed."""
        with self._changed:
            wanted = self._requested
            self._changed.wait_for(lambda: self._closed or self._drawn >= wanted, timeout_s)
            return self._drawn >= wanted

    def close(self) -> None:
        """End the thread after what it is drawing."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._drawn < self._requested)
                if self._closed:
                    return
                begun = self._requested
            start = time.monotonic()
            try:
                self._draw()
            finally:
                with self._changed:
                    self._drawn = begun
                    self._changed.notify_all()
            with self._changed:
                self._changed.wait_for(lambda: self._closed, max(0.0, self._least_s - (time.monotonic() - start)))
