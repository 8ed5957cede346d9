from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benches.data.occlusion import compiled_default
from benches.data.occlusion.scaled_rig import with_projector_scale
from benches.data.occlusion.views import exact_view, exact_views, postures
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from shadow_reference import lit_by_pixel
from shapes import ball, figure

from bodyseg_data.artifacts import ShadowTest, shadow_tests
from bodyseg_data.artifacts.phase_shift import PhaseShift
from bodyseg_data.artifacts.scratch import BLOCK, scratch_for
from bodyseg_data.artifacts.shadow_loops import bound_pieces, find_extremes, shadow_of, take_pieces
from bodyseg_data.bodies import Body, BodyRef, open_source
from bodyseg_data.core import BadSample
from bodyseg_data.meshes import Mesh
from bodyseg_data.rendering.embree import EmbreeRenderer
from bodyseg_data.rigs import Camera, Rig, load_rig
from bodyseg_data.samples import View, steps

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Scene:
    """A plane `normal . p = distance` and balls before it, in the rig's frame; ranges and shadows in closed form.

    With `plate_m`, the plane is only a round plate of that radius about (0, 0, 2.5), where camera and projector aim.
    """

    def __init__(
        self,
        normal: tuple[float, float, float],
        distance_m: float,
        *balls: tuple[Floats, float],
        plate_m: float = np.inf,
    ) -> None:
        self.normal, self.distance_m, self.balls = np.asarray(normal, np.float64), distance_m, balls
        self.plate_m = plate_m

    def range(self, camera: Camera) -> Floats:
        """Range [H, W] of what `camera` sees, metres, 0 where that is nothing."""
        rays = camera.pixel_rays() @ camera.axes
        origin = np.asarray(camera.position_m)
        nearest = np.full(rays.shape[:2], np.inf)
        for hit in (self._plane(origin, rays), *(self._ball(origin, rays, *each) for each in self.balls)):
            nearest = np.minimum(nearest, np.where(hit > 1e-9, hit, np.inf))
        return np.where(np.isfinite(nearest), nearest, 0.0)

    def exact(self, rig: Rig) -> tuple[Mask, Mask, Mask]:
        """Lit, facing and inside the projector's frame, bool [H, W] each, at the points that the camera sees."""
        ranges = self.range(rig.camera)
        points = (rig.camera.pixel_rays() * ranges[..., None]) @ rig.camera.axes + rig.camera.position_m
        source = np.asarray(rig.projector.position_m)
        normals = np.broadcast_to(-self.normal * np.sign(self.distance_m), points.shape).copy()
        for centre, radius in self.balls:
            on_ball = np.abs(np.linalg.norm(points - centre, axis=-1) - radius) < 1e-6
            normals[on_ball] = (points - centre)[on_ball]
        facing = np.einsum("...i,...i", normals, source - points) > 0
        blocked = np.zeros(ranges.shape, np.bool_)
        for centre, radius in self.balls:
            hit = self._ball(source, points - source, centre, radius)
            blocked |= (hit > 0) & (hit < 1 - 1e-6)
        local = (points - source) @ rig.projector.axes.T
        image = local[..., :2] / local[..., 2:] * rig.projector.focal_px + rig.projector.centre_px
        inside = (local[..., 2] > 0) & (image >= 0).all(-1)
        inside &= (image < (rig.projector.columns, rig.projector.rows)).all(-1)
        seen = ranges > 0
        return facing & ~blocked & inside & seen, facing & seen, inside & seen

    def _plane(self, origin: Floats, rays: Floats) -> Floats:
        across = rays @ self.normal
        hit = (self.distance_m - self.normal @ origin) / np.where(across == 0, 1e-12, across)
        points = origin + rays * hit[..., None]
        return np.where(np.linalg.norm(points - (0.0, 0.0, 2.5), axis=-1) <= self.plate_m, hit, np.inf)

    @staticmethod
    def _ball(origin: Floats, rays: Floats, centre: Floats, radius: float) -> Floats:
        a, b = np.einsum("...i,...i", rays, rays), rays @ (origin - centre)
        inner = b * b - a * (((origin - centre) ** 2).sum() - radius**2)
        return np.where(inner > 0, (-b - np.sqrt(np.maximum(inner, 0))) / a, -1.0)


