"""A body from one camera to another and its labels back: against real views, pixel by pixel, and as properties."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from plain_loops import PlainViewLoops
from shapes import figure

from bodyseg_data.core import BadConfig
from bodyseg_data.rendering import RasterRenderer
from bodyseg_data.rigs import Camera, PlacedCamera, axes_at, load_rig
from bodyseg_model.segmentation import view_body
from bodyseg_model.segmentation import views as module
from bodyseg_model.segmentation.views import LARGEST_SIDE, STEP, USUAL_PEOPLE, BodyView, usual_views, view_frame

PAPER = load_rig()
NEAREST_M, FARTHEST_M = PAPER.range_step_m, 65535 * PAPER.range_step_m
Image = NDArray[np.float32]


def camera(rows: int, columns: int, focal: float, centre: tuple[float, float] | None = None) -> Camera:
    return Camera(rows, columns, focal, centre or (columns / 2, rows / 2), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


KINECT_1, KINECT_2 = camera(480, 640, 525.0), camera(424, 512, 365.0, (258.2, 207.7))
TELE = camera(1200, 800, 1500.0)


def seen(lens: Camera, distance_m: float, turn_deg: float = 0.0) -> Image:
    """A figure from an upright camera at some distance, that looks past its middle by `turn_deg` to the right."""
    mesh = figure()
    aimed, turned = axes_at(30), axes_at(30 - turn_deg)  # type: ignore[arg-type]  # any angle does
    placed = PlacedCamera(lens, turned, mesh.centre - distance_m * aimed[2])
    return RasterRenderer(mesh).render(placed).range


@lru_cache
def distance_to(median_m: float) -> float:
    """From where the figure's median range is `median_m` to the paper's camera."""
    distance = median_m
    for _ in range(4):
        image = seen(PAPER.camera, distance)
        distance += median_m - float(np.median(image[image > 0]))
    return distance


@lru_cache
def median_at(lens: Camera, median_m: float) -> Image:
    """The same, from where the figure's median range is `median_m`."""
    return seen(lens, distance_to(median_m))


def viewed(image: Image, lens: Camera, mirrored: bool = False) -> BodyView:
    return view_body(image, np.flatnonzero(image), lens, PAPER, mirrored)


def on_paper(view: BodyView) -> Image:
    """A view where it is in the paper's image."""
    whole = np.zeros((PAPER.camera.rows, PAPER.camera.columns), np.float32)
    top, left = view.corner
    rows, columns = np.nonzero(view.range_m)
    inside = (rows + top >= 0) & (rows + top < len(whole)) & (columns + left >= 0) & (columns + left < whole.shape[1])
    whole[rows[inside] + top, columns[inside] + left] = view.range_m[rows[inside], columns[inside]]
    return whole


def within_a_pixel(image: Image, other: Image, tolerance_m: float) -> float:
    """Share of the pixels of `image` that `other` has too, at the same place or beside it."""
    padded = np.pad(other, 1)
    shifted = [
        padded[1 + r : 1 + r + other.shape[0], 1 + c : 1 + c + other.shape[1]] for r in (-1, 0, 1) for c in (-1, 0, 1)
    ]
    near = np.any([(there > 0) & (np.abs(there - image) <= tolerance_m) for there in shifted], axis=0)
    return float(near[image > 0].mean())


@pytest.mark.parametrize("turn", [0, -24, 17])
@pytest.mark.parametrize("lens", [KINECT_1, KINECT_2, TELE], ids=["wider", "wider, off centre", "narrower"])
def test_another_focal_length_and_direction_give_what_the_known_camera_sees(lens: Camera, turn: int) -> None:
    if lens is TELE and turn:
        return  # it would not see the figure
    view = viewed(seen(lens, distance_to(2.5), turn), lens)
    turned_by = math.degrees(view.turn_rad)
    assert turned_by == pytest.approx(-turn, abs=3), "the figure's outline is not quite symmetric"
    truth = seen(PAPER.camera, distance_to(2.5), turn + turned_by)
    assert view.scale == pytest.approx(PAPER.camera.focal_px / lens.focal_px, rel=0.005)
    # Beside a pixel the range may differ by what a pixel of the coarser camera covers on a steep surface.
    there = on_paper(view)
    assert within_a_pixel(there, truth, 0.02) > 0.995
    assert within_a_pixel(truth, there, 0.02) > 0.995
    assert np.median(np.abs(truth - there)[(truth > 0) & (there > 0)]) < 4e-3


