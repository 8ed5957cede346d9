"""Frames that cannot be read, skipped within a budget."""

from __future__ import annotations

from collections.abc import Sequence

from bodyseg_data.core.errors import BadConfig, check_int
from bodyseg_model.recordings.recording import Frame, Pixels


class Skipping:
    """Reads frames and skips those that cannot be read, up to `budget` of them.

    skipped: name, file and error of each, in the order of reading. Raises BadConfig for a budget below 0.
    """

    def __init__(self, budget: int = 0) -> None:
        self.budget = check_int("--skip-unreadable", budget, least=0)
        self.skipped: list[dict[str, str]] = []

    def __repr__(self) -> str:
        return f"Skipping({len(self.skipped)} of at most {self.budget} skipped)"

    def read(self, frame: Frame) -> Pixels | None:
        """Read a frame, uint16 [H, W]; None for one that cannot be read. Raises BadConfig once the budget is spent."""
        try:
            return frame.read()
        except BadConfig as error:
            entry = {"name": frame.name, "file": frame.where, "error": str(error)}
            if entry in self.skipped:
                return None
            if len(self.skipped) >= self.budget:
                beyond = f", after {self.budget} that --skip-unreadable allowed" if self.budget else ""
                raise BadConfig(f"{error}{beyond}") from error
            self.skipped.append(entry)
            return None


def first_readable(frames: Sequence[Frame], skipping: Skipping) -> Frame:
    """Return the first frame that can be read. Raises BadConfig if none can, or too many cannot."""
    for frame in frames:
        if skipping.read(frame) is not None:
            return frame
    raise BadConfig(f"at least one frame must be readable, found none: {skipping.skipped[-1]['error']}")