def small_rig(scale: int = 1, baseline_m: float = 0.75) -> Rig:
    """A landscape rig with few pixels, so that tests are quick."""
    camera = Camera(90, 120, 130.0, (60.0, 45.0), (0.0, 0.0, 0.0), (0.0, 0.0, 2.5))
    projector = replace(camera, position_m=(-baseline_m, 0.0, 0.0))
    return with_projector_scale(Rig("small", 2.5, camera, projector), scale)


def masks(scene: Scene, rig: Rig) -> tuple[Mask, Mask, Mask]:
    """The test's answer, the exact one, and where both can be asked."""
    exact, facing, inside = scene.exact(rig)
    images = (steps(scene.range(device), rig.range_step_m, "scene") for device in (rig.camera, rig.projector))
    return ShadowTest(rig).lit(*images, facing), exact, inside


def random_images(rig: Rig, draws: np.random.Generator) -> tuple[NDArray[np.uint16], NDArray[np.uint16], Mask]:
    """Range images with holes, edges of all heights and smooth stretches, and any facing bit."""
    images = []
    for device in (rig.camera, rig.projector):
        rows, columns = np.mgrid[: device.rows, : device.columns]
        slope = draws.uniform(-60, 60, 2)
        surface = draws.uniform(15_000, 30_000) + slope[0] * rows + slope[1] * columns
        edges = draws.choice([0, 100, 300, 5_000, -5_000], surface.shape, p=[0.8, 0.05, 0.05, 0.05, 0.05])
        image = np.clip(surface + edges, 1, 65_535).astype(np.uint16)
        image[draws.random(surface.shape) < 0.1] = 0
        image[draws.random(surface.shape) < 0.01] = 65_535
        image[draws.random(surface.shape) < 0.01] = 1
        images.append(image)
    return images[0], images[1], draws.random(images[0].shape) < 0.8


STEPS_MM = 0.1, 2.0


def paper_rig(step_mm: float) -> Rig:
    return replace(load_rig(), range_step_mm=step_mm)


@pytest.mark.parametrize("step_mm", STEPS_MM)
def test_a_plane_that_faces_both_is_lit_wherever_the_projector_reaches(step_mm: float) -> None:
    lit, exact, inside = masks(Scene((0.0, 0.0, 1.0), 3.6), paper_rig(step_mm))
    assert inside.any() and not inside.all()
    np.testing.assert_array_equal(lit, inside)
    np.testing.assert_array_equal(lit, exact)


@pytest.mark.parametrize("step_mm", [0.1, 1.0])
@pytest.mark.parametrize("degrees", [75.0, 80.0, 84.0])
def test_a_plate_under_grazing_light_has_no_false_shadow_but_at_its_rim(degrees: float, step_mm: float) -> None:
    # Turned away from the projector, towards the camera: the angle is that between normal and light.
    turn = np.arctan2(-0.75, -2.5) - np.radians(degrees)
    normal = (float(np.sin(turn)), 0.0, float(np.cos(turn)))
    rim, inner = (Scene(normal, 2.5 * normal[2], plate_m=radius) for radius in (0.3, 0.28))
    lit, exact, inside = masks(rim, paper_rig(step_mm))
    assert exact.sum() > 5000 and inside[exact].all()
    surface = inner.range(load_rig().camera) > 0
    np.testing.assert_array_equal(lit[surface], exact[surface])
    assert (lit != exact).sum() < 0.02 * exact.sum()


@pytest.mark.parametrize("step_mm", STEPS_MM)
@pytest.mark.parametrize(("scale", "tolerance"), [(1, 0.03), (2, 0.02)])
def test_a_ball_throws_its_shadow_on_a_plane(scale: int, tolerance: float, step_mm: float) -> None:
    scene = Scene((0.0, 0.0, 1.0), 2.8, (np.array([0.0, 0.1, 2.3]), 0.15))
    lit, exact, inside = masks(scene, with_projector_scale(paper_rig(step_mm), scale))
    on_plane = np.abs(scene.range(load_rig().camera) - 2.8) < 1e-6
    shadow, exact_shadow = (~mask & inside & on_plane for mask in (lit, exact))
    assert exact_shadow.sum() > 1000
    assert shadow.sum() == pytest.approx(exact_shadow.sum(), rel=tolerance)
    assert (shadow ^ exact_shadow).sum() < tolerance * exact_shadow.sum()


