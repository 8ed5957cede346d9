"""Projector shadow: which of the camera's pixels the projector lights, from the stored range images alone.

A shadow map (Williams, "Casting curved shadows on curved surfaces", SIGGRAPH 1978): the projector's range image says
how far its light gets in every direction. A camera pixel is lit if its surface faces the projector, lies inside the
projector's frame, and is not behind what that image shows there. The last question is put to the four texels around
the point. Where they show one surface, their bilinear interpolation is its range, and the point may be at most a
surface gap behind it. Where they straddle an edge, interpolating ranges would invent a surface, so each texel votes
instead ("not more than an edge's difference in front of the point") with its bilinear weight, and half the weight
decides (percentage-closer filtering: Reeves, Salesin and Cook, SIGGRAPH 1987). With two projectors, shadow is where
neither lights. Both thresholds belong to the format of shards (`SHADOW_THRESHOLDS`).
docs/results/occlusion.md has the test beside its rivals.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.artifact import Artifact, RangeImage, Scene, check_image
from bodyseg_data.core import BadSample, Draws
from bodyseg_data.rigs import Rig
from bodyseg_data.samples import FARTHEST_STEPS, SHADOW_THRESHOLDS, Sample

Range = NDArray[np.uint16]
Floats = NDArray[np.float32]

# Everything below computes in float32, in steps of a stored range image, in one fixed order of operations, so that
# every form and every machine gives the same bits.
_ONE: Final = np.float32(1)
_HALF: Final = np.float32(0.5)


@dataclass(frozen=True)
class Occlusion(Artifact):
    """The projector's shadow: pixels are lost where no projector of the rig lights the surface (paper, section 3.1)."""

    name = "occlusion"
    kind = "occlusion"
    needs_projector = True

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        image.range[...] *= lit_pixels(scene.rig, scene.sample)


