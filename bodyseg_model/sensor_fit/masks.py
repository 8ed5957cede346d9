"""Shapes of masks: growing and shrinking by squares, regions and holes; by SciPy and scikit-image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.system.libraries import missing_library

Mask = NDArray[np.bool_]


def require_libraries_of_fit() -> None:
    """Raise MissingLibrary unless SciPy and scikit-image, which all of this room needs, are installed."""
    try:
        import scipy  # noqa: F401
        import skimage  # noqa: F401
    except ImportError as error:
        raise missing_library("bodyseg sensor fit", error, extra="sensor") from error


def dilated(mask: Mask, radius: int) -> Mask:
    """Grow a mask by a square of 2 radius + 1 pixels a side, bool [H, W]."""
    from scipy.ndimage import maximum_filter

    grown: Mask = maximum_filter(mask, 2 * radius + 1, mode="constant")
    return grown


def eroded(mask: Mask, radius: int) -> Mask:
    """Shrink a mask by such a square; the world outside the image counts as empty."""
    from scipy.ndimage import minimum_filter

    shrunk: Mask = minimum_filter(mask, 2 * radius + 1, mode="constant")
    return shrunk


def closing(mask: Mask, radius: int) -> Mask:
    """Fill gaps narrower than such a square, bool [H, W]; nothing set is lost, also at the image's border."""
    return eroded(dilated(np.pad(mask, 2 * radius), radius), radius)[2 * radius : -2 * radius, 2 * radius : -2 * radius]


def opening(mask: Mask, radius: int) -> Mask:
    """Keep what such a square fits into, bool [H, W]."""
    return dilated(eroded(mask, radius), radius)


def holes(mask: Mask, outside: Mask) -> Mask:
    """The empty pixels that neither the image's border nor a pixel of `outside` reaches through empty ones.

    mask, outside: bool [H, W]. Steps go to the four neighbours.
    """
    from skimage.measure import label

    regions = label(np.pad(~mask, 1, constant_values=True), connectivity=1)  # 0 on the mask
    inside = regions[1:-1, 1:-1]
    open_regions = np.append(np.unique(inside[outside]), (regions[0, 0], 0))
    return np.isin(inside, open_regions, invert=True)


def connected(mask: Mask, pixel: int) -> Mask:
    """The pixels of a mask that steps to the four neighbours reach from one of them, a flat index; bool [H, W]."""
    from skimage.segmentation import flood

    reached: Mask = flood(mask, np.unravel_index(pixel, mask.shape), connectivity=1)
    return reached
