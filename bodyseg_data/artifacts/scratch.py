"""Memory of the compiled loops, kept from sample to sample: fresh memory costs as much as the work."""

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
    behind the image; frame: the projector's image, less one step, with its border repeated, 65535 between samples;
    coarse: the least of it in each window of 2 x 4 tiles; shift: the power of two of columns in a tile, which has half
    as many rows; across: tiles in a row.
    Of a chunk: pieces, its pieces of runs; extremes: their ranges; boxes: their texels; marks: which points are kept;
    floats, ints: numbers of points, flat, in rows of `ROOM`; texels: the four of each; words: random bits; halves,
    quarters: the same memory in smaller pieces.
    """

    edges: NDArray[np.int32]
    changes: NDArray[np.uint8]
    coarse: NDArray[np.uint16]
    frame: NDArray[np.uint16]
    shift: int
    across: int
    pieces: NDArray[np.int32]
    extremes: NDArray[np.float32]
    boxes: NDArray[np.int32]
    marks: NDArray[np.uint8]
    floats: NDArray[np.float32]
    ints: NDArray[np.int32]
    texels: NDArray[np.uint16]
    words: NDArray[np.uint64]
    halves: NDArray[np.uint32]
    quarters: NDArray[np.uint16]


_of_thread = threading.local()


def scratch_for(pixels: int, rows: int, columns: int) -> Scratch:
    """The calling thread's scratch for images of `pixels` and a projector's image of `rows` and `columns`."""
    if getattr(_of_thread, "sizes", None) != (pixels, rows, columns):
        words = np.empty(CHUNK // 2, np.uint64)
        _of_thread.scratch = Scratch(
            edges=np.empty(pixels + 2, np.int32),
            changes=np.zeros(pixels // 8 * 8 + 8, np.uint8),
            **_of_projector(rows, columns),
            pieces=np.empty((5, CHUNK), np.int32),
            extremes=np.empty((2, CHUNK), np.float32),
            boxes=np.empty((5, CHUNK), np.int32),
            marks=np.empty(ROOM, np.uint8),
            floats=np.empty(4 * ROOM, np.float32),
            ints=np.empty(ROOM, np.int32),
            texels=np.empty(4 * ROOM, np.uint16),
            words=words,
            halves=words.view(np.uint32),
            quarters=words.view(np.uint16),
        )
        _of_thread.sizes = pixels, rows, columns
    made: Scratch = _of_thread.scratch
    return made


def second_scratch_for(scratch: Scratch, rows: int, columns: int) -> Scratch:
    """The calling thread's scratch for a second projector, whose image has `rows` and `columns`.

    Apart from `marks` and what is of a projector's image, its memory is that of `scratch`.
    """
    if getattr(_of_thread, "second_sizes", None) != (rows, columns):
        _of_thread.second = _of_projector(rows, columns) | {"marks": np.empty(ROOM, np.uint8)}
        _of_thread.second_sizes = rows, columns
    return scratch._replace(**_of_thread.second)


def _of_projector(rows: int, columns: int) -> dict[str, Any]:
    shift = max((columns - 1).bit_length() - 7, 3)  # at most 128 tiles across
    across = ((columns - 1) >> shift) + 1
    coarse = np.empty((((rows - 1) >> shift - 1) + 2) * across, np.uint16)
    return {
        "coarse": coarse,
        "frame": np.full((rows + 2) * (columns + 2), 65535, np.uint16),
        "shift": shift,
        "across": across,
    }


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


def kept_array(name: str, size: int, kind: type[np.generic], use: Any = None) -> NDArray[Any]:
    """The calling thread's array of that name, [size]; zeros unless it was there before, for the same use."""
    made, used = getattr(_of_thread, name, (None, None))
    if made is None or made.size != size or used != use:
        made = np.zeros(size, kind)
        setattr(_of_thread, name, (made, use))
    return made