def test_another_distance_gives_a_body_of_the_known_size() -> None:
    truth = median_at(PAPER.camera, 2.5)
    for distance in (1.8, 4.0):
        view = viewed(median_at(KINECT_1, distance), KINECT_1)
        for axis in (0, 1):
            sizes = [int((image > 0).any(axis).sum()) for image in (truth, view.range_m)]
            # Perspective: what is 0.3 m nearer than the middle looks larger, by another share than from 2.5 m.
            assert sizes[1] == pytest.approx(sizes[0], rel=0.3 * abs(1 / distance - 1 / 2.5))
        assert np.median(view.range_m[view.range_m > 0]) == pytest.approx(2.5, abs=0.01)


def test_a_known_view_is_only_turned_to_its_middle() -> None:
    image = median_at(PAPER.camera, 2.5)
    view = viewed(image, PAPER.camera)
    assert view.scale == pytest.approx(1, rel=1e-3) and view.median_range_m == pytest.approx(2.5, rel=1e-3)
    truth = seen(PAPER.camera, distance_to(2.5), math.degrees(view.turn_rad))
    assert within_a_pixel(on_paper(view), truth, 0.01) > 0.999
    np.testing.assert_allclose(view.back(view.range_m), image[image > 0], atol=0.03)


def test_mirrored_frames_are_turned_round() -> None:
    image = seen(KINECT_2, 2.0)
    turned = np.ascontiguousarray(image[:, ::-1])
    lens = replace(KINECT_2, centre_px=(KINECT_2.columns - KINECT_2.centre_px[0], KINECT_2.centre_px[1]))
    plain, mirrored = viewed(image, KINECT_2), viewed(turned, lens, mirrored=True)
    np.testing.assert_array_equal(on_paper(mirrored), on_paper(plain))
    assert plain.range_m.any() and not np.array_equal(viewed(turned, lens).range_m, plain.range_m)
    labels = np.arange(plain.range_m.size).reshape(plain.range_m.shape)
    back = np.zeros(image.shape, int)
    back[turned > 0] = mirrored.back(labels)
    assert mirrored.range_m.shape == plain.range_m.shape
    np.testing.assert_array_equal(back[:, ::-1][image > 0], plain.back(labels))


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_whole_frame_is_shown_as_it_stands_and_without_its_background(mirrored: bool) -> None:
    frame = np.arange(1, 13, dtype=np.float32).reshape(3, 4)
    pixels = np.flatnonzero(frame % 3)
    view = view_frame(frame, pixels, mirrored)
    np.testing.assert_array_equal(view.range_m, np.where(frame % 3, frame, 0)[:, :: -1 if mirrored else 1])
    np.testing.assert_array_equal(view.back(view.range_m), frame.ravel()[pixels])
    assert (view.corner, view.turn_rad, view.median_range_m, view.scale) == ((0, 0), 0, 6, 1)


