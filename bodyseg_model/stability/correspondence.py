"""Point correspondence between frames: the pixel of a later frame that sees the same point of a body's skin.

It is computed from the meshes, not estimated from images: bodies of one subject share their triangles, so a point of
the surface is a triangle and barycentric weights in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.core.rig import PlacedCamera
from bodyseg_data.meshes.mesh import Mesh
from bodyseg_data.meshes.partition.surface_parts import Partition
from bodyseg_data.packing.sampler import faces_towards, surface_points
from bodyseg_data.rendering.renderer import Surface

NEAR_M: Final = 0.005
"""A point counts as seen by the pixel it projects into if the surface at the pixel's centre is at most this far from
it, metres. A pixel is about 3.4 mm wide at 2.55 m."""

NOT_SEEN: Final = -1


@dataclass(frozen=True, repr=False)
class RenderedBody:
    """A body in front of a camera, and its rendered surface."""

    mesh: Mesh
    camera: PlacedCamera
    surface: Surface

    def __repr__(self) -> str:
        return f"RenderedBody({self.mesh.name!r}, {len(self.pixels)} pixels)"

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
        """The surface points at the centres of `pixels`, [N, 3], metres, body frame."""
        return surface_points(self.surface, self.camera, *np.divmod(self.pixels, self.surface.face.shape[1]))

    @cached_property
    def weights(self) -> NDArray[np.float64]:
        """Barycentric weights of `points` in `faces`, [N, 3]."""
        return self.mesh.barycentric(self.faces, self.points)

    def labels(self, parts: Partition) -> NDArray[np.uint8]:
        """Label image of the body, uint8 [H, W], BACKGROUND where the camera does not see it."""
        labels = np.full(self.surface.face.shape, BACKGROUND, np.uint8)
        labels.ravel()[self.pixels] = parts.labels_at(self.mesh, self.faces, self.points)
        return labels


def follow(first: RenderedBody, later: RenderedBody) -> NDArray[np.intp]:
    """For each of `first.pixels` the pixel of `later` that sees the same point of the skin, int [N], or NOT_SEEN.

    A point projects into one pixel of `later`. It is seen there if it lies in the frame, its triangle faces the camera,
    and the pixel sees the same triangle, one that shares a corner with it, or a point within `NEAR_M`. Triangles are
    compared because at a grazing angle one pixel spans more than `NEAR_M`.

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
    index_of = np.full(rows * columns, NOT_SEEN, np.intp)  # of a pixel in later.pixels
    index_of[later.pixels] = np.arange(len(later.pixels))
    candidates = np.flatnonzero(inside)
    column, row = image[candidates].astype(np.intp).T
    index = index_of[row * columns + column]
    candidates, index = candidates[index >= 0], index[index >= 0]
    near = np.linalg.norm(later.points[index] - points[candidates], axis=1) <= NEAR_M
    near |= _touch(later.mesh, first.faces[candidates], later.faces[index])
    found[candidates[near]] = later.pixels[index[near]]
    return found


def _touch(mesh: Mesh, one: NDArray[np.int32], other: NDArray[np.int32]) -> NDArray[np.bool_]:
    """True for pairs of triangles that share a corner, bool [N]; equal triangles do."""
    touch: NDArray[np.bool_] = (mesh.faces[one][:, :, None] == mesh.faces[other][:, None, :]).any(axis=(1, 2))
    return touch
