"""The label byte: 255 for background; else the part in bits 0 to 5, and bit 6 set if it faces the projector."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.parts import BACKGROUND

FACING_BIT: Final = 0x40
"""Bit of a stored label, set where the surface faces the projector; background stays 255."""


def join_labels(labels: NDArray[np.uint8], faces_projector: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Pack labels, 0 to 32 or 255, and the mask of pixels that face the projector into label bytes, uint8 [H, W]."""
    return labels | (faces_projector.view(np.uint8) * np.uint8(FACING_BIT))


def split_labels(stored: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Unpack label bytes into labels, 0 to 32 or 255, and the mask of pixels that face the projector."""
    facing: NDArray[np.bool_] = (stored & np.uint8(FACING_BIT)) != 0
    facing &= stored != BACKGROUND
    return stored ^ (facing.view(np.uint8) * np.uint8(FACING_BIT)), facing
