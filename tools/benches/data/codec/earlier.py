"""Images as formats 5 and 6 of shards stored them, which nothing writes any more: for comparisons and hostile files."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benches.data.codec.baselines import label_bytes
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.samples import Sample
from bodyseg_data.shards.codecs.bodyseg_images import _frame
from bodyseg_data.shards.codecs.png import encode_png
from bodyseg_data.shards.codecs.residuals import (
    bounding_box,
    encode_slopes,
    escape_large,
    find_runs,
    foreground_runs,
    to_byte_planes,
)


def earlier_images(sample: Sample) -> bytes:
    """A sample's images in one `BSI2` (`bodyseg_data/shards/codecs/bodyseg_images.py`); labels are of the 33 parts."""
    stored = label_bytes(sample.labels, sample.faces_projector)
    box = bounding_box(stored != BACKGROUND)
    runs = find_runs(box.crop(stored))
    slopes = encode_slopes(box.crop(sample.range), runs)
    starts, pixels = foreground_runs(runs)
    lengths, long = escape_large(runs.lengths, np.uint32)
    first = _frame([runs.values, lengths, long, *slopes])
    counts = len(runs.values), len(long) // 4, len(starts), int(pixels.sum()), len(slopes[-1]) // 2
    header = struct.pack("<6H6I", *sample.range.shape, *box, *counts, len(first))
    projector: NDArray[np.uint16] = sample.occluder_range()
    box = bounding_box(projector > 0)
    runs = find_runs(box.crop(projector))
    lengths, long = escape_large(runs.lengths, np.uint32)
    header += struct.pack("<6H2I", *projector.shape, *box, len(runs.values), len(long) // 4)
    checked = header + first + _frame([to_byte_planes(runs.values), lengths, long])
    return struct.pack("<4sI", b"BSI2", zlib.crc32(checked)) + checked


def earlier_pngs(sample: Sample) -> dict[str, bytes]:
    """A sample's images as the three PNGs of formats 5 and 6."""
    stored = label_bytes(sample.labels, sample.faces_projector)
    images: dict[str, NDArray[Any]] = {"range": sample.range, "projector": sample.occluder_range(), "labels": stored}
    return {f"{name}.png": encode_png(image) for name, image in images.items()}
