"""Window of range images: the rows and columns that a picture shows, where bodies are small in them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Window = tuple[slice, slice]
"""Rows and columns."""

_MARGIN: Final = 0.08  # of the longer side of what is measured, around it
_MOST_CROPPED: Final = 0.4  # images stay whole where the window would keep more of them than this share


def window_of(images: Sequence[NDArray[Any]]) -> Window:
    """Return rows and columns of all pixels where any of the images [H, W] is above 0, with a margin.

    Images stay whole if these are more than two fifths of them, as before a narrow camera, or if their sizes differ.
    """
    whole = slice(None), slice(None)
    if len({image.shape for image in images}) != 1:
        return whole
    measured = np.any([image > 0 for image in images], axis=0)
    spans = [np.flatnonzero(measured.any(axis=axis)) for axis in (1, 0)]
    if not measured.any():
        return whole
    margin = round(_MARGIN * max(int(span[-1] - span[0]) for span in spans))
    rows, columns = (slice(max(0, int(span[0]) - margin), int(span[-1]) + margin + 1) for span in spans)
    return (rows, columns) if measured[rows, columns].size < _MOST_CROPPED * measured.size else whole