@pytest.mark.parametrize("step_mm", STEPS_MM)
def test_balls_that_touch_the_plane_and_thin_ones_keep_their_shadows(step_mm: float) -> None:
    touching, thin = (np.array([-0.1, -0.2, 2.7]), 0.1), [(np.array([0.05 * i, 0.3, 2.3]), 0.008) for i in range(-3, 4)]
    lit, exact, inside = masks(Scene((0.0, 0.0, 1.0), 2.8, touching, *thin), paper_rig(step_mm))
    assert (lit != exact)[inside].mean() < 0.002
    dark = ~exact & inside
    assert (~lit & dark).sum() > 0.8 * dark.sum()


def test_nothing_is_lit_outside_the_projectors_frame_or_behind_it() -> None:
    rig = small_rig()
    away = replace(rig, projector=replace(rig.projector, aims_at_m=(5.0, 0.0, 0.01)))
    behind = replace(rig, projector=replace(rig.projector, aims_at_m=(-0.75, 0.0, -2.5)))
    level = replace(rig, projector=replace(rig.projector, position_m=(0.0, 0.0, 2.5), aims_at_m=(0.0, 0.0, 5.0)))
    wall = np.full((90, 120), 25_000, np.uint16)
    for other in (away, behind, level):
        assert not ShadowTest(other).lit(wall, wall, wall > 0).any()


def test_background_is_never_lit_and_empty_texels_throw_no_shadow() -> None:
    rig = small_rig(baseline_m=0.2)
    image, everywhere = np.zeros((90, 120), np.uint16), np.ones((90, 120), np.bool_)
    assert not ShadowTest(rig).lit(image, image, everywhere).any()
    image[40:50, 55:65] = 25_000
    lit = ShadowTest(rig).lit(image, np.zeros_like(image), everywhere)
    np.testing.assert_array_equal(lit, image > 0)
    farthest = np.where(image > 0, 65_535, 0).astype(np.uint16)
    np.testing.assert_array_equal(ShadowTest(rig).lit(farthest, np.zeros_like(image), everywhere), image > 0)


def test_a_surface_that_faces_away_is_dark() -> None:
    wall, rig = np.full((90, 120), 25_000, np.uint16), small_rig(baseline_m=0.0)
    facing = np.zeros((90, 120), np.bool_)
    facing[:, ::2] = True
    np.testing.assert_array_equal(ShadowTest(rig).lit(wall, wall, facing), facing)


def test_without_a_baseline_everything_is_lit() -> None:
    rig = small_rig(baseline_m=0.0)
    image, _, _ = random_images(rig, np.random.default_rng(3))
    lit = ShadowTest(rig).lit(image, image, np.ones(image.shape, np.bool_))
    np.testing.assert_array_equal(lit, image > 0)


@pytest.mark.parametrize(
    ("occluder", "expected"),
    [(25_000, True), (24_950, True), (24_940, True), (24_939, False), (24_900, False), (0, True)],
)
def test_images_of_one_pixel(occluder: int, expected: bool) -> None:
    device = Camera(1, 1, 100.0, (0.5, 0.5), (0.0, 0.0, 0.0), (0.0, 0.0, 2.5))
    one = np.full((1, 1), 25_000, np.uint16)
    lit = assert_forms_agree(Rig("one", 2.5, device, device), (one, np.full((1, 1), occluder, np.uint16), one > 0))
    assert lit.tolist() == [[expected]]


@pytest.mark.parametrize(("shift", "expected"), [(-0.5, [True, True]), (0.0, [True, True]), (0.5, [True, False])])
def test_the_frame_holds_its_first_edge_and_not_its_last(shift: float, expected: list[bool]) -> None:
    device = Camera(1, 2, 64.0, (1.0, 0.5), (0.0, 0.0, 0.0), (0.0, 0.0, 2.5))
    for turned in (False, True):
        if turned:
            device = replace(device, rows=2, columns=1, centre_px=(0.5, 1.0))
        moved = replace(device, centre_px=tuple(c + shift * (c == 1) for c in device.centre_px))
        wall = np.full((device.rows, device.columns), 25_000, np.uint16)
        rig = Rig("edge", 2.5, device, moved)
        x = ShadowTest(rig).project(wall, np.arange(2))[1 + turned]
        assert set(x.tolist()) <= {-0.5, 0.0, 0.5, 1.0}, "exactly at the edge"
        assert assert_forms_agree(rig, (wall, wall, wall > 0)).ravel().tolist() == expected


