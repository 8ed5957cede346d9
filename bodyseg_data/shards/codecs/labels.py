"""The label byte: 255 is background; else bits 0 to 5 are the part, and bit 6 says whether it faces the projector."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.parts import BACKGROUND

FACING_BIT: Final = 0x40
"""Set in a stored label where the surface faces the projector; background stays 255."""


def join_labels(labels: NDArray[np.uint8], faces_projector: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Labels and whether the surface faces the projector -> stored label bytes."""
    return labels | (faces_projector.view(np.uint8) * np.uint8(FACING_BIT))


def split_labels(stored: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Stored label bytes -> (labels 0..32 or 255, whether the surface faces the projector)."""
    facing: NDArray[np.bool_] = (stored & np.uint8(FACING_BIT)) != 0
    facing &= stored != BACKGROUND
    return stored ^ (facing.view(np.uint8) * np.uint8(FACING_BIT)), facing
