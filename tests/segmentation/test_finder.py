"""People in frames: what the finder sees of them, and who is who; and the other ways to remove a background."""

from __future__ import annotations

import itertools
import sys
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from label_networks import Nearer, Places
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_data.rigs import Camera
from bodyseg_model.networks import build
from bodyseg_model.runtimes import on_backend
from bodyseg_model.segmentation import Background, find_bodies, finder
from bodyseg_model.segmentation.finder import FinderView, part_people
from bodyseg_model.segmentation.pixel_loops import AROUND, spread_odds, take_nearest

pytestmark = pytest.mark.usefixtures("one_thread")

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


# What the finder sees.


def lens(rows: int, columns: int, focal_px: float, centre: tuple[float, float]) -> Camera:
    return Camera(rows, columns, focal_px, centre, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def test_a_frame_of_the_finders_own_camera_is_shown_as_it_is() -> None:
    for camera in (lens(60, 80, 100.0, (40.0, 30.0)), lens(60, 80, 100.4, (40.3, 29.8))):
        network = Nearer()
        frame = np.random.default_rng(0).uniform(0.5, 6, (60, 80)).astype(np.float32)
        frame[:5] = 0
        found = FinderView(network, camera)(frame)
        np.testing.assert_array_equal(network.seen[0][0, 0].numpy(), frame)
        np.testing.assert_array_equal(found > 0.5, (frame > 0) & (frame < 3.5))
        assert (found[:5] == 0).all()


@pytest.mark.parametrize(
    "camera",
    [
        *(lens(50, 70, focal_px, (30.0, 28.0)) for focal_px in (57.0, 141.0, 260.0)),
        lens(60, 80, 150.0, (60.0, 45.0)),  # is shown in an image of its own size
        lens(60, 80, 150.0, (20.0, 15.0)),
    ],
)
def test_other_cameras_are_resampled_by_nearest_pixels(camera: Camera) -> None:
    network, (x, y), scale = Nearer(limit_m=100.0), camera.centre_px, camera.focal_px / 100
    frame = (1 + np.arange(camera.rows)[:, None] / 50 + np.arange(camera.columns) / 7000).astype(np.float32)
    found = FinderView(network, camera)(frame)
    seen = network.seen[0][0, 0].numpy()
    assert all(side % 2 == 0 for side in seen.shape), "the principal point is the middle"
    down, across = (np.arange(side) + 0.5 - side / 2 for side in seen.shape)
    rows, columns = np.floor(y + down * scale), np.floor(x + across * scale)
    inside = ((rows >= 0) & (rows < camera.rows))[:, None] & ((columns >= 0) & (columns < camera.columns))
    np.testing.assert_array_equal(seen > 0, inside)
    expected = frame.take(rows.astype(int), 0, mode="clip").take(columns.astype(int), 1, mode="clip")
    np.testing.assert_array_equal(seen[inside], expected[inside])
    assert (found > 0.99).all(), "all that is measured has an answer"


@pytest.mark.parametrize(("focal_px", "centre"), [(35.0, (25.0, 20.0)), (12.5, (25.0, 20.0)), (30.0, (10.0, 24.0))])
def test_frames_of_few_pixels_are_interpolated(focal_px: float, centre: tuple[float, float]) -> None:
    network, (x, y), scale = Nearer(limit_m=100.0), centre, focal_px / 100
    frame = (1 + np.arange(40)[:, None] / 50 + np.arange(50) / 70).astype(np.float32)
    frame[7, 9] = 0
    found = FinderView(network, lens(40, 50, focal_px, centre))(frame)
    seen = network.seen[0][0, 0].numpy()
    rows, columns = (
        middle + (np.arange(side) + 0.5 - side / 2) * scale - 0.5
        for middle, side in ((y, seen.shape[0]), (x, seen.shape[1]))
    )
    between = (rows > 0)[:, None] & (rows < 39)[:, None] & (columns > 0) & (columns < 49)
    far = (np.abs(rows - 7) >= 1)[:, None] | (np.abs(columns - 9) >= 1)
    plane = 1 + rows[:, None] / 50 + columns / 70
    np.testing.assert_allclose(seen[between & far], plane[between & far], rtol=1e-6)
    beside = between & (np.abs(rows - 7) < 0.5)[:, None] & (np.abs(columns - 9) < 0.5)
    assert beside.any() and (seen[beside] == 0).all()
    inside = ((rows >= -0.5) & (rows < 39.5))[:, None] & (columns >= -0.5) & (columns < 49.5)
    np.testing.assert_array_equal(seen > 0, inside & ~beside)
    assert (found[frame > 0] > 0.99).all() and found[7, 9] == 0


@given(st.integers(1, 700), st.floats(-0.5, 1.5), st.floats(0.05, 8))
@example(1008, 0.5, 0.0875)  # its last pixel lies half a pixel beyond the resampled image
def test_every_pixel_has_a_place_in_the_resampled_image_and_none_lies_beyond(
    side: int, middle: float, scale: float
) -> None:
    there, back, _ = finder._resampled(side, middle * side, scale)
    assert len(back) == side and back.min() >= 0 and back.max() < len(there)
    (shown,) = np.nonzero(there < side)
    assert there.min() >= 0 and there.max() <= side
    assert np.abs(back[there[shown]] - shown).max(initial=0) <= scale / 2 + 1


@pytest.mark.parametrize("focal_px", [60.0, 262.5, 700.0])
def test_silhouettes_stay_clean(focal_px: float) -> None:
    draws, figure = np.random.default_rng(1), person(0.1, 2.6)
    image = frame(figure, box(9, 9, 4.5))
    image[draws.random(image.shape) < 0.1] = 0
    found = FinderView(Nearer(focal_px=focal_px), KINECT)(image)
    expected = np.isfinite(figure) & (image > 0)
    if focal_px > 200:
        np.testing.assert_array_equal(found > 0.5, expected)
    else:  # samples are four pixels apart
        assert not (found[~expected] > 0.5).any() and (found[expected] > 0.5).mean() > 0.97


def test_what_is_no_finder() -> None:
    with pytest.raises(BadConfig, match="^a finder of people needs 2 classes and the setting focal_px, found 33 class"):
        find_bodies(frame(person(0.0, 2.5)), KINECT, Background(), Places(0, 5))


def test_a_finder_stays_one_on_another_backend() -> None:
    pytest.importorskip("onnxruntime")
    settings = {"patch": 8, "widths": [8], "blocks": [0], "context": False, "focal_px": 262.5, "classes": 2}
    network = build("compact", settings, seed=1).eval()
    image = frame(person(0.1, 2.6), box(9, 9, 4.0))
    one, other = (FinderView(on_backend(network, name), KINECT)(image) for name in ("torch", "onnxruntime"))
    np.testing.assert_allclose(one, other, atol=1e-3)


# Who is who.


def parted(*images: Image, room: Image | None = None) -> list[NDArray[np.bool_]]:
    """The people that are found among what `images` show, before a room, as masks."""
    people = together(*images)
    shown = np.isfinite(people) if room is None else np.isfinite(people) & (people <= room)
    image = frame(people) if room is None else frame(people, room)
    found = part_people(image, shown, KINECT)
    assert all((np.diff(pixels) > 0).all() for pixels in found)
    assert len(np.unique(np.concatenate([*found, np.empty(0, np.intp)]))) == sum(map(len, found))
    assert [len(each) for each in found] == sorted(map(len, found), reverse=True) or len(found) > 1
    return [mask((pixels,)) for pixels in found]


@pytest.mark.parametrize("shape", [(60, 240), (240, 60)])
def test_samples_are_points_and_neighbours_on_one_surface(
    shape: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    draws, taken = np.random.default_rng(4), list[Any]()
    monkeypatch.setattr(
        finder, "_persons", lambda samples, _: taken.append(samples) or np.zeros(len(samples.rows), int)
    )
    camera = lens(*shape, 525.0, (81.3, 57.8))  # every third pixel
    image = draws.choice(np.array([2.0, 2.04, 2.12, 4.0, 4.15, 4.165], np.float32), shape)
    shown = (draws.random(shape) < 0.2) & (np.indices(shape) >= 5).all(axis=0)
    part_people(image, shown, camera)
    (samples,) = taken
    top, left = np.argwhere(shown).min(axis=0)
    rows, columns = top + 1 + 3 * samples.rows, left + 1 + 3 * samples.columns
    assert shown[rows, columns].all() and len(rows) == np.count_nonzero(shown[top + 1 :: 3, left + 1 :: 3])
    z = image[rows, columns].astype(float)
    np.testing.assert_allclose(samples.points, camera.pixel_rays()[rows, columns] * z[:, None], rtol=1e-6)
    np.testing.assert_allclose(samples.area_m2, (3 * z / 525) ** 2)
    expected = set()
    for line, place in ((samples.rows, samples.columns), (samples.columns, samples.rows)):
        for one in np.unique(line):
            own = np.flatnonzero(line == one)
            own = own[np.argsort(place[own])]
            for a, b in itertools.pairwise(own.tolist()):
                gap, nearer = place[b] - place[a] - 1, min(z[a], z[b])
                near = gap <= 1 or gap * 3 / 525 * nearer <= 0.2
                if near and abs(z[a] - z[b]) <= max(0.1, 0.04 * nearer):
                    expected.add((a, b))
    assert set(map(tuple, samples.edges.T.tolist())) == expected and len(expected) > 100


def box_of_part(rows: tuple[int, int], x: tuple[float, float], y: tuple[float, float], z: float) -> Any:
    return tuple(np.array([rows[end], 0, x[end], y[end], z + 0.1 * end]) for end in (0, 1))


UPPER = box_of_part((0, 10), (-0.3, 0.2), (-0.9, -0.1), 2.0)


@pytest.mark.parametrize(
    ("lower", "one"),
    [
        (box_of_part((10, 30), (-0.2, 0.3), (0.3, 0.8), 2.0), True),
        (box_of_part((9, 30), (-0.2, 0.3), (0.3, 0.8), 2.0), False),
        (box_of_part((10, 30), (-0.01, 0.8), (0.3, 0.8), 2.0), False),
        (box_of_part((10, 30), (-0.06, 0.8), (0.3, 0.8), 2.0), True),
        (box_of_part((10, 30), (-0.8, -0.04), (0.3, 0.8), 2.0), True),
        (box_of_part((10, 30), (0.05, 0.25), (0.3, 0.8), 2.0), True),
        (box_of_part((10, 30), (0.15, 0.35), (0.3, 0.8), 2.0), False),
        (box_of_part((10, 30), (-0.2, 0.3), (0.3, 0.8), 2.3), True),
        (box_of_part((10, 30), (-0.2, 0.3), (0.3, 0.8), 2.4), False),
        (box_of_part((10, 30), (-0.2, 0.3), (0.3, 0.8), 1.6), False),
        (box_of_part((10, 30), (-0.2, 0.3), (0.3, 1.19), 2.0), True),
        (box_of_part((10, 30), (-0.2, 0.3), (0.3, 1.21), 2.0), False),
    ],
)
def test_a_person_in_two_parts_is_one_above_the_other(lower: Any, one: bool) -> None:
    """In boxes of rows, columns, x, y and z: half as wide in common, at one range, and no taller than people are."""
    assert finder._one_above_other(UPPER, lower) is finder._one_above_other(lower, UPPER) is one


def test_a_person_is_one_whatever_gaps_noise_and_shadows_part() -> None:
    draws, figure = np.random.default_rng(1), person(0.0, 2.4)
    noisy = figure * (1 + draws.normal(0, 0.004, figure.shape)).astype(np.float32)
    noisy[draws.random(figure.shape) < 0.15] = np.inf
    noisy[:, 150:154] = np.inf  # 4 cm
    (found,) = parted(noisy)
    assert found[np.isfinite(noisy)].mean() > 0.995


@pytest.mark.parametrize("apart", [0.46, 0.55, 0.9])
def test_people_side_by_side_are_two(apart: float) -> None:
    one, other = person(-apart / 2, 2.6), person(apart / 2, 2.63)
    arms = ellipsoid((0.0, -0.3, 2.6), (0.55, 0.06, 0.05))  # on each other's shoulders
    found = parted(one, other, arms)
    assert len(found) == 2
    for figure in (one, other):
        own = np.isfinite(figure) & (figure <= together(one, other)) & ~np.isfinite(arms)
        assert max(mine[own].mean() for mine in found) > 0.95


def test_three_people_side_by_side_are_three() -> None:
    figures = [person(x, 2.6) for x in (-0.5, 0.0, 0.5)]
    found = parted(*figures, ellipsoid((0.0, -0.3, 2.6), (0.7, 0.06, 0.05)))
    assert len(found) == 3
    assert all(max(mine[np.isfinite(figure)].mean() for mine in found) > 0.9 for figure in figures)


def test_a_person_who_holds_a_parcel_is_one() -> None:
    """Its surface is large enough for a person of its own, but the head is above it."""
    figure, parcel = person(0.0, 2.6), box(0.4, 0.36, 2.42, 0.0, 0.02)
    (found,) = parted(figure, parcel)
    np.testing.assert_array_equal(found, np.isfinite(together(figure, parcel)))


def test_a_person_before_another_is_another() -> None:
    near, far = person(0.0, 2.0), person(0.15, 2.8)
    found = parted(near, far)
    assert len(found) == 2
    np.testing.assert_array_equal(found[0], np.isfinite(near))
    assert np.count_nonzero(found[1] != (np.isfinite(far) & ~np.isfinite(near))) <= 2


def test_raised_arms_are_no_people() -> None:
    arms = [ellipsoid((x, -0.75, 2.6), (0.05, 0.35, 0.05)) for x in (-0.22, 0.22)]
    (found,) = parted(person(0.0, 2.6), *arms)
    assert (found == np.isfinite(together(person(0.0, 2.6), *arms))).all()


@pytest.mark.parametrize(
    ("piece", "belongs"),
    [
        (ellipsoid((0.05, -0.2, 2.1), (0.05, 0.08, 0.03)), True),
        (ellipsoid((0.05, -0.2, 1.7), (0.05, 0.08, 0.03)), False),
        (ellipsoid((-0.24, 0.2, 2.8), (0.08, 0.08, 0.03)), True),
        (ellipsoid((-0.3, 0.2, 3.3), (0.1, 0.08, 0.03)), False),
        (ellipsoid((0.9, 0.0, 2.6), (0.1, 0.1, 0.1)), False),
        (ellipsoid((0.22, -0.2, 2.2), (0.05, 0.08, 0.03)), True),
        (ellipsoid((-0.22, -0.2, 2.2), (0.05, 0.08, 0.03)), True),
        (ellipsoid((0.0, -0.8, 2.2), (0.08, 0.05, 0.03)), True),
    ],
    ids=["before", "far before", "behind", "far behind", "far aside", "on the right", "on the left", "above"],
)
def test_small_pieces_in_reach_belong_to_a_person(piece: Image, belongs: bool) -> None:
    figure = person(0.0, 2.6)
    (found,) = parted(figure, piece)
    seen = (figure < piece) | (np.isfinite(piece) if belongs else np.zeros_like(piece, np.bool_))
    np.testing.assert_array_equal(found, seen & np.isfinite(together(figure, piece)))


def test_a_person_behind_a_table_is_one() -> None:
    figure = person(0.0, 2.6)
    table = box(0.25, 1.5, 2.0, 0.0, 0.1)
    (found,) = parted(figure, room=table)
    np.testing.assert_array_equal(found, np.isfinite(figure) & ~np.isfinite(table))


@pytest.mark.parametrize(
    "image",
    [
        np.full((240, 320), np.inf, np.float32),
        box(0.03, 1.2, 2.0),
        box(0.3, 0.1, 2.0),
        box(2.0, 3.5, 3.4),
        ellipsoid((0.0, 0.0, 2.0), (0.004, 0.004, 0.004)),
    ],
    ids=["nothing", "thin", "small", "wide", "a pixel"],
)
def test_what_has_no_persons_size_is_nobody(image: Image) -> None:
    assert parted(image) == []


@given(st.tuples(st.integers(1, 40), st.integers(1, 40)), st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.6, 0.98]))
def test_any_pixels_are_parted_each_once(shape: tuple[int, int], seed: int, share: float) -> None:
    draws = np.random.default_rng(seed)
    image = draws.uniform(0.5, 4, shape).astype(np.float32)
    shown = draws.random(shape) < share
    camera = lens(*shape, 30.0, (shape[1] / 2, shape[0] / 2))
    pixels = [np.empty(0, np.intp), *part_people(image, shown, camera)]
    every = np.concatenate(pixels)
    assert len(np.unique(every)) == len(every) and shown.ravel()[every].all()


