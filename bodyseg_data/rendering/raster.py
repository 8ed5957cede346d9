"""Rasterisation in double precision, compiled with numba: the default renderer; needs no system libraries.

Seen from the camera's centre, the ray through a pixel meets the triangle a, b, c where the triple products ray.(b x c),
ray.(c x a) and ray.(a x b) have one sign; there the range is a.(b x c) over their sum (Olano and Greer, "Triangle scan
conversion using 2D homogeneous coordinates", 1997). Two triangles get exactly opposite numbers for an edge they share,
so no ray passes between them, and no clipping is needed. Along a row each triple product grows or falls with the
column, also as rounded, so the pixels of a triangle are one span: it is looked for at its ends only.
"""

from typing import Any, Final

import numpy as np

from bodyseg_data.machine import compiled
from bodyseg_data.meshes import Mesh, Solid
from bodyseg_data.rendering.renderer import Renderer, Surface
from bodyseg_data.rigs import PlacedCamera

_NEAR_M: Final = 1e-3  # a triangle nearer to the camera's plane is tested at every pixel
_MARGIN_PX: Final = 1e-6  # added to the bounding box of a triangle, for rounding
_NARROW_PX: Final = 12  # of triangles up to this wide, each pixel of a row is tested


class RasterRenderer(Renderer):
    """Renderer of one mesh that draws all its triangles for every camera."""

    def __init__(self, mesh: Mesh | Solid) -> None:
        self._vertices, self._faces = mesh.vertices.view(), mesh.faces.view()
        for array in (self._vertices, self._faces):
            array.flags.writeable = False  # as some are: the compiler takes seconds for either kind

    def render(self, camera: PlacedCamera) -> Surface:
        device = camera.camera
        shape = device.rows, device.columns
        depth, face = np.full(shape, np.inf), np.full(shape, -1, np.int32)
        local = np.empty_like(self._vertices)
        pixel_xy = np.empty((len(local), 2))
        pinhole = device.focal_px, *device.centre_px
        _project(self._vertices, camera.position, camera.axes, pinhole, local, pixel_xy)
        _fill(local, pixel_xy, self._faces, pinhole, device.rows, device.columns, depth.ravel(), face.ravel())
        depth[face < 0] = 0
        return Surface(depth.astype(np.float32), face)


def _project_loop(vertices: Any, position: Any, axes: Any, pinhole: Any, local: Any, pixel_xy: Any) -> None:
    """Write vertices [V, 3] in the camera's frame, metres, and their pixels [V, 2] (x, y; centres are integers).

    The order of operations is fixed, unlike that of a linear algebra library, so results are the same on any machine.
    """
    focal, centre_x, centre_y = pinhole
    for vertex in range(len(vertices)):
        x, y, z = (
            vertices[vertex, 0] - position[0],
            vertices[vertex, 1] - position[1],
            vertices[vertex, 2] - position[2],
        )
        for axis in range(3):
            local[vertex, axis] = x * axes[axis, 0] + y * axes[axis, 1] + z * axes[axis, 2]
        depth = max(local[vertex, 2], _NEAR_M)
        pixel_xy[vertex, 0] = local[vertex, 0] / depth * focal + centre_x - 0.5
        pixel_xy[vertex, 1] = local[vertex, 1] / depth * focal + centre_y - 0.5


def _fill_loop(
    local: Any, pixel_xy: Any, faces: Any, pinhole: Any, rows: int, columns: int, depth: Any, face: Any
) -> None:
    """Write range and index of the nearest triangle into the flat images `depth` (infinite) and `face` (-1)."""
    focal, centre_x, centre_y = pinhole
    across, down = (np.arange(columns) + 0.5 - centre_x) / focal, (np.arange(rows) + 0.5 - centre_y) / focal
    for number in range(len(faces)):
        i, j, k = faces[number, 0], faces[number, 1], faces[number, 2]
        if max(local[i, 2], local[j, 2], local[k, 2]) <= 0:
            continue  # behind the camera
        left, right, top, bottom = 0, columns - 1, 0, rows - 1
        if min(local[i, 2], local[j, 2], local[k, 2]) > _NEAR_M:
            # Clipped to the frame before the conversion to integers, which may overflow.
            left = int(np.ceil(max(min(pixel_xy[i, 0], pixel_xy[j, 0], pixel_xy[k, 0]) - _MARGIN_PX, 0.0)))
            right = int(np.floor(min(max(pixel_xy[i, 0], pixel_xy[j, 0], pixel_xy[k, 0]) + _MARGIN_PX, columns - 1.0)))
            top = int(np.ceil(max(min(pixel_xy[i, 1], pixel_xy[j, 1], pixel_xy[k, 1]) - _MARGIN_PX, 0.0)))
            bottom = int(np.floor(min(max(pixel_xy[i, 1], pixel_xy[j, 1], pixel_xy[k, 1]) + _MARGIN_PX, rows - 1.0)))
        if left > right or top > bottom:
            continue
        ax, ay, az = local[i, 0], local[i, 1], local[i, 2]
        bx, by, bz = local[j, 0], local[j, 1], local[j, 2]
        cx, cy, cz = local[k, 0], local[k, 1], local[k, 2]
        ux, uy, uz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        vx, vy, vz = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
        wx, wy, wz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        volume = ax * ux + ay * uy + az * uz
        if volume < 0:  # seen from inside: both sides are drawn
            volume = -volume
            ux, uy, uz, vx, vy, vz, wx, wy, wz = -ux, -uy, -uz, -vx, -vy, -vz, -wx, -wy, -wz
        narrow = right - left < _NARROW_PX
        for row in range(top, bottom + 1):
            y = down[row]
            u_row, v_row, w_row = uy * y + uz, vy * y + vz, wy * y + wz
            first, last, line = left, right, row * columns
            if narrow:
                for column in range(left, right + 1):
                    x = across[column]
                    u, v, w = ux * x + u_row, vx * x + v_row, wx * x + w_row
                    if min(u, min(v, w)) >= 0:
                        z = volume / (u + v + w)
                        pixel = np.uint64(line + column)  # unsigned: no code for negative indices
                        if z < depth[pixel]:  # NaN for a degenerate triangle
                            depth[pixel], face[pixel] = z, number
                continue
            for slope, level in ((ux, u_row), (vx, v_row), (wx, w_row)):
                if slope == 0:
                    if level < 0:
                        last = first - 1
                        break
                    continue
                guess = -level / slope * focal + centre_x - 0.5
                end = first if not guess > first else last if guess > last else int(guess)
                if slope > 0:
                    while end > first and slope * across[end - 1] + level >= 0:
                        end -= 1
                    while end <= last and slope * across[end] + level < 0:
                        end += 1
                    first = end
                else:
                    while end < last and slope * across[end + 1] + level >= 0:
                        end += 1
                    while end >= first and slope * across[end] + level < 0:
                        end -= 1
                    last = end
                if first > last:
                    break
            for column in range(first, last + 1):  # without branches, so that it is vectorised
                x, pixel = across[column], np.uint64(line + column)
                z = volume / ((ux * x + u_row) + (vx * x + v_row) + (wx * x + w_row))
                nearer = z < depth[pixel]
                depth[pixel] = z if nearer else depth[pixel]
                face[pixel] = number if nearer else face[pixel]


_project: Any = compiled(_project_loop, "the raster renderer")
_fill: Any = compiled(_fill_loop, "the raster renderer")
