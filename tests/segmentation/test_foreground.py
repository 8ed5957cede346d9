"""Background removal: surfaces by range, planes of a room, and what is left of a body's size."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from plain_loops import connected_surfaces
from skimage.measure import label

from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import Camera
from bodyseg_model.segmentation import Background, find_bodies
from bodyseg_model.segmentation.surfaces import GAP_PIXELS, JUMP_M, JUMP_SHARE, SHADOW_M, on_largest_plane, seen_area_m2

Image = NDArray[np.float32]

KINECT = Camera(240, 320, 262.5, (160.0, 120.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
"""A Kinect's view with half its pixels a side."""


def rays() -> NDArray[np.float64]:
    return KINECT.pixel_rays()


def plane(normal: tuple[float, float, float], distance: float) -> Image:
    """What the camera sees of the plane normal · point = distance (camera axes, metres); inf where it sees nothing."""
    with np.errstate(divide="ignore"):
        seen = distance / (rays() @ np.asarray(normal, np.float64))
    return np.where((seen > 0) & (seen < 20), seen, np.inf).astype(np.float32)


def ellipsoid(centre: tuple[float, float, float], axes: tuple[float, float, float]) -> Image:
    """The same of an ellipsoid."""
    way, start = rays() / axes, -np.asarray(centre) / axes
    a, b, c = (way**2).sum(-1), (way * start).sum(-1), (start**2).sum() - 1
    inside = b**2 - a * c
    return np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, np.inf).astype(np.float32)


def person(x: float, z: float, floor: float = 0.9) -> Image:
    """A plain figure, 1.7 m tall, that stands on a floor `floor` below the camera (y points down)."""
    parts = [
        ((0.0, -1.15, 0.0), (0.18, 0.34, 0.12)),
        ((0.0, -1.56, 0.0), (0.09, 0.14, 0.1)),
        ((-0.1, -0.42, 0.0), (0.08, 0.44, 0.09)),
        ((0.1, -0.42, 0.0), (0.08, 0.44, 0.09)),
    ]
    return together(*(ellipsoid((x + dx, floor + dy, z + dz), axes) for (dx, dy, dz), axes in parts))


def together(*images: Image) -> Image:
    """The nearest of all, inf where there is none."""
    return np.minimum.reduce(images)


def frame(*images: Image) -> Image:
    """What is nearest as a frame: 0 where nothing was measured."""
    nearest = together(*images)
    return np.where(np.isfinite(nearest), nearest, 0).astype(np.float32)


def box(height: float, width: float, z: float, x: float = 0.0, y: float = 0.0) -> Image:
    """A flat thing that faces the camera."""
    seen = rays() * z
    inside = (abs(seen[..., 0] - x) < width / 2) & (abs(seen[..., 1] - y) < height / 2)
    return np.where(inside, np.float32(z), np.float32(np.inf))


def mask(bodies: tuple[NDArray[np.intp], ...]) -> NDArray[np.bool_]:
    found = np.zeros(KINECT.rows * KINECT.columns, np.bool_)
    found[np.concatenate([*bodies, np.empty(0, np.intp)])] = True
    return found.reshape(KINECT.rows, KINECT.columns)


# Surfaces.


def slow_surfaces(range_m: Image, focal_px: float) -> NDArray[np.int32]:
    """Readable and slow: flood each surface from its first pixel."""
    surfaces = np.full(range_m.shape, -1, np.int32)
    steps = [(s * k, 0) for s in (-1, 1) for k in range(1, GAP_PIXELS + 1)]
    steps += [(0, s * k) for s in (-1, 1) for k in range(1, GAP_PIXELS + 1)]
    count = 0
    for start in np.ndindex(range_m.shape):
        if not range_m[start] or surfaces[start] >= 0:
            continue
        waiting = [start]
        surfaces[start] = count
        while waiting:
            row, column = waiting.pop()
            over_holes = [(0, right) for right in across_holes(range_m, focal_px, row, column)]
            for down, right in [*steps, *over_holes]:
                place = row + down, column + right
                if not (0 <= place[0] < range_m.shape[0] and 0 <= place[1] < range_m.shape[1]):
                    continue
                if range_m[place] and surfaces[place] < 0 and on_one_surface(range_m[row, column], range_m[place]):
                    surfaces[place] = count
                    waiting.append(place)
        count += 1
    return surfaces