def test_finding_needs_scipy(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "scipy"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "scipy", None)
    with pytest.raises(MissingLibrary, match=r"^finding people needs the package 'scipy': pip install 'bodyseg\[seg"):
        parted(person(0.0, 2.5))


# Frames.


def test_finding_does_not_change_the_frame() -> None:
    image = frame(person(0.1, 2.6), box(9, 9, 4.0))
    before = image.copy()
    network = Nearer()
    (found,) = find_bodies(image, KINECT, Background("people", 0.5, 3.5), network)
    np.testing.assert_array_equal(image, before)
    assert network.seen[0].max() == 4, "what is farther than people may be is shown to the finder"
    np.testing.assert_array_equal(mask((found.pixels,)), np.isfinite(person(0.1, 2.6)))
    assert found.person == pytest.approx(0.9997, abs=1e-4)
    assert find_bodies(image, KINECT, Background("people", 0.5, 2.0), Nearer()) == ()


def test_limits_and_keep_take_all_as_one_body() -> None:
    image = frame(person(-0.6, 2.2), person(0.6, 3.0), box(9, 9, 3.6))
    ((kept, _),) = find_bodies(image, KINECT, Background("keep"))
    np.testing.assert_array_equal(mask((kept,)), image > 0)
    ((limited, nobody),) = find_bodies(image, KINECT, Background("limits", 2.5, 3.2))
    np.testing.assert_array_equal(mask((limited,)), (image >= 2.5) & (image <= np.float32(3.2)))
    assert nobody is None
    for mode in ("keep", "limits"):
        assert find_bodies(np.zeros_like(image), KINECT, Background(mode)) == ()
    assert find_bodies(image, KINECT, Background("limits", 0.1, 0.2)) == ()


