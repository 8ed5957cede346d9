"""Places on the template of the body as networks give them, three coordinates a pixel, and the template's points there.

A place is a position on the template at rest (`bodyseg_data.load_template`), less its middle, in units of half of its
height: so the coordinates are from -1 to 1, and a mirrored person's have the other sign across. Positions on a body at
rest are what others regress, too (Wang et al., "Normalized object coordinate space", 2019, for rigid things; Taylor et
al., "The Vitruvian manifold", 2012, for people).
"""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data import load_template

UNIT_M: Final = 0.9
"""A unit of places, metres."""

_MIDDLE_M: Final = (0.0, 0.9, 0.0)


@cache
def place_table() -> NDArray[np.float32]:
    """The place of each point of the template, float32 [P, 3]."""
    found: NDArray[np.float32] = ((load_template().points - _MIDDLE_M) / UNIT_M).astype(np.float32)
    return found
