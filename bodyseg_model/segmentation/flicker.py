"""Label flicker: how many pixels change their label from one frame to the next, as the frames are.

Nothing follows the body: a pixel is compared with the same pixel of the next frame. So labels also change where the
body moves; among pixels whose range hardly changed, few do for that reason.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.parts import BACKGROUND

STILL_M: Final = 0.02
"""A pixel whose range changed by less is taken to see the same place of the body."""


@dataclass(frozen=True)
class Flicker:
    """Counts of pixels that have a label in both frames: all of them and those that are still, and of both those whose
    label changed.
    """

    shared: int = 0
    changed: int = 0
    still: int = 0
    still_changed: int = 0

    def __add__(self, other: Flicker) -> Flicker:
        return Flicker(
            self.shared + other.shared,
            self.changed + other.changed,
            self.still + other.still,
            self.still_changed + other.still_changed,
        )

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