@pytest.mark.parametrize("limits", [(-1, 2), (2, 2), (3, 2), (0, float("inf")), (float("nan"), 2), (1, float("nan"))])
def test_limits_are_in_order(limits: tuple[float, float]) -> None:
    with pytest.raises(BadConfig, match=f"^the near limit .* {limits[0]:g} and {limits[1]:g} m"):
        Background("limits", *limits)
    mode: Any = "limit"
    with pytest.raises(BadConfig, match="^Background: mode must be 'people' or .*, found 'limit'$"):
        Background(mode)


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
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, -1.0, 16.5, 1000.0])
def test_what_is_no_range_is_not_measured(mode: Any, value: float) -> None:
    image = frame(person(0.0, 2.5))
    broken, holes = image.copy(), np.random.default_rng(0).random(image.shape) < 0.2
    broken[holes], image[holes] = value, 0
    found, expected = (find_bodies(each, KINECT, Background(mode), Nearer()) for each in (broken, image))
    assert len(found) == len(expected) == 1
    np.testing.assert_array_equal(found[0].pixels, expected[0].pixels)


@pytest.mark.parametrize("background", [Background("frame"), Background("limits", 1, 30)])
def test_far_ranges_count_where_the_background_asks_for_them(background: Background) -> None:
    far = np.full((KINECT.rows, KINECT.columns), np.float32(20.0))
    ((pixels, _),) = find_bodies(far, KINECT, background)
    assert len(pixels) == far.size