def test_half_the_weight_decides_at_an_edge() -> None:
    device = Camera(1, 2, 100.0, (1.0, 0.5), (0.0, 0.0, 0.0), (0.0, 0.0, 2.5))
    image = np.full((1, 2), 25_000, np.uint16)
    projector_range = np.array([[20_000, 25_000]], np.uint16)
    for shift, expected in ((0.4, [False, True]), (0.6, [True, True]), (-0.4, [False, True]), (-0.6, [False, False])):
        moved = replace(device, centre_px=(1.0 + shift, 0.5))
        lit = ShadowTest(Rig("two", 2.5, device, moved)).lit(image, projector_range, image > 0)
        inside = [0 <= column + 0.5 + shift < 2 for column in range(2)]
        assert lit[0].tolist() == [a and b for a, b in zip(expected, inside, strict=True)], shift


@pytest.mark.parametrize("which", [0, 1, 2])
@pytest.mark.parametrize("how", ["shape", "kind", "list"])
def test_arrays_that_do_not_fit_the_rig_are_refused(which: int, how: str) -> None:
    wall = np.full((90, 120), 25_000, np.uint16)
    arrays: list[object] = [wall, wall, wall > 0]
    arrays[which] = {"shape": arrays[which][:-1], "kind": wall.astype(np.int32), "list": wall.tolist()}[how]  # type: ignore[index]
    with pytest.raises(BadSample, match=r"^the (camera range|projector range|facing bit) must be .*, found [^\n]*$"):
        ShadowTest(small_rig()).lit(*arrays)  # type: ignore[arg-type]
    with pytest.raises(BadSample, match=r"^the (camera range|projector range|facing bit) must be .*, found [^\n]*$"):
        compiled_default.lit(ShadowTest(small_rig()), *arrays)  # type: ignore[arg-type]


def test_a_shadow_test_travels_as_its_rig() -> None:
    test = ShadowTest(small_rig())
    data = pickle.dumps(test)
    assert len(data) < 2000
    again = pickle.loads(data)
    np.testing.assert_array_equal(again.slopes, test.slopes)
    np.testing.assert_array_equal(again.offsets, test.offsets)


def assert_forms_agree(rig: Rig, images: tuple[NDArray[np.uint16], NDArray[np.uint16], Mask]) -> Mask:
    test = ShadowTest(rig)
    lit = test.lit(*images)
    np.testing.assert_array_equal(
        lit, lit_by_pixel(*images, test.slopes, test.offsets, (test.gap_steps, test.edge_steps))
    )
    np.testing.assert_array_equal(lit, compiled_default.lit(test, *images))
    return lit


@given(
    seed=st.integers(0, 2**32 - 1),
    rows=st.integers(1, 14),
    columns=st.integers(1, 14),
    scale=st.integers(1, 3),
    baseline_m=st.floats(-1.0, 1.0),
    aim_m=st.floats(-1.0, 1.0),
)
def test_fast_and_plain_form_give_the_same_bits(
    seed: int, rows: int, columns: int, scale: int, baseline_m: float, aim_m: float
) -> None:
    camera = Camera(rows, columns, 30.0, (columns / 2, rows / 2), (0.0, 0.0, 0.0), (0.0, 0.0, 2.5))
    projector = replace(camera, focal_px=28.0, position_m=(baseline_m, 0.03, 0.1), aims_at_m=(aim_m, 0.0, 2.5))
    rig = with_projector_scale(Rig("random", 2.5, camera, projector), scale)
    assert_forms_agree(rig, random_images(rig, np.random.default_rng(seed)))


