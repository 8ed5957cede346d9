"""Label flicker: pixels whose label changes from one frame to the next, without compensation for motion.

A pixel is compared with the same pixel of the next frame, so labels also change where the body moves. Pixels whose
range hardly changed are counted separately: few of them change for that reason.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.parts import BACKGROUND

STILL_M: Final = 0.02
"""A pixel whose range changed by less, metres, is taken to see the same point of the body."""


@dataclass(frozen=True)
class Flicker:
    """Counts of pixels that have a label in both frames.

    shared: all of them; changed: those whose label changed. still, still_changed: the same of pixels whose range
    changed by less than `STILL_M`.
    """

    shared: int = 0
    changed: int = 0
    still: int = 0
    still_changed: int = 0

    def __add__(self, other: Flicker) -> Flicker:
        return Flicker(*(one + another for one, another in zip(astuple(self), astuple(other), strict=True)))

    def to_json(self) -> dict[str, Any]:
        """Counts and shares; a share of nothing is null."""
        return {
            "shared_pixels": self.shared,
            "changed": _share(self.changed, self.shared),
            "still_pixels": self.still,
            "still_changed": _share(self.still_changed, self.still),
        }


def flicker(
    labels: NDArray[np.uint8],
    next_labels: NDArray[np.uint8],
    range_m: NDArray[np.float32],
    next_range_m: NDArray[np.float32],
) -> Flicker:
    """Compare label images uint8 [H, W], 255 where there is no label, and ranges [H, W], metres, of two frames."""
    shared = (labels != BACKGROUND) & (next_labels != BACKGROUND)
    changed = shared & (labels != next_labels)
    still = shared & (np.abs(range_m - next_range_m) < STILL_M)
    return Flicker(*(int(np.count_nonzero(mask)) for mask in (shared, changed, still, still & changed)))


def _share(part: int, whole: int) -> float | None:
    return round(part / whole, 5) if whole else None
