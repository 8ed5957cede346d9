"""Storage that each shadow test needs in a sample: images, their bytes, the time to decode them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import numpy as np
import zstandard
from numpy.typing import NDArray

from benches.data.codec.baselines import label_bytes
from benches.data.occlusion.baselines import DEFAULT, STEP_M, Method, nearest_texel
from benches.data.occlusion.views import ExactView
from benches.measuring import median_time
from bodyseg_data.artifacts import ShadowTest, framed
from bodyseg_data.artifacts.occlusion import Floats
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.packing.occluders import coarsened
from bodyseg_data.samples import FARTHEST_STEPS
from bodyseg_data.shards.codecs.bodyseg_images import decode_images, encode_images

MASK_IMAGE: Final = "image by the codec"
_ROUNDS: Final = 4
_EMPTY: Final = 65535  # as tests see an empty texel: one step less than 0, behind every point
_NOTHING: Final = np.zeros((1, 1), np.uint16)
_NO_LABELS: Final = np.full((1, 1), BACKGROUND, np.uint8)
_EMPTY_BYTES: Final = len(encode_images(_NOTHING, _NO_LABELS, np.zeros_like(_NO_LABELS), None))

Cost = tuple[int, float]
"""Bytes, and seconds of processor to decode them: the median of four times."""


@dataclass(frozen=True)
class StoredImage:
    """One projector image, uint16 [Hp, Wp], in steps."""

    image: NDArray[np.uint16]

    @cached_property
    def cost(self) -> Cost:
        """Cost of the smaller of the codec's two encodings of ranges, that of the projector and that of the camera."""
        as_runs = coded(_NOTHING, _NO_LABELS, self.image)
        labels = np.where(self.image > 0, 0, BACKGROUND).astype(np.uint8)
        return min(as_runs, coded(self.image, labels, None))


def coded(camera: NDArray[np.uint16], labels: NDArray[np.uint8], projector: NDArray[np.uint16] | None) -> Cost:
    """Bytes that the shards' codec needs for these images beyond those of empty ones, and seconds to decode them."""
    data = encode_images(camera, labels, np.zeros_like(labels), projector)
    return len(data) - _EMPTY_BYTES, median_time(lambda: decode_images(data, True), _ROUNDS)[0]


@dataclass
class Storage:
    """The projector images of one view, as methods read them."""

    view: ExactView
    tests: dict[int, ShadowTest]
    _whole: dict[int, StoredImage] = field(default_factory=dict)
    _stored: dict[Method, StoredImage] = field(default_factory=dict)
    _points: dict[tuple[int, bool], tuple[Floats, Floats, Floats]] = field(default_factory=dict)

    def whole(self, method: Method) -> StoredImage:
        """The image with all texels; the stored one gives the same mask."""
        scale = method.projector_scale
        return self._whole.setdefault(scale, StoredImage(self.view.projector_range[scale]))

    def of(self, method: Method) -> StoredImage:
        """The image that a sample holds for a method."""
        if method.stored == "whole":
            return self.whole(method)
        if method not in self._stored:
            self._stored[method] = StoredImage(self._needed(method))
        return self._stored[method]

    def _needed(self, method: Method) -> NDArray[np.uint16]:
        if method == DEFAULT:
            return self.view.sample.occluder_range()
        image, points = self.view.projector_range[method.projector_scale], self._tested_points(method)
        gap = np.float32(method.bias_mm / 1000 / STEP_M)
        if method.compares:
            return coarse_comparisons(image, *points, gap, method.texels)
        occluder = image * shading_texels(image, *points, gap, method.texels)
        return (
            coarsened(self.tests[method.projector_scale], occluder, *points) if method.stored == "coarse" else occluder
        )

    def _tested_points(self, method: Method) -> tuple[Floats, Floats, Floats]:
        key = method.projector_scale, method.facing_bit
        if key not in self._points:
            tested = self.view.facing if method.facing_bit else self.view.range > 0
            test = self.tests[method.projector_scale]
            self._points[key] = test.project(self.view.range, np.flatnonzero(tested))[1:]
        return self._points[key]


def shading_texels(
    image: NDArray[np.uint16], x: Floats, y: Floats, away: Floats, gap: np.float32, texels: int
) -> NDArray[np.bool_]:
    """The texels that can change the answer for points, bool [Hp, Wp]: those read by a point of whose texels one is
    nearer than the point by more than about `gap`; all others may as well be empty.

    image: uint16 [Hp, Wp]; x, y, away: float32 [N] as in `ShadowTest.reached`; texels: how many a point reads, 1 or 4.
    """
    frame = framed(image)
    indices = _texel_indices(image, x, y, texels)
    nearest = np.minimum.reduce([frame.ravel().take(index) for index in indices])
    # One step is far more than single precision can be off by.
    shaded = np.minimum(away - np.float32(1), FARTHEST_STEPS) - nearest > gap - np.float32(1)
    read = np.zeros(frame.shape, np.bool_)
    for index in indices:
        read.ravel()[index[shaded]] = True
    return _unframed(read, np.logical_or)