def sparse_images(rig: Rig, draws: np.random.Generator) -> tuple[NDArray[np.uint16], NDArray[np.uint16], Mask]:
    """Range images as a shard holds them: bodies in front of nothing, and few texels that can shade them."""
    images = []
    for device, share in ((rig.camera, 0.7), (rig.projector, 0.03)):
        rows, columns = np.mgrid[: device.rows, : device.columns]
        slope = draws.uniform(-40, 40, 2)
        surface = np.clip(draws.uniform(500, 60_000) + slope[0] * rows + slope[1] * columns, 1, 65_535)
        image = surface.astype(np.uint16)
        radius = np.sqrt(share * image.size / np.pi / 2)
        apart = [
            np.hypot(rows - draws.uniform(0, device.rows), columns - draws.uniform(0, device.columns)) for _ in "12"
        ]
        image[np.minimum(*apart) > radius] = 0
        images.append(image)
    return images[0], images[1], draws.random(images[0].shape) < 0.95


@given(
    seed=st.integers(0, 2**32 - 1),
    rows=st.integers(1, 60),
    columns=st.integers(1, 90),
    scale=st.integers(1, 3),
    focal_px=st.floats(5.0, 2_000.0),
    position=st.tuples(st.floats(-3.0, 3.0), st.floats(-2.0, 2.0), st.floats(-2.0, 4.0)),
    aim=st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-1.0, 4.0)),
    thresholds=st.tuples(st.integers(0, 500), st.integers(0, 500)),
)
def test_pixels_that_are_skipped_are_lit_for_any_rig(
    seed: int,
    rows: int,
    columns: int,
    scale: int,
    focal_px: float,
    position: tuple[float, float, float],
    aim: tuple[float, float, float],
    thresholds: tuple[int, int],
) -> None:
    """Sideways, from above, level with the body, behind it, or turned away; chunks and blocks end anywhere."""
    assume(np.hypot(aim[0] - position[0], aim[2] - position[2]) > 0.01)
    camera = Camera(rows, columns, 60.0, (columns / 2, rows / 2), (0.0, 0.0, 0.0), (0.0, 0.0, 2.5))
    projector = replace(camera, focal_px=focal_px, position_m=position, aims_at_m=aim)
    rig = with_projector_scale(Rig("random", 2.5, camera, projector), scale)
    test = ShadowTest(rig)
    test.gap_steps, test.edge_steps = np.float32(thresholds[0]), np.float32(thresholds[1])
    images = sparse_images(rig, np.random.default_rng(seed))
    np.testing.assert_array_equal(test.lit(*images), compiled_default.lit(test, *images))


@pytest.mark.parametrize("position", [(-0.75, 0.0, 0.0), (0.0, -0.8, 0.1), (0.5, 0.5, -1.0), (0.0, 0.0, 2.6)])
def test_bodies_of_many_chunks_get_the_same_bits(position: tuple[float, float, float]) -> None:
    rig = load_rig()
    rig = replace(rig, projector=replace(rig.projector, position_m=position, aims_at_m=(0.0, 0.1, 3.0)))
    test = ShadowTest(rig)
    for seed in range(3):
        images = sparse_images(rig, np.random.default_rng(seed))
        images[0][images[0] > 0] = images[0][images[0] > 0] // 4 + 22_000
        images[1][images[1] > 0] = images[1][images[1] > 0] // 4 + 18_000
        lit = test.lit(*images)
        np.testing.assert_array_equal(lit, compiled_default.lit(test, *images))


@pytest.mark.parametrize(("rows", "columns"), [(90, 1500), (700, 1), (90, 129), (3, 4000)])
def test_projectors_of_any_shape_give_the_same_bits(rows: int, columns: int) -> None:
    """Tiles of wide ones are larger, and the last ones of a row and of the image are cut off."""
    rig = small_rig(baseline_m=0.3)
    shape = replace(rig.projector, rows=rows, columns=columns, centre_px=(columns / 2, rows / 2))
    test = ShadowTest(replace(rig, projector=shape))
    draws = np.random.default_rng(rows)
    camera_range = np.full((90, 120), 25_000, np.uint16)
    # Most texels are behind what is seen, and a few before it.
    occluder = draws.choice(np.array([0, 24_999, 20_000], np.uint16), (rows, columns), p=[0.97, 0.028, 0.002])
    lit = test.lit(camera_range, occluder, camera_range > 0)
    np.testing.assert_array_equal(lit, compiled_default.lit(test, camera_range, occluder, camera_range > 0))
    assert 0 < lit.mean() < 0.999


