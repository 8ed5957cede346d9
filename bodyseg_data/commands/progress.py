"""Progress of a long command: a bar with time left on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Final

from tqdm import tqdm

_SECONDS_BETWEEN_LINES: Final = 10.0


class Progress:
    """Shows the share of a known amount that is done, on standard error. before: amount done at the first update."""

    def __init__(self, title: str, unit: str) -> None:
        self.title, self._unit = title, unit
        self.before: int | None = None
        self._bar: tqdm[None] | None = None
        self._start = time.monotonic()
        self._last = float("-inf")

    def __enter__(self) -> Progress:
        return self

    def update(self, done: int, total: int, note: str = "") -> None:
        """Show that `done` of `total` are done. note: text to append."""
        self.before = done if self.before is None else self.before
        if sys.stderr.isatty():
            if self._bar is None:
                # The part that an earlier run finished does not count for this run's speed.
                self._bar = tqdm(total=total, initial=done, desc=self.title, unit=f" {self._unit}", file=sys.stderr)
            self._bar.set_postfix_str(note, refresh=False)
            self._bar.update(done - self._bar.n)
            return
        now = time.monotonic()
        if done == total or now - self._last >= _SECONDS_BETWEEN_LINES:
            self._last = now
            sys.stderr.write(
                f"{self.title}: {done} of {total} {self._unit}, {now - self._start:.0f} s{note and ': '}{note}\n"
            )
            sys.stderr.flush()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()