def across_holes(range_m: Image, focal_px: float, row: int, column: int) -> list[int]:
    """Steps to the next measured pixels of the row, where a shadow may be as wide as that."""
    steps = []
    for way in (-1, 1):
        step = way
        while 0 <= column + step < range_m.shape[1] and not range_m[row, column + step]:
            step += way
        if 0 <= column + step < range_m.shape[1]:
            nearer = min(range_m[row, column], range_m[row, column + step])
            if abs(step) / focal_px * nearer <= SHADOW_M:
                steps.append(step)
    return steps


def on_one_surface(a: float, b: float) -> bool:
    """How many jumps lie between two ranges, by adding up small steps."""
    ends = np.linspace(min(a, b), max(a, b), 2001)
    middles = (ends[1:] + ends[:-1]) / 2
    return bool((np.diff(ends) / np.maximum(JUMP_M, JUMP_SHARE * middles)).sum() <= 1)


@given(
    st.tuples(st.integers(1, 7), st.integers(1, 14)),
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.02, 0.3, 1.0]),
    st.sampled_from([0.4, 0.8]),
    st.sampled_from([1.0, 111.0]),
)
def test_surfaces_are_those_of_a_flood(
    shape: tuple[int, int], seed: int, spread: float, missing: float, focal_px: float
) -> None:
    draws = np.random.default_rng(seed)
    ranges = np.where(draws.random(shape) < missing, 0, 2.45 + spread * draws.normal(0, 0.3, shape))
    ranges = np.maximum(ranges, 0).astype(np.float32)
    np.testing.assert_array_equal(connected_surfaces(ranges, focal_px), slow_surfaces(ranges, focal_px))


@pytest.mark.parametrize("seed", range(3))
def test_surfaces_of_a_whole_frame_are_regions_of_scikit_image(seed: int) -> None:
    side = GAP_PIXELS + 1  # blocks as wide as that leave no neighbours across one, and no shadow is wider at 1 px
    blocks = np.random.default_rng(seed).choice([0, 1, 2, 3], (480 // side, 640 // side), p=(0.3, 0.3, 0.2, 0.2))
    levels = blocks.repeat(side, axis=0).repeat(side, axis=1)
    regions = label(levels, background=0, connectivity=1)
    assert regions.max() > 1000
    np.testing.assert_array_equal(connected_surfaces(levels.astype(np.float32), 1.0), regions - 1)


def test_a_shadow_does_not_part_a_surface_and_a_gap_does() -> None:
    ranges = np.full((20, 100), 2.0, np.float32)
    ranges[:, 40:56] = 0  # 17 pixels from one side to the other: 0.136 m at 2 m with 250 px
    assert connected_surfaces(ranges, 250.0).max() == 0
    assert connected_surfaces(ranges, 220.0).max() == 1
    ranges[:, 56:] = 2.2
    assert connected_surfaces(ranges, 250.0).max() == 1
    ranges[:, 48], ranges[:, 56:] = 4.0, 2.0
    assert connected_surfaces(ranges, 250.0).max() == 2


def test_rows_do_not_run_into_each_other() -> None:
    ranges = np.zeros((2, 12), np.float32)
    ranges[0, -1] = ranges[1, 0] = 2
    assert connected_surfaces(ranges, 1.0).max() == 1


def test_a_long_winding_surface_is_one() -> None:
    ranges = np.zeros((81, 60), np.float32)
    ranges[::8] = 1
    for turn, row in enumerate(range(0, 80, 8)):
        ranges[row : row + 8, -1 if turn % 2 == 0 else 0] = 1
    assert connected_surfaces(ranges, 1.0).max() == 0
    assert connected_surfaces(ranges[:, 1:-1], 1.0).max() == 10


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1)])
def test_small_images_have_surfaces_too(shape: tuple[int, int]) -> None:
    assert (connected_surfaces(np.zeros(shape, np.float32), 1.0) == -1).all()
    assert (connected_surfaces(np.full(shape, 65.0, np.float32), 1.0) == 0).all()


# Planes.


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.3, 0.1, 1.0), (0.0, 1.0, 0.15)])
def test_a_plane_is_found_and_nothing_beside_it(normal: tuple[float, float, float]) -> None:
    wall = plane(normal, 2.0 if normal[2] == 1 else 0.9)
    wall[wall > 6] = np.inf
    thing = ellipsoid((0.3, 0.1, 1.2), (0.2, 0.3, 0.1))
    noise = np.random.default_rng(0).normal(0, 0.001, wall.shape)
    image = frame(together(wall, thing))
    image[image > 0] = 1 / (1 / image[image > 0] + noise[image > 0])
    pixels = np.flatnonzero(image)
    found = np.zeros(image.size, np.bool_)
    found[pixels[on_largest_plane(image, pixels, KINECT)]] = True
    expected = ((image > 0) & (wall < thing)).ravel()
    assert found[expected].all()
    assert not found[~expected].any()


