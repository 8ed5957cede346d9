"""A drawing: all that a page shows at one moment, as arrays and text."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bodyseg_model.viewing.pictures import Legend
from bodyseg_model.viewing.space import Device, Points


@dataclass(frozen=True)
class Drawing:
    """Points, devices, a picture of panels, sRGB uint8 [H, W, 3], and facts in lines of plain text.

    gap_m: distance of neighbouring points, metres, which their size on the page follows. bodies: number of the first
    points, which are of bodies, and to which a window is turned. legend: of the colours of the points.
    """

    points: Points
    devices: tuple[Device, ...]
    picture: NDArray[np.uint8] = field(repr=False)
    facts: tuple[str, ...]
    gap_m: float
    bodies: int
    legend: Legend = field(repr=False)
