"""Memory of the compiled loops, kept from sample to sample: fresh memory costs as much as the work."""

from __future__ import annotations

import threading
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

CHUNK: Final = 2048
"""How many foreground pixels the loops handle at a time: what they need then stays in the first cache."""

BLOCK: Final = 32
"""How many of them, at most, share the bounds of their texels (`shadow_loops.bound_pieces`)."""

ROOM: Final = CHUNK + BLOCK
"""The distance of rows in flat arrays of numbers of points: the compiler takes a whole block at once, also the last."""


class Scratch(NamedTuple):
    """Room for the lists of one chunk of foreground pixels, and of one image.

    Of an image: edges: where runs of foreground begin and end; changes: whether a pixel begins or ends one, zeros
    behind the image; coarse: which texels of four rows of the projector's image hold anything, a bit for a few columns;
    nearest: the least range of the four texels that begin at one, 65535 between samples.
    Of a chunk: pieces, its pieces of runs; extremes: their ranges; boxes: their texels; marks: which points are kept;
    floats, ints: numbers of points, flat, in rows of `ROOM`; texels: the four of each; candidates: points near an
    occupied texel; words: random bits; halves, quarters: the same memory in smaller pieces.
    """

    edges: NDArray[np.int32]
    changes: NDArray[np.uint8]
    coarse: NDArray[np.uint64]
    nearest: NDArray[np.uint16]
    pieces: NDArray[np.int32]
    extremes: NDArray[np.float32]
    boxes: NDArray[np.int32]
    marks: NDArray[np.uint8]
    floats: NDArray[np.float32]
    ints: NDArray[np.int32]
    texels: NDArray[np.uint16]
    candidates: NDArray[np.int32]
    words: NDArray[np.uint64]
    halves: NDArray[np.uint32]
    quarters: NDArray[np.uint16]


_of_thread = threading.local()


def scratch_for(pixels: int, rows: int, columns: int) -> Scratch:
    """The calling thread's scratch for images of `pixels` and a projector's of `texels`."""
    if getattr(_of_thread, "sizes", None) != (pixels, rows, columns):
        words = np.empty(CHUNK // 2, np.uint64)
        _of_thread.scratch = Scratch(
            edges=np.empty(pixels + 2, np.int32),
            changes=np.zeros(pixels // 8 * 8 + 8, np.uint8),
            coarse=np.empty(rows + 3, np.uint64),
            nearest=np.full(rows * columns, 65535, np.uint16),
            pieces=np.empty((5, CHUNK), np.int32),
            extremes=np.empty((2, CHUNK), np.float32),
            boxes=np.empty((4, CHUNK), np.int32),
            marks=np.empty(ROOM, np.uint8),
            floats=np.empty(3 * ROOM, np.float32),
            ints=np.empty(3 * ROOM, np.int32),
            texels=np.empty(4 * ROOM, np.uint16),
            candidates=np.empty(ROOM, np.int32),
            words=words,
            halves=words.view(np.uint32),
            quarters=words.view(np.uint16),
        )
        _of_thread.sizes = pixels, rows, columns
    made: Scratch = _of_thread.scratch
    return made


def second_scratch_for(scratch: Scratch, rows: int, columns: int) -> Scratch:
    """The calling thread's scratch for a second projector, whose image has `rows` and `columns`.

    Apart from `coarse`, `nearest` and `marks`, which hold one projector's results, its memory is that of `scratch`.
    """
    if getattr(_of_thread, "second_sizes", None) != (rows, columns):
        _of_thread.second = (
            np.empty(rows + 3, np.uint64),
            np.full(rows * columns, 65535, np.uint16),
            np.empty(ROOM, np.uint8),
        )
        _of_thread.second_sizes = rows, columns
    coarse, nearest, marks = _of_thread.second
    return scratch._replace(coarse=coarse, nearest=nearest, marks=marks)


def constant(array: NDArray[Any]) -> NDArray[Any]:
    """`array`, flat and read-only, so that loops always get one kind of array and are compiled once."""
    fits = array.flags.c_contiguous and array.flags.aligned
    flat = (array if fits else np.require(array, requirements=("C", "A"))).reshape(-1)
    flat.flags.writeable = False
    return flat


def copy_unless_same(array: NDArray[Any], to: NDArray[Any]) -> None:
    """Copy an array into another, unless they are the same."""
    if array is not to:
        np.copyto(to, array)
