"""The projector's range out of the camera's: for sets whose renderer gave none.

What the camera sees is taken for all that there is. Its pixels are the nodes of a mesh, without the triangles that
bridge an edge, and the mesh is drawn as the projector sees it. So a surface that the camera does not see casts no
shadow: the far side of a thing, and what stands outside of the camera's image.
"""

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.occlusion import shadow_tests
from bodyseg_data.machine import compiled
from bodyseg_data.rigs import Rig
from bodyseg_data.samples import FARTHEST_STEPS


def seen_by_projectors(camera_range: NDArray[np.uint16], rig: Rig) -> NDArray[np.uint16]:
    """The range of the rig's projectors, uint16 [Hp, Wp], one below the other, made of the camera's, uint16 [H, W].

    In steps, 0 where unknown. Raises BadSample for a kind or shape unlike the camera's, MissingLibrary without numba.
    """
    found = np.zeros(rig.projector_shape, np.uint16)
    for test, image in zip(shadow_tests(rig), np.split(found, [rig.projector.rows]), strict=False):
        test.check(camera_range, image, camera_range != 0)
        slopes = (each.astype(np.float32) for each in (test.of_columns, test.of_rows))
        places = np.empty((3, *camera_range.shape), np.float32)
        joined = _joined(camera_range, test.edge_steps), _joined(camera_range.T, test.edge_steps).T
        ranges, below, beside = map(np.ascontiguousarray, (camera_range, *joined))
        _loop()(ranges, *slopes, test.offsets, below, beside, places, image)
    return found


def _joined(ranges: NDArray[np.uint16], edge: np.float32) -> NDArray[np.bool_]:
    """Mask of pixels on one surface with the pixel below, bool [H - 1, W]; without meaning where one is not measured.

    Their ranges differ by less than an edge, or by about as much as the next ones, as on a floor at a grazing angle.
    """
    jump = np.diff(ranges.astype(np.int32), axis=0)
    found: NDArray[np.bool_] = np.abs(jump) < edge
    straight = np.abs(np.diff(jump, axis=0)) < edge
    found[1:] |= straight
    found[:-1] |= straight
    return found


@lru_cache(maxsize=1)
def _loop() -> Any:
    return compiled(_cast, "shadows of what the camera sees")


def _cast(
    ranges: Any, of_columns: Any, of_rows: Any, offsets: Any, below: Any, beside: Any, places: Any, found: Any
) -> None:
    """Draw the camera's image as a mesh into the projector's image `found`, uint16 [Hp, Wp]; both in steps.

    places: memory for x, y and 1 / range of all pixels in that image, float32 [3, H, W]. below, beside: `_joined`, of
    the pixel below and of the one to the right. of_columns, of_rows, offsets: as of `ShadowTest`, float32.
    """
    rows, columns = ranges.shape
    high, wide = found.shape
    alone = np.ones(ranges.shape, np.bool_)  # pixels that are in no triangle
    for r in range(rows):
        for c in range(columns):
            z = np.float32(ranges[r, c])
            away = z * (of_columns[2, c] + of_rows[2, r]) + offsets[2]
            seen = z > 0 and away >= 1 and away <= FARTHEST_STEPS
            places[2, r, c] = 1 / away if seen else 0
            places[0, r, c] = (z * (of_columns[0, c] + of_rows[0, r]) + offsets[0]) / away if seen else 0
            places[1, r, c] = (z * (of_columns[1, c] + of_rows[1, r]) + offsets[1]) / away if seen else 0
    for r in range(rows - 1):
        for c in range(columns - 1):
            for half in range(2):  # upper left and lower right triangle of four pixels
                r0, c0 = r + half, c + half
                seen = places[2, r0, c0] > 0 and places[2, r + 1, c] > 0 and places[2, r, c + 1] > 0
                if not (seen and below[r, c + half] and beside[r + half, c]):
                    continue
                alone[r0, c0] = alone[r + 1, c] = alone[r, c + 1] = False
                x0, y0 = places[0, r0, c0], places[1, r0, c0]
                x1, y1 = places[0, r + 1, c] - x0, places[1, r + 1, c] - y0
                x2, y2 = places[0, r, c + 1] - x0, places[1, r, c + 1] - y0
                area = x1 * y2 - x2 * y1
                if area == 0:
                    continue
                w0 = places[2, r0, c0]
                w1, w2 = places[2, r + 1, c] - w0, places[2, r, c + 1] - w0
                top: Any = max(0, np.int64(np.ceil(y0 + min(0, y1, y2))))
                bottom = min(high - 1, np.int64(np.floor(y0 + max(0, y1, y2))))
                left: Any = max(0, np.int64(np.ceil(x0 + min(0, x1, x2))))
                right = min(wide - 1, np.int64(np.floor(x0 + max(0, x1, x2))))
                for row in range(top, bottom + 1):
                    for column in range(left, right + 1):
                        along = ((column - x0) * y2 - (row - y0) * x2) / area
                        across = ((row - y0) * x1 - (column - x0) * y1) / area
                        if along >= 0 and across >= 0 and along + across <= 1:
                            away = np.uint16(np.rint(1 / (w0 + along * w1 + across * w2)))
                            if found[row, column] == 0 or away < found[row, column]:
                                found[row, column] = away
    for r in range(rows):  # single pixels: rims, and thin things without a triangle
        for c in range(columns):
            y, x = np.int64(np.rint(places[1, r, c])), np.int64(np.rint(places[0, r, c]))
            if places[2, r, c] > 0 and 0 <= y < high and 0 <= x < wide:
                away = np.uint16(np.rint(1 / places[2, r, c]))
                if found[y, x] == 0 or (alone[r, c] and away < found[y, x]):
                    found[y, x] = away
