"""Progress of a long command: a bar with time left on a terminal, elsewhere a line at least every five seconds."""

from __future__ import annotations

import contextlib
import sys
import threading
import time

from tqdm import tqdm


def rate_text(per_second: float, unit: str) -> str:
    """Return a rate with two digits or more: "12 images/s", "1.4 images/s", "0.035 images/s"."""
    if per_second < 0.995:
        return f"{per_second:.2g} {unit}/s"
    return f"{per_second:.{int(per_second < 9.95)}f} {unit}/s"


class Progress:
    """Shows on standard error the share of an amount that is done, also between updates, every `interval_s` seconds."""

    def __init__(self, title: str, unit: str, interval_s: float = 4.5) -> None:
        self.title, self.unit, self._interval_s = title, unit, interval_s
        self._bar: tqdm[None] | None = None
        self._start = time.monotonic()
        self._last = float("-inf")
        self._line = f"{title}: starting"
        self._lock = threading.RLock()
        self._ended = threading.Event()
        self._ticker = threading.Thread(target=self._tick, name="progress", daemon=True)

    def __enter__(self) -> Progress:
        self._ticker.start()
        return self

    def begin(self, title: str, unit: str) -> None:
        """Show the progress of other work from the next update on; nothing changes if it is the work shown."""
        with self._lock:
            if (title, unit) == (self.title, self.unit):
                return
            self.title, self.unit = title, unit
            self._line, self._last = f"{title}: starting", float("-inf")
            if self._bar is not None:
                self._bar.close()
                self._bar = None

    def update(self, done: int, total: int, note: str = "") -> None:
        """Show that `done` of `total` are done. note: text to append."""
        with self._lock:
            if sys.stderr.isatty():
                if self._bar is None:
                    # The part that an earlier run finished does not count for this run's speed.
                    self._bar = tqdm(total=total, initial=done, desc=self.title, unit=f" {self.unit}", file=sys.stderr)
                self._bar.set_postfix_str(note, refresh=False)
                self._bar.update(done - self._bar.n)
                return
            before, self._line = self._line, f"{self.title}: {done} of {total} {self.unit}"
            if (done == total and before != self._line) or time.monotonic() - self._last >= self._interval_s:
                self._write(note)

    def _write(self, note: str = "") -> None:
        self._last = time.monotonic()
        sys.stderr.write(f"{self._line}, {self._last - self._start:.0f} s{note and ': '}{note}\n")
        sys.stderr.flush()

    def _tick(self) -> None:
        """While no update comes, repeat the last line with the time that has passed, or move the bar's clock on."""
        while not self._ended.wait(self._interval_s / 9):
            with self._lock:
                if self._ended.is_set():
                    return
                with contextlib.suppress(OSError, ValueError):  # standard error is closed: the next update raises it
                    if self._bar is not None:
                        self._bar.refresh()
                    elif time.monotonic() - max(self._last, self._start) >= self._interval_s:
                        self._write()

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        with self._lock:
            if self._bar is not None:
                self._bar.close()
        self._ticker.join()
