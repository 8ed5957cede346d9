"""Work on arrays divided among threads, for loops that run without Python's lock."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable


def work_in_pieces(work: Callable[[int, int], None], count: int, pieces: int) -> None:
    """Call `work(first, last)` for runs of nearly equal length that make up 0 to before `count`, each in a thread.

    The caller's thread does the first. `work` must not raise.
    """
    runs = list(itertools.pairwise(count * part // pieces for part in range(pieces + 1)))
    others = [threading.Thread(target=work, args=run) for run in runs[1:]]
    for thread in others:
        thread.start()
    work(*runs[0])
    for thread in others:
        thread.join()
