"""Numbers that the NumPy form of an artifact and its compiled loop share."""

from statistics import NormalDist
from typing import Final

import numpy as np
from numpy.typing import NDArray

FAR: Final = np.float32(1e7)  # steps: beyond every range; its square times that of a focal length is a float32

# A segment is a float's exponent and the highest four bits of its mantissa, the rest is the offset in the segment. The
# lowest segment begins at 0.5, the last one is 2**31 alone.
SEGMENT_SHIFT: Final = 19
OFFSET_MASK: Final = (1 << SEGMENT_SHIFT) - 1
FIRST_SEGMENT: Final = (127 - 1) << 4
_OCTAVES: Final = 32


def _segments() -> NDArray[np.float32]:
    """Quadratics that meet the inverse distribution function at the three Chebyshev points of every segment.

    float32 [3, segments]: the factors of 1, offset and offset**2.
    """
    points = 0.5 - 0.5 * np.sqrt([0.75, 0.0, 0.75]) * (1, 0, -1)  # cosines of 30, 90 and 150 degrees
    starts = np.ldexp(1 + np.arange(16) / 16, np.arange(-1, _OCTAVES - 1)[:, None]).ravel()
    widths = np.repeat(np.ldexp(1 / 16, np.arange(-1, _OCTAVES - 1)), 16)
    inverse = NormalDist().inv_cdf
    a, b, c = ([-inverse(x) for x in (starts + point * widths) / 2**32] for point in points)
    slope = np.subtract(b, a) / (points[1] - points[0])
    bend = (np.subtract(c, b) / (points[2] - points[1]) - slope) / (points[2] - points[0])
    constant = a - slope * points[0] + bend * points[0] * points[1]
    linear = slope - bend * (points[0] + points[1])
    scale = 2.0**-SEGMENT_SHIFT
    table = np.stack([constant, linear * scale, bend * scale**2])
    return np.ascontiguousarray(np.pad(table, ((0, 0), (0, 1))), np.float32)


SEGMENTS: Final = _segments()