def turned(
    image: Image, pixels: NDArray[np.intp], lens: Camera, view: BodyView
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ranges of pixels [N] after the view's turn, and the same for ranges of 1 before it."""
    x = (pixels % image.shape[1] + 0.5 - lens.centre_px[0]) / lens.focal_px
    ahead = x * math.sin(view.turn_rad) + math.cos(view.turn_rad)
    return image.ravel()[pixels].astype(np.float64) * ahead, ahead


bodies = st.tuples(
    st.integers(1, 12),
    st.integers(1, 12),
    st.floats(0.3, 30.0),
    st.floats(0.4, 6.0),
    st.floats(0.05, 1.0),
    st.integers(0, 2**32 - 1),
    st.booleans(),
)


def body_and_lens(
    rows: int, columns: int, scale: float, middle: float, filled: float, seed: int
) -> tuple[Image, Camera]:
    """Ranges around `middle` at some pixels of a small image, at least one, and a camera that sees it `scale` times
    coarser than the paper's.
    """
    draws = np.random.default_rng(seed)
    image = (middle + draws.uniform(-0.2, 0.2, (rows, columns))).astype(np.float32)
    image[draws.random(image.shape) >= filled] = 0
    image[draws.integers(rows), draws.integers(columns)] = middle
    focal = PAPER.camera.focal_px / 2.5 * middle / scale
    return image, camera(rows, columns, focal, (columns * draws.random(), rows * draws.random()))


@given(bodies)
def test_every_pixel_of_a_body_has_its_place_in_the_view(case: tuple[int, int, float, float, float, int, bool]) -> None:
    *shape, mirrored = case
    image, lens = body_and_lens(*shape)
    pixels = np.flatnonzero(image)
    view = view_body(image, pixels, lens, PAPER, mirrored)

    assert view.view_pixels.shape == pixels.shape
    assert (view.back(view.range_m) > 0).all()
    ranges, ahead = turned(image, pixels, lens, view)
    assert view.median_range_m == pytest.approx(np.median(ranges), rel=1e-9)
    moved = (ranges + 2.5 - view.median_range_m).clip(NEAREST_M, FARTHEST_M).astype(np.float32)
    assert np.isin(view.range_m[view.range_m > 0], moved).all(), "ranges are never blended"
    # Where the view is nowhere coarser, every pixel gets its own range back.
    if view.scale > 1.0001 * ahead.max() ** 2:
        np.testing.assert_array_equal(view.back(view.range_m), moved)
    found = np.argwhere(view.range_m)
    (top, left), (bottom, right) = found.min(0), found.max(0)
    around = [top, view.range_m.shape[0] - 1 - bottom, left, view.range_m.shape[1] - 1 - right]
    assert min(around) >= 32 and view.range_m.shape >= (640, 329)
    assert abs(around[0] - around[1]) <= 2 * view.scale + 3 and abs(around[2] - around[3]) <= 2 * view.scale + 3


@given(bodies)
def test_loops_give_the_bits_of_plain_forms(case: tuple[int, int, float, float, float, int, bool]) -> None:
    *shape, mirrored = case
    image, lens = body_and_lens(*shape)
    found = view_body(image, np.flatnonzero(image), lens, PAPER, mirrored)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "compiled_loops", lambda: PlainViewLoops)
        plain = view_body(image, np.flatnonzero(image), lens, PAPER, mirrored)
    np.testing.assert_array_equal(found.range_m, plain.range_m)
    np.testing.assert_array_equal(found.view_pixels, plain.view_pixels)
    assert (found.corner, found.scale) == (plain.corner, plain.scale)


@pytest.mark.parametrize(("value", "named"), [(np.nan, "nan"), (np.inf, "inf"), (-2.0, "-2"), (0.0, "0")])
def test_ranges_that_are_none_are_refused(value: float, named: str) -> None:
    image = np.full((6, 5), 2.0, np.float32)
    image[3, 2] = value
    with pytest.raises(BadConfig, match=f"^a body's ranges must be finite and in front of its view, found {named}"):
        view_body(image, np.arange(30), camera(6, 5, 50.0), PAPER, turn_rad=0.0)
    if value != 0:
        with pytest.raises(BadConfig, match="^a body's ranges must be finite and in front of its view, found "):
            view_body(image, np.arange(30), camera(6, 5, 50.0), PAPER)


@pytest.mark.parametrize("range_m", [1e-17, 4.6e-41])  # the second: 1 m, its bytes in the other order
def test_a_body_that_is_far_smaller_than_a_pixel_of_the_view_is_one_pixel(range_m: float) -> None:
    view = viewed(np.full((6, 5), range_m, np.float32), camera(6, 5, 50.0))
    assert len(np.unique(view.view_pixels)) == np.count_nonzero(view.range_m) == 1
    assert (view.back(view.range_m) == np.float32(PAPER.stand_off_m)).all()


