"""PNG images as baselines of `bench loader` store them, and the quickest of three libraries that decode them."""

from __future__ import annotations

import io
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benches.measuring import median_time
from bodyseg_data.artifacts import RangeImage
from bodyseg_data.core import BadSample

_ROUNDS: Final = 5

Decode = Callable[[bytes], NDArray[Any]]
"""Makes [H, W] of a grey PNG: uint16 or uint8, as stored. Raises ImportError if its library is absent."""


def png(array: NDArray[Any]) -> bytes:
    """An image as Pillow writes it by default."""
    file = io.BytesIO()
    Image.fromarray(array).save(file, "PNG")
    return file.getvalue()


def by_pillow(data: bytes) -> NDArray[Any]:
    """Decode with Pillow."""
    with Image.open(io.BytesIO(data)) as image:
        return np.array(image)


def by_cv2(data: bytes) -> NDArray[Any]:
    """Decode with OpenCV."""
    import cv2

    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED))


def by_imagecodecs(data: bytes) -> NDArray[Any]:
    """Decode with imagecodecs, by libpng: its other decoder, libspng, refuses grey images of 16 bits."""
    import imagecodecs

    found: NDArray[Any] = imagecodecs.png_decode(data)
    return found


DECODERS: Final[Mapping[str, Decode]] = {"pillow": by_pillow, "cv2": by_cv2, "imagecodecs": by_imagecodecs}
"""Library -> what decodes with it."""


@dataclass(frozen=True)
class Timed:
    """Milliseconds of processor that each of `DECODERS` takes for both images of a sample; None if it is absent."""

    ms_per_sample: dict[str, float | None]

    @property
    def used(self) -> str:
        """The quickest."""
        return min((ms, name) for name, ms in self.ms_per_sample.items() if ms is not None)[1]

    def to_json(self) -> dict[str, Any]:
        """Names and figures as they stand in the results."""
        return {"used": self.used, "ms_per_sample": self.ms_per_sample}


def time_decoders(images: Sequence[RangeImage], decoders: Mapping[str, Decode] = DECODERS) -> Timed:
    """Decode range and labels of all images with each library in turn, five times over; the median time counts.

    Raises BadSample if a library changes a pixel.
    """
    stored = [(png(image.range), png(image.labels)) for image in images]
    rounds: dict[str, list[float]] = {}
    for name, decode in decoders.items():
        try:
            for image, (range_png, labels_png) in zip(images, stored, strict=True):
                _check(f"{name}: {image.key}", image.range, decode(range_png))
                _check(f"{name}: {image.key}", image.labels, decode(labels_png))
        except ImportError:
            continue
        rounds[name] = []
    for _ in range(_ROUNDS):
        for name, seconds in rounds.items():
            seconds.append(median_time(partial(_decode_all, decoders[name], stored))[0])
    ms = {name: round(statistics.median(seconds) / len(images) * 1e3, 4) for name, seconds in rounds.items()}
    return Timed({name: ms.get(name) for name in decoders})


def _decode_all(decode: Decode, stored: Sequence[tuple[bytes, bytes]]) -> None:
    for range_png, labels_png in stored:
        decode(range_png)
        decode(labels_png)


def _check(what: str, expected: NDArray[Any], found: NDArray[Any]) -> None:
    if found.dtype != expected.dtype or not np.array_equal(found, expected):
        raise BadSample(f"{what} is decoded to {found.dtype} {found.shape} that is not what was stored")