def coarse_comparisons(
    image: NDArray[np.uint16], x: Floats, y: Floats, away: Floats, bias: np.float32, texels: int
) -> NDArray[np.uint16]:
    """An image, uint16 [Hp, Wp], that gives rules which only compare texels with points' ranges the same answers: each
    texel is empty if it may be, else the multiple of the largest power of two on the same side of all points. As
    `packing/occluders.py` does it for the default's rule; arguments as in `shading_texels`.
    """
    frame = framed(image).astype(np.int32)
    limits = np.ceil(np.minimum(away - np.float32(1), FARTHEST_STEPS) - bias).astype(np.int32)
    low, high = np.zeros(frame.size, np.int32), np.full(frame.size, _EMPTY, np.int32)
    for index in _texel_indices(image, x, y, texels):
        behind = frame.ravel()[index] >= limits
        np.maximum.at(low, index[behind], limits[behind])
        np.minimum.at(high, index[~behind], limits[~behind] - 1)
    least = _unframed(low.reshape(frame.shape), np.maximum) + 1  # stored ranges are one step more than compared ones
    most = _unframed(high.reshape(frame.shape), np.minimum) + 1
    coarse = np.where(most > _EMPTY, 0, image).astype(np.int32)
    missing = coarse > 0
    for step in 2 ** np.arange(10, -1, -1):
        rounded = most // step * step
        fits = missing & (rounded >= np.maximum(least, 1))
        coarse[fits] = rounded[fits]
        missing &= ~fits
    return coarse.astype(np.uint16)


def _texel_indices(image: NDArray[np.uint16], x: Floats, y: Floats, texels: int) -> list[NDArray[np.intp]]:
    """Flat indices [N] into the framed image of the one or four texels that points read."""
    if texels == 1:
        return [nearest_texel(image, x, y)]
    width = image.shape[1] + 2
    start = (np.floor(y).astype(np.intp) + 1) * width + np.floor(x).astype(np.intp) + 1
    return [start + shift for shift in (0, 1, width, width + 1)]


def _unframed(frame: NDArray[Any], join: np.ufunc) -> NDArray[Any]:
    """Values for the texels of an image, joined from those of the framed image, which repeats its border."""
    for inner, outer in ((1, 0), (-2, -1)):
        frame[inner] = join(frame[inner], frame[outer])
        frame[:, inner] = join(frame[:, inner], frame[:, outer])
    return frame[1:-1, 1:-1]


def facing_bytes(view: ExactView) -> int:
    """Bytes that facing adds to the coded labels."""
    return _label_bytes(view, view.facing) - _label_bytes(view, np.zeros_like(view.facing))


def _label_bytes(view: ExactView, bit: NDArray[np.bool_]) -> int:
    return len(encode_images(view.range, view.sample.labels, bit.view(np.uint8), None))


def exact_masks(view: ExactView) -> dict[str, Cost]:
    """The exact mask stored in three ways: as a bit of every run of labels, which takes facing's place; as an image of
    its own by the codec; and packed eight pixels a byte, by zstd.

    Seconds: until there is a bool [H, W], beyond what decoding labels takes anyway.
    """
    lit = view.lit
    byte = label_bytes(view.sample.labels, lit)
    packed = zstandard.ZstdCompressor(level=1).compress(np.packbits(lit).tobytes())
    unpack = zstandard.ZstdDecompressor()

    def from_packed() -> NDArray[np.bool_]:
        bits = np.frombuffer(unpack.decompress(packed), np.uint8)
        return np.unpackbits(bits, count=lit.size).reshape(lit.shape).view(np.bool_)

    def from_labels() -> NDArray[np.bool_]:
        bits: NDArray[np.bool_] = np.logical_and(byte & np.uint8(0x40), byte != BACKGROUND)
        return bits

    in_labels = _label_bytes(view, lit) - _label_bytes(view, np.zeros_like(lit))
    return {
        "bit of the label byte": (in_labels, median_time(from_labels, _ROUNDS)[0]),
        MASK_IMAGE: coded(_NOTHING, _NO_LABELS, lit.astype(np.uint16)),
        "packed bits, zstd": (len(packed), median_time(from_packed, _ROUNDS)[0]),
    }