def test_a_pixel_of_the_view_is_the_pixel_that_its_centre_falls_in() -> None:
    """By a slow loop with rotation matrices, for some pixels of a picture without holes."""
    draws = np.random.default_rng(2)
    for scale in (0.37, 1.0, 2.6):
        image = (2.5 + draws.uniform(-0.4, 0.4, (40, 30))).astype(np.float32)
        lens = camera(40, 30, 303.0303 * 2.5 / scale / 8, (5.3, 22.9))  # so wide that the body is seen from the side
        view = viewed(image, lens)
        assert abs(math.degrees(view.turn_rad)) > 2
        sine, cosine = math.sin(view.turn_rad), math.cos(view.turn_rad)
        rotation = np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])
        focal = PAPER.camera.focal_px / 2.5 * view.median_range_m
        found = 0
        for row, column in draws.permutation(np.argwhere(view.range_m))[:500]:
            x, y = column + 0.5 + view.corner[1] - 164.5, row + 0.5 + view.corner[0] - 320
            ray = rotation.T @ (x / focal, y / focal, 1)
            x, y = ray[:2] / ray[2] * lens.focal_px + lens.centre_px
            if not (0 <= x < 30 and 0 <= y < 40):
                continue  # a border pixel of the body, whose centre is in this pixel though the pixel's is not in it
            seen_there = (int(x) + 0.5 - 5.3) / lens.focal_px, (int(y) + 0.5 - 22.9) / lens.focal_px, 1.0
            expected = (rotation @ seen_there)[2] * image[int(y), int(x)] + 2.5 - view.median_range_m
            assert view.range_m[row, column] == pytest.approx(expected, abs=1e-6)
            found += 1
        assert found > 450


def test_thin_things_are_not_lost_where_the_view_is_coarser() -> None:
    image = np.zeros((50, 50), np.float32)
    image[:, 7] = image[31] = 2.0
    view = viewed(image, camera(50, 50, PAPER.camera.focal_px / 2.5 * 2.0 / 0.2))
    assert view.scale == pytest.approx(0.2)
    seen = view.range_m > 0
    for sums in (seen.sum(0), seen.sum(1)):  # 10 pixels long and one wide, but for where the rasters meet
        assert set(sums) in ({0, 1, 10}, {0, 1, 11}) and (sums >= 10).sum() == 1


@pytest.mark.parametrize("step_mm", [0.1, 1.0])
def test_ranges_stay_what_a_range_of_the_rig_can_be(step_mm: float) -> None:
    image = np.array([[0.5, 9.0, 9.0, 9.0, 300.0 * step_mm]], np.float32)
    rig = replace(PAPER, range_step_mm=step_mm)
    view = view_body(image, np.arange(5), camera(1, 5, 50.0), rig)
    assert view.range_m[view.range_m > 0].min() == pytest.approx(step_mm / 1000)
    assert view.range_m.max() == pytest.approx(65.535 * step_mm)
    assert (view.back(view.range_m) > 0).all()


def test_a_view_beyond_reason_is_refused() -> None:
    image = np.full((480, 640), 60.0, np.float32)
    with pytest.raises(BadConfig, match="^a body's view must be at most 2048 .*found 22229 x 16688 "):
        viewed(image, KINECT_1)
    wide = replace(KINECT_1, focal_px=KINECT_1.focal_px * 60)
    assert max(viewed(image, wide).range_m.shape) < LARGEST_SIDE


def test_usual_views_are_of_the_sizes_and_numbers_that_frames_give() -> None:
    rig = load_rig()
    rows, columns = rig.camera.rows, rig.camera.columns
    assert [(len(views), *views[0].shape) for views in usual_views(rig, True)] == [
        *((several, rows, columns) for several in range(1, USUAL_PEOPLE + 1)),
        *((1, rows, columns + STEP * wider) for wider in range(1, 6)),
    ]
    assert columns + 4 * STEP < rows <= columns + 5 * STEP
    alone = [(1, rows, columns + STEP * wider) for wider in range(6)]
    assert [(len(views), *views[0].shape) for views in usual_views(rig, False)] == alone
    for views in usual_views(rig, True):
        assert all(view.dtype == np.float32 and (view == rig.stand_off_m).any() for view in views)
    landscape = replace(rig, camera=replace(rig.camera, rows=480, columns=640))
    assert {views[0].shape for views in usual_views(landscape, True)} == {(480, 640)}
