"""People in a frame, by its labels: an image of who is where, points in space, and parts.

Coordinates are the camera's, metres: x to the right and y down in the image, z ahead along the optical axis. Of a
frame that shows left for right, x is turned round, as the camera itself sees. Records are NumPy structured arrays.
"""

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND

POINT: Final = np.dtype(
    [("x", "f4"), ("y", "f4"), ("z", "f4"), ("label", "u1"), ("person", "u2"), ("confidence", "f4")], align=True
)
"""A point of a person. label: 255 where it has none. person: from 1. confidence: 0 to 1."""

PART: Final = np.dtype(
    [
        ("person", "u2"),
        ("part", "u1"),
        ("pixels", "u4"),
        ("area_m2", "f4"),
        ("rows", "i4", 2),
        ("columns", "i4", 2),
        ("centroid_m", "f4", 3),
        ("nearest_m", "f4", 3),
        ("distance_m", "f4"),
        ("confidence", "f4"),
    ],
    align=True,
)
"""A part of a person. person: from 1. part: its label. pixels: how many show it. area_m2: the area that they cover, as
seen from the camera, square metres: less than the skin's where it is slanted. rows, columns: of its box, the first and
one beyond the last, as slices take them. centroid_m: mean of its points. nearest_m: the one nearest to the camera, or
to the point that was given, and distance_m: how far. confidence: mean of its pixels, 0 to 1.
"""

NUMBERS: Final = 1 << 8
"""Numbers of labels, of which 255 is none."""

Records = NDArray[np.void]


class SurfacePixels:
    """The pixels of people that have a range, each person's in reading order, and runs of one part within a row.

    pixels: int64 [N], row * W + column. person: uint16 [N], from 1. label: uint8 [N]. keys: uint32 [N], 256 x person +
    label. row, column: int32 [N]. confidence: float32 [N]. x, y, z: float32 [N], metres, in the camera's frame. across,
    down: float32 [W] and [H], x and y at z = 1. pixel_m2: what a pixel covers at z = 1, square metres. begin: int64
    [R], the first pixel of each run.
    """

    def __init__(self, answer: Any) -> None:
        bodies, columns = answer.bodies, answer.labels.shape[1]
        pixels: NDArray[np.intp] = np.concatenate([np.zeros(0, np.intp), *(body.pixels for body in bodies)])
        person: NDArray[np.uint16] = np.repeat(
            np.arange(1, len(bodies) + 1, dtype=np.uint16), [len(body.pixels) for body in bodies]
        )
        confidence: NDArray[np.float32] = np.concatenate(
            [np.zeros(0, np.float32), *(body.confidence for body in bodies)]
        )
        z: NDArray[np.float32] = answer.range_m.ravel().take(pixels).astype(np.float32, copy=False)
        if len(z) and not (z.min() > 0 and z.max() < np.inf):  # or NaN
            measured = (z > 0) & (z < np.inf)
            pixels, person, confidence, z = pixels[measured], person[measured], confidence[measured], z[measured]
        self.pixels, self.person, self.confidence, self.z = pixels, person, confidence, z
        self.label = answer.labels.ravel().take(pixels)
        self.keys = person.astype(np.uint32) * NUMBERS + self.label  # NumPy 1 stays in 16 bits beside a scalar of 32
        narrow = pixels.astype(np.int32)
        self.row = narrow // np.int32(columns)
        self.column = narrow - self.row * np.int32(columns)
        self.across, self.down = (slopes.astype(np.float32) for slopes in answer.camera.slopes)
        self.pixel_m2 = answer.camera.focal_px**-2.0
        if answer.mirrored:
            self.across = -self.across
        self.x, self.y = z * self.across.take(self.column), z * self.down.take(self.row)
        begins = np.ones(len(pixels), np.bool_)
        begins[1:] = (np.diff(self.keys) != 0) | (np.diff(narrow) != 1) | (self.column[1:] == 0)
        self.begin = np.flatnonzero(begins)

    def points(self) -> Records:
        """One `POINT` each, [N], those without a label too: whoever keeps away from people needs them."""
        points = np.zeros(len(self.pixels), POINT)
        for name in POINT.names or ():
            points[name] = getattr(self, name)
        return points

    def parts(self, near_m: Sequence[float] = (0.0, 0.0, 0.0)) -> Records:
        """Each part of each person, `PART` [N], by person and part; what no pixel shows is left out, as is no label.

        near_m: the point, in the camera's frame, to which the nearest point is sought: the camera itself, or a gripper.
        Raises BadConfig for a point that is not three finite numbers.
        """
        if len(near_m) != 3 or not all(map(math.isfinite, near_m)):
            raise BadConfig(f"a point must have three finite coordinates, metres, found {near_m}")
        if not len(self.pixels):
            return np.zeros(0, PART)
        begin, end = self.begin, np.append(self.begin[1:], len(self.pixels))
        found, of = np.unique(self.keys[begin], return_inverse=True)
        order = np.argsort(of, kind="stable")  # by part, each part's in reading order
        runs = np.bincount(of)
        first = np.cumsum(runs) - runs

        def sums(values: NDArray[Any]) -> NDArray[np.float64]:
            return np.bincount(of, np.add.reduceat(values, begin, dtype=np.float64)).astype(np.float64, copy=False)

        parts = np.zeros(len(found), PART)
        parts["person"], parts["part"] = np.divmod(found, NUMBERS)
        parts["pixels"] = count = np.bincount(of, end - begin)
        parts["confidence"] = sums(self.confidence) / count
        parts["area_m2"] = sums(np.square(self.z)) * self.pixel_m2
        last = order[first + runs - 1]
        parts["rows"] = np.stack([self.row[begin[order[first]]], self.row[begin[last]] + 1], axis=1)
        left, right = self.column[begin[order]], self.column[end[order] - 1] + 1
        parts["columns"] = np.stack([np.minimum.reduceat(left, first), np.maximum.reduceat(right, first)], axis=1)
        points, squares = (self.x, self.y, self.z), np.zeros(len(self.z), np.float32)
        for axis, (along, to) in enumerate(zip(points, near_m, strict=True)):
            parts["centroid_m"][:, axis] = sums(along) / count
            squares += np.square(along - np.float32(to) if to else along)
        least = np.minimum.reduceat(squares, begin)[order]
        nearest = np.minimum.reduceat(least, first)
        has = np.flatnonzero(least == np.repeat(nearest, runs))
        winners = order[has[np.searchsorted(has, first)]]
        at = [start + squares[start:stop].argmin() for start, stop in zip(begin[winners], end[winners], strict=True)]
        parts["nearest_m"], parts["distance_m"] = np.stack([along[at] for along in points], axis=1), np.sqrt(nearest)
        return parts.compress(parts["part"] != BACKGROUND)  # a mask leaves bytes between fields unset