def test_a_plane_is_as_large_as_its_seen_surface() -> None:
    tilt = np.array([0.4, -0.3, 0.5])  # a, b, c of the plane a X + b Y + c Z = 1
    inverse = rays() @ tilt
    seen = inverse > 0.05
    # Areas of the quadrilaterals between neighbouring pixels' points, half of the diagonals' cross product.
    points = rays() / inverse[..., None]
    diagonals = points[1:, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, 1:]
    areas = np.linalg.norm(np.cross(*diagonals), axis=-1) / 2
    whole = seen[1:, 1:] & seen[:-1, :-1] & seen[1:, :-1] & seen[:-1, 1:]
    assert seen_area_m2(float((inverse[seen] ** -3).sum()), tilt, KINECT) == pytest.approx(areas[whole].sum(), rel=0.05)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((240, 320), np.float32),
        frame(box(0.9, 0.9, 2.0)),
        frame(ellipsoid((0.0, 0.0, 2.5), (1.0, 1.0, 0.5))),
    ],
    ids=["nothing", "small", "round"],
)
def test_what_is_no_large_plane(image: Image) -> None:
    pixels = np.flatnonzero(image)
    assert not on_largest_plane(image, pixels, KINECT).any()


@pytest.mark.parametrize("pixels", [[5], [5, 6], [5, 6, 7], [5, 5 + 320, 5 + 640]])
def test_pixels_of_a_line_make_no_plane(pixels: list[int]) -> None:
    image = np.full((240, 320), 3.0, np.float32)
    assert not on_largest_plane(image, np.array(pixels), KINECT).any()


# Bodies.

FLOOR, WALL = plane((0.0, 1.0, 0.0), 0.9), plane((0.1, 0.0, 1.0), 3.6)
SIDE = plane((-1.0, 0.0, 0.2), 2.0)


@pytest.mark.parametrize(
    "room",
    [(), (WALL,), (FLOOR,), (FLOOR, WALL), (FLOOR, WALL, SIDE)],
    ids=["no room", "wall", "floor", "floor and wall", "corner"],
)
def test_a_person_is_found_in_a_room(room: tuple[Image, ...]) -> None:
    figure = person(0.1, 2.6)
    truth = np.isfinite(figure) & (figure <= together(figure, *room))
    (found,) = find_bodies(frame(figure, *room), KINECT, Background())
    assert (mask((found,)) & ~truth).sum() <= 0.002 * truth.sum()
    low = (rays()[..., 1] * np.where(truth, figure, 0)) > 0.9 - 0.05  # soles lie on the floor's plane
    assert mask((found,))[truth & ~low].all()


def test_sensor_noise_and_holes_leave_a_person_whole() -> None:
    draws = np.random.default_rng(1)
    figure = person(0.0, 2.4)
    image = frame(figure, FLOOR, WALL)
    image = np.where(draws.random(image.shape) < 0.15, 0, image + draws.normal(0, 0.0015, image.shape) * image**2)
    image = np.maximum(image, 0).astype(np.float32)
    (found,) = find_bodies(image, KINECT, Background())
    above = (rays()[..., 1] * image) < 0.8
    truth = np.isfinite(figure) & (image > 0) & above
    assert (mask((found,)) & truth).sum() >= 0.998 * truth.sum()
    assert (mask((found,)) & above & ~truth).sum() <= 0.01 * truth.sum()


def test_several_people_are_several_bodies_the_largest_first() -> None:
    people = [person(0.6, 3.0), person(-0.55, 2.2, 1.6)]  # the near one's feet are out of view
    bodies = find_bodies(frame(*people, FLOOR, WALL), KINECT, Background())
    assert len(bodies) == 2
    assert np.intersect1d(*bodies).size == 0
    for body, figure in zip(bodies, people, strict=True):
        assert np.isfinite(figure.ravel()[body]).mean() > 0.99
        assert (np.diff(body) > 0).all()


