"""Bad samples that a loader skips: up to a budget, every one recorded."""

from collections import defaultdict
from dataclasses import asdict, dataclass
from typing import Any, Literal, TypeVar

import numpy as np

from bodyseg_data.core import BadConfig, BadSample, BadShard, Checked, check_choice

_Error = TypeVar("_Error", bound=Exception)


def with_text(error: _Error, text: str) -> _Error:
    """Return a new error of the same class and notes with another text, tied to no traceback's frames."""
    found = type(error)(text)
    for note in getattr(error, "__notes__", ()):
        found.add_note(note)
    return found


OnError = Literal["stop", "skip"]

SKIPPABLE = (BadShard, BadSample)
"""Errors in one sample's bytes; all others end the run."""


@dataclass(frozen=True)
class Skipped(Checked):
    """Record of a skipped sample. offset: its first byte in the shard; why: message of the error that was raised."""

    epoch: int
    key: str
    shard: str
    offset: int
    why: str


class SkipLedger:
    """Counts and records skipped samples. budget: None skips nothing; else the most samples that one epoch may lose."""

    def __init__(self, budget: int | None) -> None:
        self._budget, self.strict = budget, budget is None  # strict: no sample may be skipped
        self.skipped: list[Skipped] = []
        self._lost: defaultdict[int, set[tuple[str, str]]] = defaultdict(set)  # shards and keys by epoch

    def add(self, record: Skipped, error: Exception) -> None:
        """Record one more sample. Raises `error` if nothing may be skipped, BadShard beyond the budget."""
        if self._budget is None or not isinstance(error, SKIPPABLE):
            # A new object: raising `error` itself would tie it and a traceback's frames into a reference cycle.
            raise with_text(error, str(error))
        # By shard and key: repeating an epoch loses the same samples again.
        lost, sample = self._lost[record.epoch], (record.shard, record.key)
        if sample not in lost and len(lost) >= self._budget:
            raise BadShard(
                f"{record.why} (epoch {record.epoch} has lost {len(lost)} samples before, all that its skip_budget "
                "allows)"
            )
        lost.add(sample)
        self.skipped.append(record)

    def state(self) -> list[dict[str, Any]]:
        """Return all records as plain JSON."""
        return [asdict(record) for record in self.skipped]

    def load_state(self, state: Any) -> None:
        """Replace the records by those of an earlier run. Raises BadConfig for anything but a list of records."""
        try:
            if not isinstance(state, list):
                raise TypeError
            self.skipped, self._lost = [Skipped(**record) for record in state], defaultdict(set)
        except (TypeError, BadConfig):
            raise BadConfig("a state's 'skipped' must be a list of records as a loader writes them") from None
        for each in self.skipped:
            self._lost[each.epoch].add((each.shard, each.key))


def checked_budget(on_error: str, budget: float | None, samples: int) -> int | None:
    """Return the most samples a pass may skip: `budget` if whole, else that share of `samples`. Raises BadConfig."""
    check_choice("on_error", on_error, ("stop", "skip"))
    if (on_error == "skip") != (budget is not None):
        raise BadConfig(f"on_error='skip' and a skip_budget belong together, found {on_error!r} and {budget!r}")
    if budget is None:
        return None
    if isinstance(budget, int | float | np.integer | np.floating) and not isinstance(budget, bool):
        if 0 <= budget < 1:
            return int(budget * samples * (1 + 1e-12))  # 29 for 0.29 of 100, which is 28.999... as a float
        if budget >= 1 and budget % 1 == 0:
            return int(budget)
    raise BadConfig(f"skip_budget must be a number of samples, or a share below 1, found {budget!r}")
