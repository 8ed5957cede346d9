"""Wrong pixels by their distance to the border of their part."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from bodyseg_data.labels import BACKGROUND
from bodyseg_data.loading import RangeImages
from bodyseg_data.samples import box_of
from bodyseg_model.evaluation.evaluation import PredictedImage

EDGES: Final = (1, 2, 4, 8, 16)
"""Upper ends (included) of all bins but the last, pixels: up to 1, above 1 to 2, 2 to 4, 4 to 8, 8 to 16, above 16."""

BIN_NAMES: Final = ("1", "1-2", "2-4", "4-8", "8-16", ">16")


def distance_bins(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Bin of every pixel's distance to another class, uint8 [H, W], BACKGROUND where `labels` has it.

    The distance is Euclidean, between pixel centres, to the nearest pixel of another class; background is none.
    Pixels at distance 1 are adjacent to another class. labels: uint8 [H, W], any or BACKGROUND.
    """
    bins = np.full(labels.shape, BACKGROUND, np.uint8)
    for label in np.unique(labels[labels != BACKGROUND]):
        # What lies beyond the last edge is in the last bin, however far it is.
        box = box_of(labels == label, EDGES[-1]) or np.s_[:, :]
        own = labels[box] == label
        others = ~own & (labels[box] != BACKGROUND)
        bins[box][own] = np.searchsorted(EDGES, distance_transform_edt(~others)[own]) if others.any() else len(EDGES)
    return bins


class BorderErrors:
    """Counts of an evaluation's pixels by distance, in the clean label images: int64 [6, 2], row bin, column right or
    wrong. So a pixel has the same distance in every variant, and missing pixels make no borders.
    """

    def __init__(self, images: RangeImages) -> None:
        self._images = images
        self._index_of = {key: index for index, key in enumerate(images.keys)}
        self.counts: NDArray[np.int64] = np.zeros((len(BIN_NAMES), 2), np.int64)

    def watch(self, image: PredictedImage, accuracy: float) -> None:
        """Count the pixels of one image of `evaluate`."""
        bins = distance_bins(self._images.label_map.table[self._images.clean(self._index_of[image.key]).labels])
        body = image.labels != BACKGROUND
        np.add.at(self.counts, (bins[body], (image.labels != image.predicted)[body].astype(np.intp)), 1)

    def to_json(self) -> list[dict[str, Any]]:
        """A row for each bin: its pixels, and the share of them that is wrong, null without any."""
        rows = []
        for name, (right, wrong) in zip(BIN_NAMES, self.counts.tolist(), strict=True):
            pixels = right + wrong
            rows.append({"distance": name, "pixels": pixels, "wrong": round(wrong / pixels, 5) if pixels else None})
        return rows