@pytest.mark.parametrize("seed", range(5))
def test_boxes_hold_every_texel_that_their_points_read(seed: int) -> None:
    """Of rough surfaces, by the projection of the NumPy form; a box that is given up has a last row of -1."""
    draws = np.random.default_rng(seed)
    rig = small_rig(baseline_m=float(draws.uniform(-0.5, 0.5)))
    position = (rig.projector.position_m[0], *draws.uniform(-0.2, 0.2, 2))
    rig = replace(rig, projector=replace(rig.projector, position_m=position))
    test, size = ShadowTest(rig), rig.camera.rows * rig.camera.columns
    image = draws.integers(24_000, 26_000, (rig.camera.rows, rig.camera.columns)).astype(np.uint16)
    image[:, :30], image[:, 90:], image[:20], image[70:] = 0, 0, 0, 0
    edges = np.flatnonzero(np.diff(image.ravel() > 0, prepend=False, append=False)).astype(np.int32)
    scratch, runs, given_up, pieces_seen = scratch_for(size, 90, 120), len(edges) // 2, 0, 0
    shadow = shadow_of(test, image, np.zeros_like(image), image > 0)
    run, taken, row = np.int64(0), np.int64(0), np.int64(0)
    while run < runs:
        run, taken, row, found, _ = take_pieces(edges, runs, run, taken, row, 120, BLOCK, scratch.pieces)
        find_extremes(shadow.camera_range, scratch.pieces, found, scratch.extremes)
        bound_pieces(shadow, scratch.pieces, found, scratch.extremes, scratch.boxes)
        for piece in range(found):
            first, length, piece_row, _, _ = scratch.pieces[:, piece].tolist()
            left, right, top, bottom, limit = scratch.boxes[:, piece].tolist()
            assert piece_row == first // 120 == (first + length - 1) // 120
            pixels, x, y, away = test.project(image, np.arange(first, first + length))
            pieces_seen += 1
            if bottom == -1:
                given_up += 1
                continue
            assert len(pixels) == length, "all of them in the frame"
            assert left <= max(np.floor(x).min(), 0) and right >= min(np.floor(x).max() + 1, 119)
            assert top <= max(np.floor(y).min(), 0) and bottom >= min(np.floor(y).max() + 1, 89)
            assert away.max() - min(test.gap_steps, test.edge_steps) < limit < away.max() + 1000
            assert right - left < 80 and bottom - top < 30, "no wider than its points need"
    assert pieces_seen > 100 and given_up < pieces_seen / 2


def test_texels_in_any_order_and_empty_ones_among_them_give_the_same_bits() -> None:
    """Where they come from a sample, compiled loops need not trust more than that none is missing."""
    rig = small_rig(baseline_m=0.3)
    test = ShadowTest(rig)
    draws = np.random.default_rng(5)
    images = sparse_images(rig, draws)
    images[0][images[0] > 0], images[1][images[1] > 0] = 25_000, 20_000
    texels = np.concatenate([np.flatnonzero(images[1]), draws.integers(0, images[1].size, 50)]).astype(np.int32)
    draws.shuffle(texels)
    shadow = shadow_of(test, *images, texels)
    answer = np.empty(images[0].shape, np.bool_)
    compiled_default.lit_image(shadow, scratch_for(images[0].size, *images[1].shape), answer.ravel())
    lit = test.lit(*images)
    np.testing.assert_array_equal(answer, lit)
    assert (images[2] & (images[0] > 0) & ~lit).sum() > 0


def test_random_images_reach_both_answers_of_both_rules() -> None:
    rig = small_rig(baseline_m=0.1)
    lit = assert_forms_agree(rig, random_images(rig, np.random.default_rng(0)))
    assert 0.2 < lit.mean() < 0.8


def standing(mesh: Mesh) -> tuple[Body, BodyRef]:
    return Body(mesh, np.zeros(0, np.int64)), BodyRef("A", "A", mesh.name, "standing", "train")


