"""Which pixel of a later frame sees the same place of a body's skin: exactly, from the meshes, not from images.

Bodies of one subject share their triangles, so a place of the surface is a triangle and barycentric weights there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.rig import PlacedCamera
from bodyseg_data.meshes.mesh import Mesh
from bodyseg_data.packing.sampler import faces_towards, surface_points
from bodyseg_data.rendering.renderer import Surface

NEAR_M: Final = 0.005
"""A place is seen by the pixel it falls in if what the pixel's centre sees is at most this far from it. A pixel is
about 3.4 mm wide at 2.55 m."""

NOT_SEEN: Final = -1


@dataclass(frozen=True)
class SeenBody:
    """A body before a camera, and what the renderer says of it."""

    mesh: Mesh
    camera: PlacedCamera
    surface: Surface

    @cached_property
    def pixels(self) -> NDArray[np.intp]:
        """The pixels that see the body, int [N], row * columns + column, ascending."""
        return np.flatnonzero(self.surface.face >= 0)

    @cached_property
    def faces(self) -> NDArray[np.int32]:
        """The triangle that each of `pixels` sees, int32 [N]."""
        return self.surface.face.take(self.pixels)

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """The places that the centres of `pixels` see, [N, 3], metres, body frame."""
        return surface_points(self.surface, self.camera, *np.divmod(self.pixels, self.surface.face.shape[1]))

    @cached_property
    def weights(self) -> NDArray[np.float64]:
        """The same places as barycentric weights in `faces`, [N, 3]."""
        return self.mesh.barycentric(self.faces, self.points)


def follow(first: SeenBody, later: SeenBody) -> NDArray[np.intp]:
    """For each of `first.pixels` the pixel of `later` that sees the same place of the skin, int [N], or NOT_SEEN.

    The place is looked for where it projects to. It is seen there if it lies in the frame, its triangle faces the
    camera, and the pixel sees the same triangle, one that shares a corner with it, or a point within `NEAR_M`. The
    first two allow for surfaces seen at a grazing angle, where one pixel spans more than that.

    Raises BadConfig for bodies that do not share their triangles.
    """
    if not np.array_equal(first.mesh.faces, later.mesh.faces):
        raise BadConfig(
            f"only bodies that share their triangles can be followed, found {first.mesh.name} and {later.mesh.name}"
        )
    points = np.einsum("nc,ncx->nx", first.weights, later.mesh.vertices[later.mesh.faces[first.faces]])
    image, range_m = later.camera.project(points)
    rows, columns = later.surface.face.shape
    inside = (range_m > 0) & (image >= 0).all(axis=1) & (image < (columns, rows)).all(axis=1)
    inside &= faces_towards(later.mesh, first.faces, points, later.camera.position)
    found = np.full(len(points), NOT_SEEN, np.intp)
    place_of = np.full(rows * columns, NOT_SEEN, np.intp)  # of a pixel among those that see the body
    place_of[later.pixels] = np.arange(len(later.pixels))
    asked = np.flatnonzero(inside)
    column, row = image[asked].astype(np.intp).T
    place = place_of[row * columns + column]
    asked, place = asked[place >= 0], place[place >= 0]
    near = np.linalg.norm(later.points[place] - points[asked], axis=1) <= NEAR_M
    near |= _touch(later.mesh, first.faces[asked], later.faces[place])
    found[asked[near]] = later.pixels[place[near]]
    return found


def _touch(mesh: Mesh, one: NDArray[np.int32], other: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Whether triangles share a corner, bool [N]; a triangle shares its own."""
    touch: NDArray[np.bool_] = (mesh.faces[one][:, :, None] == mesh.faces[other][:, None, :]).any(axis=(1, 2))
    return touch
