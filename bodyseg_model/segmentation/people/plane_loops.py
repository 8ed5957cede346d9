"""Planes of a range image, compiled; `room_planes.py` has the NumPy forms of the same bits."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from bodyseg_data.core.kernels import compiled

_kernel = partial(compiled, feature="the compiled form of the background's removal")


@_kernel
def place_points(flat: Any, pixels: Any, columns: Any, lens: Any, points: Any) -> None:
    """Write x, y and inverse range of pixels into `points`, float64 [N, 3].

    flat: float32 ranges. lens: float64 [3], principal point and focal length, pixels.
    """
    across, down, focal_px = lens[0], lens[1], lens[2]
    for i in range(pixels.size):
        row = pixels[i] // columns
        points[i, 0] = (np.float64(pixels[i] - row * columns) + 0.5 - across) / focal_px
        points[i, 1] = (np.float64(row) + 0.5 - down) / focal_px
        points[i, 2] = 1.0 / np.float64(flat[pixels[i]])


@_kernel
def span_planes(corners: Any, normals: Any, offsets: Any) -> None:
    """Write normal and offset of the plane through each triple of points into `normals`, float64 [3, N], and
    `offsets`, float64 [N]. corners: float64 [N, 3, 3].
    """
    for i in range(offsets.size):
        x, y, z = corners[i, 0]
        ux, uy, uz = corners[i, 1, 0] - x, corners[i, 1, 1] - y, corners[i, 1, 2] - z
        vx, vy, vz = corners[i, 2, 0] - x, corners[i, 2, 1] - y, corners[i, 2, 2] - z
        a, b, c = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        normals[0, i], normals[1, i], normals[2, i] = a, b, c
        offsets[i] = a * x + b * y + c * z


@_kernel
def explained(judges: Any, normals: Any, offsets: Any, tolerance: Any, surface: Any) -> None:
    """Add the area at each judge that a candidate plane explains, as if it faced a camera of focal length 1, to that
    candidate's `surface`, float64 [N].

    judges: float64 [M, 3], x, y and inverse range. normals: float64 [3, N]. offsets: float64 [N].
    """
    a, b, c = normals[0], normals[1], normals[2]
    for judge in range(judges.shape[0]):
        x, y, z = judges[judge, 0], judges[judge, 1], judges[judge, 2]
        side = 1.0 / z
        area = side * side
        for i in range(surface.size):
            away = x * a[i] + y * b[i] + z * c[i] - offsets[i]
            surface[i] += area if abs(away) < tolerance * abs(c[i]) else 0.0


@_kernel
def moments(points: Any, plane: Any, tolerance: Any, sums: Any) -> None:
    """Add up the moments of points near a plane: of x, y, 1 and inverse range, in the order of `room_planes._moments`.

    points: float64 [N, 3]. plane: float64 [3]. sums: float64 [9].
    """
    a, b, c = plane[0], plane[1], plane[2]
    xx = xy = x_sum = yy = y_sum = count = x_inverse = y_inverse = inverse_sum = 0.0
    for i in range(points.shape[0]):
        x, y, inverse = points[i, 0], points[i, 1], points[i, 2]
        near = 1.0 if abs(x * a + y * b + c - inverse) <= tolerance else 0.0  # no branch, which would be guessed wrong
        xx += near * (x * x)
        xy += near * (x * y)
        x_sum += near * x
        yy += near * (y * y)
        y_sum += near * y
        count += near
        x_inverse += near * (x * inverse)
        y_inverse += near * (y * inverse)
        inverse_sum += near * inverse
    sums[0], sums[1], sums[2], sums[3], sums[4] = xx, xy, x_sum, yy, y_sum
    sums[5], sums[6], sums[7], sums[8] = count, x_inverse, y_inverse, inverse_sum


@_kernel
def mark_plane(flat: Any, pixels: Any, columns: Any, lens: Any, plane: Any, tolerance: Any, near: Any) -> Any:
    """Mark those of ascending pixels near a plane in `near`, bool [N]; returns the sum of their ranges cubed.

    flat: float32 ranges. lens: float64 [3], principal point and focal length, pixels.
    """
    across, down = lens[0], lens[1]
    a, b, c = plane[0] / lens[2], plane[1] / lens[2], plane[2]
    total, first = 0.0, 0
    while first < pixels.size:
        row = pixels[first] // columns
        start = row * columns
        end = first + np.searchsorted(pixels[first : first + columns], start + columns)
        level = (np.float64(row) + 0.5 - down) * b + c
        of_row, marks = pixels[first:end], near[first:end]
        for i in range(of_row.size):  # free of branches, so that the compiler takes many pixels at once
            x, z = np.float64(of_row[i] - start) + 0.5 - across, np.float64(flat[np.uint64(of_row[i])])
            marks[i] = abs((x * a + level) * z - 1.0) <= tolerance * z
        for i in range(of_row.size):
            if marks[i]:
                z = np.float64(flat[np.uint64(of_row[i])])
                total += z * z * z
        first = end
    return total
