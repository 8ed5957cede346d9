"""Views with the exact answer of shadow rays, and the scenes in which a shadow map is put to the test."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from benches.data.occlusion.scaled_rig import with_projector_scale
from benches.data.occlusion.shadow_rays import lit as lit_by_rays
from benches.measuring import mixed
from bodyseg_data.bodies import Body, BodyRef, open_source
from bodyseg_data.labels import PARTS
from bodyseg_data.meshes import Partition
from bodyseg_data.meshes.partitioning import find_borders
from bodyseg_data.packing import Sampler
from bodyseg_data.rendering.embree import EmbreeRenderer
from bodyseg_data.rigs import PlacedCamera, Rig
from bodyseg_data.samples import Sample, View, ViewGrid, steps

Mask = NDArray[np.bool_]

SCALES: Final = (1, 2, 3)
"""Factors by which the projector's image is finer than the rig's own, along each side."""

POSES: Final = (
    "standing",
    "arms_forward",
    "arms_crossed",
    "hands_on_hips",
    "walk_contact",
    "deep_squat",
    "crane",
    "hands_in_front",
    "fencing",
    "sitting",
)
"""Postures of the open set's person A: limbs before the trunk, limbs touching it, limbs far from it."""

BARE_CONTACT: Final = ("arms_crossed", "hands_on_hips", "praying", "hugging_knees", "curled_up")
CLOTHED_CONTACT: Final = (
    "hugging_oneself",
    "hand_behind_back",
    "hands_at_face",
    "sitting_cross_legged",
    "sitting_on_heels",
)
"""Postures of the hard set in which skin, or clothes, lie on each other; each by another person."""

GRAZING_DEG: Final = 75.0
"""From this angle between the light and a surface's normal on, light is grazing."""

CONTACT_M: Final = 0.020
"""A shadow is a contact's where what throws it is nearer than this."""

_THIN: Final = [
    part.label
    for part in PARTS
    if part.landmark[4:] in ("Radial Styloid", "Dactylion", "Lateral Malleolus", "Digit II")
]
_BESIDE: Final = 2  # pixels from a shadow's edge


@dataclass(frozen=True)
class Group:
    """Views of some bodies with one rig. share: how many there are for each ordinary view."""

    name: str
    source: str
    poses: tuple[str, ...]
    share: float
    baseline_m: float = 0.75


ORDINARY: Final = "ordinary views"
GROUPS: Final = (
    Group(ORDINARY, "open", POSES, 1.0),
    Group("contact of bare skin", "hard", BARE_CONTACT, 1 / 4),
    Group("contact of clothes", "hard", CLOTHED_CONTACT, 1 / 4),
    Group("baseline 0.3 m", "open", POSES, 1 / 4, 0.3),
    Group("baseline 1.5 m", "open", POSES, 1 / 4, 1.5),
)


@dataclass(frozen=True)
class ExactView:
    """One view as shards store it, whole projector images, and the exact answer; masks are bool [H, W].

    projector_range: scale -> uint16 [Hp, Wp], in steps. inside: foreground inside the projector's frame, which is what
    errors are counted in. lit: a ray from the projector reaches the point that the camera sees, before any rounding.
    grazing: faces the projector at `GRAZING_DEG` or more. contact: faces it, in the shadow of something nearer than
    `CONTACT_M` only. thin: wrists, hands, ankles and toes. thin_shadow: not further than two pixels from an edge of a
    shadow that such a part throws. The last two need the body's parts.
    """

    ref: BodyRef
    view: View
    sample: Sample
    projector_range: dict[int, NDArray[np.uint16]]
    inside: Mask
    lit: Mask
    grazing: Mask
    contact: Mask
    thin: Mask
    thin_shadow: Mask

    @property
    def range(self) -> NDArray[np.uint16]:
        """The camera's range image, uint16 [H, W], in steps."""
        return self.sample.range

    @property
    def facing(self) -> Mask:
        """True where the surface faces the projector, bool [H, W]."""
        return self.sample.faces_projector

    def images(self, scale: int) -> tuple[NDArray[np.uint16], NDArray[np.uint16], Mask]:
        """The arguments of `ShadowTest.lit`, with the whole projector image."""
        return self.range, self.projector_range[scale], self.facing


def with_baseline(rig: Rig, baseline_m: float) -> Rig:
    """The same rig with its projector that far to the same side of the camera, aimed at the same point."""
    away = np.subtract(rig.projector.position_m, rig.camera.position_m) * (baseline_m / rig.baseline_m)
    x, y, z = (float(number) for number in rig.camera.position_m + away)
    return replace(rig, projector=replace(rig.projector, position_m=(x, y, z)))