@pytest.mark.parametrize(
    ("piece", "belongs"),
    [
        (ellipsoid((0.05, -0.2, 2.1), (0.05, 0.08, 0.03)), True),
        (ellipsoid((0.05, -0.2, 1.7), (0.05, 0.08, 0.03)), False),
        (ellipsoid((-0.24, 0.2, 2.8), (0.08, 0.08, 0.03)), True),
        (ellipsoid((-0.3, 0.2, 3.3), (0.1, 0.08, 0.03)), False),
        (ellipsoid((0.9, 0.0, 2.6), (0.1, 0.1, 0.1)), False),
        (box(0.5, 0.14, 2.2, 0.05, 0.2), True),
        (box(0.36, 0.36, 2.2, 0.3, 0.1), False),
    ],
    ids=["hand before", "ball far before", "hand behind", "ball far behind", "ball beside", "arm", "tray"],
)
def test_pieces_of_an_arms_size_in_reach_belong_to_a_body(piece: Image, belongs: bool) -> None:
    figure = person(0.0, 2.6)
    bodies = find_bodies(frame(figure, piece), KINECT, Background())
    seen = (figure < piece) | (np.isfinite(piece) if belongs else np.zeros_like(piece, np.bool_))
    np.testing.assert_array_equal(mask(bodies[:1]), seen & np.isfinite(together(figure, piece)))


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((240, 320), np.float32),
        np.full((240, 320), 2.0, np.float32),
        np.full((240, 320), 65.0, np.float32),
        frame(FLOOR, WALL, SIDE),
        frame(box(0.2, 1.2, 2.0)),
        frame(box(0.3, 0.1, 2.0)),
        frame(person(0.0, 5.6)),
    ],
    ids=["nothing", "wall", "far wall", "empty room", "low", "small", "beyond the limits"],
)
def test_where_nobody_is_nobody_is_found(image: Image) -> None:
    assert find_bodies(image, KINECT, Background()) == ()


def test_a_body_may_touch_every_border() -> None:
    near = ellipsoid((0.0, 0.3, 0.95), (0.6, 0.75, 0.3))
    image = frame(near)
    assert all((image[edge] > 0).any() for edge in ((0,), (-1,), (..., 0), (..., -1)))
    (found,) = find_bodies(image, KINECT, Background())
    np.testing.assert_array_equal(mask((found,)), image > 0)


def test_finding_does_not_change_the_frame() -> None:
    image = frame(person(0.1, 2.6), FLOOR, WALL)
    before = image.copy()
    find_bodies(image, KINECT, Background())
    np.testing.assert_array_equal(image, before)


def test_limits_and_keep_take_all_as_one_body() -> None:
    image = frame(person(-0.6, 2.2), person(0.6, 3.0), WALL)
    (kept,) = find_bodies(image, KINECT, Background("keep"))
    np.testing.assert_array_equal(mask((kept,)), image > 0)
    (limited,) = find_bodies(image, KINECT, Background("limits", 2.5, 3.2))
    np.testing.assert_array_equal(mask((limited,)), (image >= 2.5) & (image <= np.float32(3.2)))
    for mode in ("keep", "limits"):
        assert find_bodies(np.zeros_like(image), KINECT, Background(mode)) == ()
    assert find_bodies(image, KINECT, Background("limits", 0.1, 0.2)) == ()


@pytest.mark.parametrize("limits", [(-1, 2), (2, 2), (3, 2), (0, float("inf")), (float("nan"), 2), (1, float("nan"))])
def test_limits_are_in_order(limits: tuple[float, float]) -> None:
    with pytest.raises(BadConfig, match=f"^the near limit .* {limits[0]:g} and {limits[1]:g} m"):
        Background("limits", *limits)


@pytest.mark.parametrize(
    ("background", "keys"),
    [
        (Background("keep"), {"mode"}),
        (Background("limits"), {"mode", "near_m", "far_m"}),
        (Background(), {"mode", "near_m", "far_m"}),
    ],
)
def test_all_that_the_removal_depends_on_is_stated(background: Background, keys: set[str]) -> None:
    stated: dict[str, Any] = background.to_json()
    assert set(stated) == keys
    assert stated["mode"] == background.mode


@pytest.mark.parametrize("mode", ["people", "limits", "keep"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -1.0])
def test_what_is_no_range_is_not_measured(mode: Any, value: float) -> None:
    image = frame(person(0.0, 2.5))
    broken, holes = image.copy(), np.random.default_rng(0).random(image.shape) < 0.2
    broken[holes], image[holes] = value, 0
    found, expected = (find_bodies(each, KINECT, Background(mode)) for each in (broken, image))
    assert len(found) == len(expected) == 1
    np.testing.assert_array_equal(found[0], expected[0])