def test_fast_plain_and_compiled_form_agree_on_a_rendered_figure() -> None:
    mesh, rig = figure(), load_rig()
    view = exact_view(rig, EmbreeRenderer(mesh), *standing(mesh), View(255, 20))
    assert_forms_agree(rig, view.images(1))
    test = ShadowTest(with_projector_scale(rig, 2))
    np.testing.assert_array_equal(compiled_default.lit(test, *view.images(2)), test.lit(*view.images(2)))


def test_the_default_is_within_one_percent_of_exact_shadow_rays() -> None:
    rig, wrong, pixels = load_rig(), 0, 0
    test = ShadowTest(rig)
    for mesh, azimuths in ((figure(), (0, 130, 200)), (ball(), (0,))):
        renderer = EmbreeRenderer(mesh)
        for azimuth in azimuths:
            view = exact_view(rig, renderer, *standing(mesh), View(255, azimuth))
            wrong += int(((test.lit(*view.images(1)) != view.lit) & view.inside).sum())
            pixels += int(view.inside.sum())
    assert pixels > 60_000
    assert wrong / pixels < 0.005  # required: 0.01


@pytest.mark.parametrize(("view", "roll"), [(View(255, 40, -35, 25, 10), 0.0), (View(255, 200, 20, -70), 40.0)])
def test_views_from_above_and_turned_are_within_one_percent_of_exact_shadow_rays(view: View, roll: float) -> None:
    plain, mesh = load_rig(), figure()
    rig = replace(plain, projector=replace(plain.projector, roll_deg=roll))
    seen = exact_view(rig, EmbreeRenderer(mesh), *standing(mesh), view)
    assert_forms_agree(rig, seen.images(1))
    wrong = (ShadowTest(rig).lit(*seen.images(1)) != seen.lit) & seen.inside
    dark = ~seen.lit & seen.inside & (seen.images(1)[0] > 0)
    assert seen.inside.sum() > 10_000 and dark.sum() > 200
    assert wrong.sum() / seen.inside.sum() < 0.005  # required: 0.01


def test_views_of_real_postures_are_within_one_percent_of_exact_shadow_rays() -> None:
    rig = load_rig()
    test = ShadowTest(rig)
    wrong, pixels, shares = 0, 0, []
    for view in exact_views(rig, postures()[1::2], 5):  # limbs before the trunk, beside and far from it
        differing = (test.lit(*view.images(1)) != view.lit) & view.inside
        wrong, pixels = wrong + int(differing.sum()), pixels + int(view.inside.sum())
        shares.append(float(differing.sum() / view.inside.sum()))
    assert len(shares) == 5
    assert pixels > 120_000
    assert wrong / pixels < 0.005  # required: 0.01
    assert max(shares) < 0.01


def test_real_clothed_frames_are_within_one_percent_of_exact_shadow_rays(mit_folder: Path) -> None:
    rig, source = load_rig(), open_source("mit", mit_folder)
    test = ShadowTest(rig)
    wrong = pixels = 0
    for index, body in enumerate(source.bodies()[::28]):
        built = source.build(body)
        renderer = EmbreeRenderer(built.mesh)
        for azimuth in (0, 180):
            view = exact_view(rig, renderer, built, body, View(255, azimuth + 40 * index))
            wrong += int(((test.lit(*view.images(1)) != view.lit) & view.inside).sum())
            pixels += int(view.inside.sum())
    assert pixels > 80_000
    assert wrong / pixels < 0.006  # required: 0.01


def test_what_belongs_to_a_rig_is_made_once_for_each_of_a_sets_rigs() -> None:
    rigs, artifact = [with_projector_scale(load_rig(), 1 + number / 100) for number in range(20)], PhaseShift()
    first = [(shadow_tests(rig), artifact.optics(rig, 0.5)[1]) for rig in rigs]
    again = [(shadow_tests(rig), artifact.optics(rig, 0.5)[1]) for rig in rigs]
    assert all(before[0] is after[0] and before[1] is after[1] for before, after in zip(first, again, strict=True))


def test_the_shadow_test_imports_no_renderer_and_no_compiler() -> None:
    code = (
        "import sys; from bodyseg_data.artifacts.occlusion import ShadowTest; "
        "heavy = {'embreex', 'pyrender', 'numba', 'trimesh', 'scipy', 'matplotlib', 'anny'} & set(sys.modules); "
        "sys.exit(','.join(heavy) or None)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