def exact_view(
    rig: Rig,
    renderer: EmbreeRenderer,
    body: Body,
    ref: BodyRef,
    view: View,
    *,
    parts: Partition | None = None,
    source: str = "open",
    scales: Sequence[int] = (1, 2),
) -> ExactView:
    """One view of a body, with projector images at `scales`; without parts, all of it is one."""
    mesh = body.mesh
    if parts is None:
        nowhere, labels = np.full(len(mesh.vertices), np.inf), np.zeros(len(mesh.vertices), np.uint8)
        parts = Partition(labels, nowhere, find_borders(mesh, labels, nowhere))
    sample = Sampler(renderer, rig, mesh, parts, source, ref).take(view)
    camera, projector = rig.placed(mesh.centre, view)
    seen = renderer.render(camera)
    rows, columns = np.nonzero(seen.face >= 0)
    points = camera.points(seen.range, rows, columns)
    pixels, away = projector.project(points)
    inside = (away > 0) & (pixels >= 0).all(axis=1) & (pixels < (rig.projector.columns, rig.projector.rows)).all(axis=1)
    normals, ways = mesh.normals[seen.face[rows, columns]], projector.position - points
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(ways, axis=1)
    facing = sample.faces_projector[rows, columns]
    slanted = np.einsum("ij,ij->i", normals, ways) < math.cos(math.radians(GRAZING_DEG)) * lengths
    lit = lit_by_rays(renderer, points, projector.position) & inside
    contact = facing & ~lit & inside & lit_by_rays(renderer, points, projector.position, CONTACT_M)

    def image(values: Mask) -> Mask:
        whole = np.zeros(seen.face.shape, np.bool_)
        whole[rows, columns] = values
        return whole

    images, by_thin = {}, np.zeros(len(points), np.bool_)
    for scale in scales:
        finer = replace(projector, camera=with_projector_scale(rig, scale).projector)
        surface = renderer.render(finer)
        images[scale] = steps(surface.range, rig.range_step_m, sample.key)
        if scale == max(scales):
            thin_faces: Mask = np.isin(parts.labels, _THIN)[mesh.faces[:, 0]]
            by_thin = facing & inside & ~lit & _blocked_by(thin_faces, surface.face, finer, points)
    shadow, thin = image(by_thin), np.isin(sample.labels, _THIN) & image(inside)
    edges = grown(shadow, _BESIDE) & grown(image(lit), _BESIDE) & image(inside & facing)
    grazing = slanted & facing & inside
    return ExactView(ref, view, sample, images, image(inside), image(lit), image(grazing), image(contact), thin, edges)


def _blocked_by(
    chosen: Mask, faces: NDArray[np.int32], projector: PlacedCamera, points: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """True where the projector sees one of the chosen triangles at the pixel of a point [N, 3]: bool [N]."""
    pixels, _ = projector.project(points)
    column, row = np.floor(pixels).astype(np.intp).T
    within = (row >= 0) & (row < faces.shape[0]) & (column >= 0) & (column < faces.shape[1])
    seen = np.where(within, faces[np.where(within, row, 0), np.where(within, column, 0)], -1)
    blocked: NDArray[np.bool_] = (seen >= 0) & chosen[seen]
    return blocked


def bodies_of(source: str, poses: Sequence[str]) -> list[BodyRef]:
    """The first body of a source in each of the postures."""
    by_pose: dict[str, BodyRef] = {}
    for body in open_source(source).bodies():
        by_pose.setdefault(body.pose, body)
    return [by_pose[pose] for pose in poses]


def postures() -> list[BodyRef]:
    """The ten bodies of the ordinary views."""
    return bodies_of("open", POSES)


def exact_views(
    rig: Rig,
    bodies: list[BodyRef],
    count: int,
    *,
    source: str = "open",
    scales: Sequence[int] = (1,),
    labelled: bool = False,
) -> Iterator[ExactView]:
    """`count` views of `bodies` of a source, all round and at three distances; labelled: whether parts are wanted."""
    made = open_source(source)
    grid = list(ViewGrid(span_deg=360, azimuths=18))
    for index, body in enumerate(bodies[:count]):
        built = made.build(body)
        renderer = EmbreeRenderer(built.mesh)
        parts = built.partition() if labelled else None
        for turn in range(index, count, len(bodies)):
            view = mixed(grid, turn)
            yield exact_view(rig, renderer, built, body, view, parts=parts, source=source, scales=scales)
        renderer.close()


def grown(mask: Mask, by: int = 1) -> Mask:
    """A mask [H, W] and all pixels not further than `by` rows and columns from it."""
    whole: Mask = binary_dilation(mask, np.ones((2 * by + 1, 2 * by + 1)))
    return whole