def test_odds_of_cells_follow_the_surfaces_that_pixels_are_of() -> None:
    odds = np.where(np.arange(10) < 5, 4.0, -4.0).astype(np.float32)[None].repeat(6, axis=0)
    range_m = np.where(np.arange(40) < 22, 2.0, 3.0).astype(np.float32)[None].repeat(24, axis=0)  # half a cell beyond
    range_m[:, 3] = 0
    agreed, found = np.zeros(odds.shape, np.bool_), np.zeros_like(range_m)
    spread_odds(odds, agreed, range_m, 4, found)
    np.testing.assert_array_equal(found > 0.5, range_m == 2)
    spread_odds(odds, ~agreed, range_m, 4, found)
    np.testing.assert_array_equal(found > 0.5, (range_m > 0) & (np.arange(40) < 20))


def test_odds_are_those_of_a_plain_mean_by_distance_in_image_and_range() -> None:
    draws = np.random.default_rng(5)
    odds, agreed = draws.normal(0, 3, (6, 9)).astype(np.float32), draws.random((6, 9)) < 0.2
    range_m = (draws.choice([0, 0.7, 2.0, 3.0], (22, 35)) * draws.uniform(1, 1.04, (22, 35))).astype(np.float32)
    found, expected = np.zeros_like(range_m), np.zeros(range_m.shape)
    spread_odds(odds, agreed, range_m, 4, found)
    centres = range_m[np.ix_(np.minimum(4 * np.arange(6) + 2, 21), np.minimum(4 * np.arange(9) + 2, 34))]
    for row, column in np.argwhere(range_m > 0):
        z, (i, j) = float(range_m[row, column]), (row // 4, column // 4)
        k, m = np.mgrid[max(i - AROUND, 0) : min(i + AROUND + 1, 6), max(j - AROUND, 0) : min(j + AROUND + 1, 9)]
        apart = ((row + 0.5) / 4 - 0.5 - k) ** 2 + ((column + 0.5) / 4 - 0.5 - m) ** 2
        near = np.maximum(1 - ((centres[k, m] - z) / (0.05 * max(z, 1))) ** 2, 0) ** 2
        weights = np.exp(-apart / 1.5**2 / 2) * near
        mean = odds[i, j] if agreed[i, j] or not weights.any() else np.average(odds[k, m], weights=weights)
        expected[row, column] = 1 / (1 + np.exp(-mean))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_a_pixel_takes_the_value_of_the_nearest_range_around_its_sample() -> None:
    draws = np.random.default_rng(6)
    seen, values = draws.uniform(1, 1.5, (5, 6)).astype(np.float32), np.arange(1, 31, dtype=np.int16).reshape(5, 6)
    range_m = draws.uniform(0.9, 1.6, (12, 13)).astype(np.float32)
    rows, columns = draws.integers(0, 5, 12), draws.integers(0, 6, 13)
    found, jump = np.zeros(range_m.shape, np.int16), np.array([0.06, 0.055], np.float32)
    take_nearest(range_m, jump, rows, columns, seen, values, found)
    for (row, column), z in np.ndenumerate(range_m):
        own, limit = (rows[row], columns[column]), max(0.06, 0.055 * z)
        around = itertools.product(range(max(own[0] - 1, 0), own[0] + 2), range(max(own[1] - 1, 0), own[1] + 2))
        inside = [place for place in around if place[0] < 5 and place[1] < 6]
        best = own if abs(seen[own] - z) <= limit else min(inside, key=lambda place: abs(seen[place] - z))
        assert found[row, column] == (values[best] if abs(seen[best] - z) <= limit else 0)


def test_a_pixel_takes_the_value_of_a_sample_of_its_own_surface() -> None:
    range_m = np.array([[1.0, 1.05, 3.0], [0.0, 3.2, 9.0]], np.float32)
    seen, values = np.array([[1.0, 3.0, 3.1]], np.float32), np.array([[5, 6, 7]], np.int16)
    found, jump = np.full(range_m.shape, -1, np.int16), np.array([0.1, 0.04], np.float32)
    take_nearest(range_m, jump, np.zeros(2, np.intp), np.array([0, 1, 0]), seen, values, found)
    np.testing.assert_array_equal(found, [[5, 5, 6], [-1, 7, -1]])


class Spotted(Nearer):
    """Rather sure of people, and at few places very sure of nobody."""

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        odds = torch.full(range_m.shape[2:], 0.2)
        odds[10::15, 7::15] = -90
        return torch.stack([odds, torch.zeros_like(odds)])[None]


def test_cells_that_agree_with_all_around_need_no_mean() -> None:
    range_m = np.full((KINECT.rows, KINECT.columns), 2.0, np.float32)
    found, plain = FinderView(Spotted(focal_px=262.5), KINECT)(range_m), np.zeros_like(range_m)
    odds = np.full(range_m.shape, 0.2, np.float32)
    odds[10::15, 7::15] = -90
    spread_odds(odds, np.zeros(odds.shape, np.bool_), range_m, 1, plain)
    np.testing.assert_array_equal(found > 0.5, plain > 0.5)


class Doubtful(Nearer):
    """Sure of what is on the left, and of everything else that it is rather nobody."""

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        odds = torch.where(torch.arange(range_m.shape[3]) < 20, 4.0, -1.0).expand(range_m.shape[2:])
        return torch.stack([odds, torch.zeros_like(odds)])[None]


def test_what_is_doubtful_is_somebody_beside_those_who_are_sure() -> None:
    probability = FinderView(Doubtful(focal_px=262.5), KINECT)(np.full((KINECT.rows, KINECT.columns), 2.0, np.float32))
    assert (probability[:, :21] > 0.5).all() and (probability[:, 25:] < 0.5).all()
