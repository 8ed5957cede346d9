"""RVL, the lossless codec of 16-bit range images that compressedDepth may use.

Andrew D. Wilson, "Fast Lossless Depth Image Compression", ACM ISS 2017. Pixels in the order of rows are runs: how many
zeros follow, how many others, and of each of these the difference from the last one before it. A difference d is stored
as 2 d, or -2 d - 1 if it is negative. Whole numbers are stored in pieces of three bits, the lowest first, each with a
fourth bit that says whether another follows; eight such pieces are a word of 32 bits, the first in its highest bits,
and words are little-endian. ROS puts the numbers of columns and rows before, int32 each.
"""

import struct
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_model.recordings.recording import check_pixels

_SIZE: Final = struct.Struct("<ii")
_LONGEST: Final = 11  # most pieces of a number of 32 bits
_SHIFTS: Final = np.arange(28, -4, -4).astype(np.uint32)


def decode_rvl(data: bytes) -> NDArray[np.uint16]:
    """Decode an image [H, W]: columns, rows, and runs. Raises BadConfig for data that are damaged or cut off."""
    if len(data) < _SIZE.size:
        raise BadConfig(f"RVL must begin with columns and rows, {_SIZE.size} bytes, found {len(data)} in all")
    columns, rows = _SIZE.unpack_from(data)
    check_pixels((rows, columns), np.dtype(np.uint16))
    numbers = _numbers(data[_SIZE.size :])
    image, steps, places = np.zeros(rows * columns, np.uint16), [], []
    at = pixel = 0
    while pixel < len(image):
        if at + 2 > len(numbers):
            raise BadConfig(f"RVL must hold {len(image)} pixels, found {pixel}")
        zeros, others = (int(number) for number in numbers[at : at + 2])
        first, at = pixel + zeros, at + 2
        pixel = first + others
        if pixel > len(image) or at + others > len(numbers):
            raise BadConfig(f"RVL must hold {len(image)} pixels, found a run to pixel {pixel}, or its end before")
        steps.append(numbers[at : at + others])
        places.append(np.arange(first, pixel))
        at += others
    coded = np.concatenate(steps)
    image[np.concatenate(places)] = np.cumsum((coded >> 1) ^ -(coded & 1)) & 0xFFFF
    return image.reshape(rows, columns)


def _numbers(data: bytes) -> NDArray[np.int64]:
    """The whole numbers in the words of `data`, int64 [N]; the last word may add zeros at the end."""
    words = np.frombuffer(data, "<u4", len(data) // 4)
    pieces = ((words[:, np.newaxis] >> _SHIFTS) & 15).ravel()
    ends = np.flatnonzero(pieces < 8)
    if not len(ends):
        return np.zeros(0, np.int64)
    starts = np.concatenate([[0], ends[:-1] + 1])
    lengths = ends - starts + 1
    if lengths.max() > _LONGEST:
        raise BadConfig("RVL must hold numbers of at most 32 bits")
    own = np.arange(ends[-1] + 1) - np.repeat(starts, lengths)
    return np.add.reduceat((pieces[: len(own)] & 7).astype(np.int64) << 3 * own, starts)