class ShadowTest:
    """The shadow test for a rig's first projector: built once, applied to every sample.

    A camera pixel with ray r = (x, y, 1) and range z sees the point z r, which is z R r + t for the projector. So its
    projector coordinates are quotients (z a + b) / (z c + d), where a and c depend on the pixel only, b and d on
    nothing; the denominator is the point's range in the projector's frame.

    of_columns: float64 [3, W] and of_rows: float64 [3, H], whose sums are a for the texel's x, a for its y, and c of
    each pixel, in float32. offsets: float32 [3], both b and d, in steps. gap_steps, edge_steps: float32, the thresholds
    of the format of shards in steps.
    """

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        rotation, shift_m = rig.camera_to_projector()
        focal, (centre_x, centre_y) = rig.projector.focal_px, rig.projector.centre_px
        # Texel centres lie at half-integers of image coordinates; half a texel off, at integers.
        image_plane = np.array([[focal, 0, centre_x - 0.5], [0, focal, centre_y - 0.5], [0, 0, 1]])
        across, down, forward = (image_plane @ rotation).T[:, :, None]
        x, y = rig.camera.slopes
        self.of_columns: NDArray[np.float64] = across * x
        self.of_rows: NDArray[np.float64] = down * y + forward
        self.offsets: Floats = (image_plane @ shift_m / rig.range_step_m).astype(np.float32)
        self.gap_steps, self.edge_steps = SHADOW_THRESHOLDS.in_steps(rig.range_step_m)

    def __reduce__(self) -> tuple[Any, ...]:
        return ShadowTest, (self.rig,)  # a rig is small, the arrays are not

    @cached_property
    def slopes(self) -> Floats:
        """The slopes a for the texel's x, a for its y, and c of all pixels, float32 [3, H * W]."""
        return (self.of_columns[:, None] + self.of_rows[:, :, None]).astype(np.float32).reshape(3, -1)

    @cached_property
    def projection(self) -> Floats:
        """The input of bounds of whole blocks of pixels, float32 [3, 5], read-only; rows: x, y, range.

        Columns: the offset, the plane of the slope, and the margin. Divided by the range, the margins of x and y cover
        all that rounding can move a point's x and y and their bounds apart; a range must be over its own margin.
        """
        camera, projector = self.rig.camera, self.rig.projector
        columns, rows = self.of_columns, self.of_rows
        a_column = (columns[:, -1] - columns[:, 0]) / max(camera.columns - 1, 1)
        a_row = (rows[:, -1] - rows[:, 0]) / max(camera.rows - 1, 1)
        planes = np.column_stack([a_column, a_row, columns[:, 0] + rows[:, 0]])
        largest = np.abs(planes) @ (camera.columns, camera.rows, 1)
        # Every operation is off by at most 2**-24 of its greatest term; there are fewer than sixteen to each bound.
        off = (float(FARTHEST_STEPS) * largest + np.abs(self.offsets)) * 2.0**-20
        margins = 2 * (off[0] + projector.columns * off[2]), 2 * (off[1] + projector.rows * off[2]), 4 * off[2]
        projection = np.column_stack([self.offsets, planes, margins]).astype(np.float32)
        projection.flags.writeable = False
        return projection

    def lit(self, camera_range: Range, projector_range: Range, faces_projector: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Mark the camera pixels that see a surface which the projector lights, bool [H, W]; False on background.

        camera_range: uint16 [H, W] and projector_range: uint16 [Hp, Wp], in the rig's steps along the optical axis of
        each device, 0 where there is nothing. faces_projector: bool [H, W], whether the triangle seen turns its
        outside to the projector. Raises BadSample for arrays of another kind or shape than the rig's.
        """
        self.check(camera_range, projector_range, faces_projector)
        answer = np.zeros(camera_range.shape, np.bool_)
        pixels, x, y, away = self.project(camera_range, np.flatnonzero(faces_projector & (camera_range > 0)))
        answer.ravel()[pixels] = self.reached(projector_range, x, y, away)
        return answer

    def reached(self, projector_range: Range, x: Floats, y: Floats, away: Floats) -> NDArray[np.bool_]:
        """Decide whether light reaches points inside the projector's frame, bool [N].

        projector_range: uint16 [Hp, Wp], in the rig's steps. x, y, away: float32 [N], as `project` gives them.
        """
        texels, along, below = four_texels(projector_range, x, y)
        away = np.minimum(away - _ONE, FARTHEST_STEPS)  # less one step, as the texels are
        nearest = np.minimum(np.minimum(texels[0], texels[1]), np.minimum(texels[2], texels[3]))
        farthest = np.maximum(np.maximum(texels[0], texels[1]), np.maximum(texels[2], texels[3]))

        # One surface: it is where the interpolated range says.
        a, b, c, d = (texel.astype(np.float32) for texel in texels)
        upper, lower = a + along * (b - a), c + along * (d - c)
        lit: NDArray[np.bool_] = away - (upper + below * (lower - upper)) <= self.gap_steps

        # An edge: votes.
        torn = np.flatnonzero(farthest - nearest >= self.edge_steps)
        limit, right, low = (away - self.edge_steps)[torn], along[torn], below[torn]
        left, high = _ONE - right, _ONE - low
        votes = [
            weight * (texel[torn] >= limit)
            for weight, texel in zip((high * left, high * right, low * left, low * right), (a, b, c, d), strict=True)
        ]
        lit[torn] = votes[0] + votes[1] + votes[2] + votes[3] >= _HALF
        return lit

    def check(self, camera_range: Any, projector_range: Any, faces_projector: Any) -> None:
        """Raise BadSample for images of another kind or shape than the rig's."""
        camera, projector = self.rig.camera, self.rig.projector
        check_image("the camera range", camera_range, np.uint16, (camera.rows, camera.columns))
        check_image("the projector range", projector_range, np.uint16, (projector.rows, projector.columns))
        check_image("the facing bit", faces_projector, np.bool_, (camera.rows, camera.columns))

    def project(self, camera_range: Range, pixels: NDArray[np.intp]) -> tuple[NDArray[np.intp], Floats, Floats, Floats]:
        """Project foreground pixels, flat indices [N], into the projector's image.

        Returns the pixels that fall inside its frame, their texel coordinates x and y, float32, whole at texel centres,
        and their range in the projector's frame, float32, in steps.
        """
        z = camera_range.ravel().take(pixels).astype(np.float32)
        across, down, forward = (slope.take(pixels) for slope in self.slopes)
        away = z * forward + self.offsets[2]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # level with the projector: not `inside`
            x = (z * across + self.offsets[0]) / away
            y = (z * down + self.offsets[1]) / away
        rows, columns = np.float32(self.rig.projector.rows), np.float32(self.rig.projector.columns)
        inside = (away > 0) & (x >= -_HALF) & (x < columns - _HALF) & (y >= -_HALF) & (y < rows - _HALF)
        if inside.all():
            return pixels, x, y, away
        return pixels[inside], x[inside], y[inside], away[inside]


@lru_cache(maxsize=64)
def shadow_tests(rig: Rig) -> tuple[ShadowTest, ...]:
    """The shadow tests of all projectors of a rig, each of a rig with that one alone, built once a process."""
    return tuple(map(ShadowTest, rig.by_projector()))


class ProjectorView(NamedTuple):
    """One projector's share of a sample. texels: as of `Sample`, in this image."""

    test: ShadowTest
    projector_range: Range
    facing: NDArray[np.bool_]
    texels: NDArray[np.int32] | None


def projector_views(rig: Rig, sample: Sample) -> list[ProjectorView]:
    """Divide a sample among the rig's projectors, without a copy; one or two entries.

    Raises BadSample for a sample without what two projectors see, or without any projector's range.
    """
    image, texels, tests = sample.occluder_range(), sample.texels, shadow_tests(rig)
    if rig.second_projector is None:
        return [ProjectorView(tests[0], image, sample.faces_projector, texels)]
    if sample.faces_second is None or image.shape != rig.projector_shape:
        mask = "without" if sample.faces_second is None else "with"
        raise BadSample(
            f"{sample.key}: a rig of two projectors needs a projector range {rig.projector_shape} and a second facing "
            f"bit, found {image.shape} {mask} that bit"
        )
    rows = rig.projector.rows
    first = second = None
    if texels is not None:
        start = rows * rig.projector.columns
        first, second = np.split(texels, [np.searchsorted(texels, start)])
        second = second - np.int32(start)
    return [
        ProjectorView(tests[0], image[:rows], sample.faces_projector, first),
        ProjectorView(tests[1], image[rows:], sample.faces_second, second),
    ]


def lit_pixels(rig: Rig, sample: Sample) -> NDArray[np.bool_]:
    """Mark the pixels of a sample that at least one of the rig's projectors lights, bool [H, W].

    Raises BadSample for images of another kind or shape than the rig's.
    """
    first, *others = projector_views(rig, sample)
    answer = first.test.lit(sample.range, first.projector_range, first.facing)
    for other in others:
        answer |= other.test.lit(sample.range, other.projector_range, other.facing)
    return answer


def four_texels(projector_range: Range, x: Floats, y: Floats) -> tuple[list[Range], Floats, Floats]:
    """The texels around points, [upper left, upper right, lower left, lower right], uint16 [N] each, *less one step*,
    and how far each point is from the left and from the upper ones, float32 [N], 0 to 1.
    """
    image = framed(projector_range)
    left, top = np.floor(x), np.floor(y)
    width = image.shape[1]
    start = ((top.astype(np.int32) + 1) * width + left.astype(np.int32) + 1).astype(np.intp)
    flat = image.ravel()
    # Shifting the image costs nothing; shifting the indices, a pass over all points.
    return [flat[shift:].take(start) for shift in (0, 1, width, width + 1)], x - left, y - top


def framed(projector_range: Range) -> Range:
    """A projector image less one step, uint16 [Hp + 2, Wp + 2], its border repeated: points in it have four texels.

    One step off, an empty texel wraps round from 0 to 65535, which is behind every point, as it should be.
    """
    rows, columns = projector_range.shape
    image = np.empty((rows + 2, columns + 2), np.uint16)
    np.subtract(projector_range, np.uint16(1), out=image[1:-1, 1:-1])
    image[0, 1:-1], image[-1, 1:-1] = image[1, 1:-1], image[-2, 1:-1]
    image[:, 0], image[:, -1] = image[:, 1], image[:, -2]
    return image
