"""Memory of the compiled loops, kept from sample to sample: fresh memory costs as much as the work."""

from __future__ import annotations

import threading
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Scratch(NamedTuple):
    """Room for the lists of one image's foreground pixels; pages that are never touched take no memory.

    edges: where runs of foreground begin and end; changes: whether a pixel begins or ends one, zeros behind the image;
    marks: which pixels are kept; start: the texel of each point; candidates: the points near an occupied texel; floats:
    coordinates of points, and texels; near: which texels have an occupied one beside them, zeros between samples;
    words: random bits; halves, quarters: the same memory in smaller pieces.
    """

    edges: NDArray[np.int32]
    changes: NDArray[np.uint8]
    marks: NDArray[np.uint8]
    start: NDArray[np.int32]
    candidates: NDArray[np.int32]
    floats: NDArray[np.float32]
    near: NDArray[np.uint8]
    words: NDArray[np.uint64]
    halves: NDArray[np.uint32]
    quarters: NDArray[np.uint16]


_of_thread = threading.local()


def scratch_for(pixels: int, texels: int) -> Scratch:
    """The calling thread's scratch for images of `pixels` and projector images of `texels`."""
    if getattr(_of_thread, "sizes", None) != (pixels, texels):
        words = np.empty(pixels // 2 + 4, np.uint64)
        _of_thread.scratch = Scratch(
            edges=np.empty(pixels + 2, np.int32),
            changes=np.zeros(pixels // 8 * 8 + 8, np.uint8),
            marks=np.empty(pixels, np.uint8),
            start=np.empty(pixels, np.int32),
            candidates=np.empty(pixels + 1, np.int32),
            floats=np.empty((7, pixels), np.float32),
            near=np.zeros(texels, np.uint8),
            words=words,
            halves=words.view(np.uint32),
            quarters=words.view(np.uint16),
        )
        _of_thread.sizes = pixels, texels
    made: Scratch = _of_thread.scratch
    return made


def constant(array: NDArray[Any]) -> NDArray[Any]:
    """`array`, flat and read-only, so that loops always get one kind of array and are compiled once."""
    flat = (
        array if array.flags.c_contiguous and array.flags.aligned else np.require(array, requirements=("C", "A"))
    ).reshape(-1)
    flat.flags.writeable = False
    return flat


def copy_unless_same(array: NDArray[Any], to: NDArray[Any]) -> None:
    """Copy an array into another, unless they are the same."""
    if array is not to:
        np.copyto(to, array)
