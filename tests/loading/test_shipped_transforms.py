"""The transforms that ship: what they do to pixels, ranges, labels and the camera."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_images import camera_image

from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND, PARTS, UNLABELLED
from bodyseg_data.loading import (
    BodyCrop,
    CameraImage,
    Crop,
    Flip,
    RangeImages,
    Remnants,
    Roll,
    Transform,
    Zoom,
    transforms,
)
from bodyseg_data.loading.transforms import _around, _spread, magnified, turned

ALL: tuple[Transform, ...] = (
    Crop(30, 20), Crop(80, 70, "body"), Crop(70, 20, "anywhere"), BodyCrop(48, 32), Flip(), Roll(180), Zoom(2.0),
)  # fmt: skip


def drawn(seed: int = 0) -> np.random.Generator:
    return np.random.Generator(np.random.Philox(seed))


def same(a: CameraImage, b: CameraImage) -> bool:
    return np.array_equal(a.range, b.range) and np.array_equal(a.labels, b.labels) and a.centre_px == b.centre_px


@pytest.mark.parametrize("transform", ALL, ids=repr)
def test_every_transform_keeps_the_rules_of_samples(transform: Transform) -> None:
    for seed in range(20):
        before = camera_image(seed=seed)
        kept = replace(before, range=before.range.copy(), labels=before.labels.copy())
        found = transform(kept, drawn(seed))
        assert found.key == before.key and found.info == before.info
        assert found.range.shape == found.labels.shape == transform.shape(60, 40)
        assert found.range.dtype == np.uint16 and found.labels.dtype == np.uint8
        assert np.array_equal(found.labels == BACKGROUND, found.range == 0)
        assert same(found, transform(replace(before), drawn(seed))), "the draws are the generator's"
        assert np.isin(found.range, before.range).all(), "no range lies between two surfaces"


@pytest.mark.parametrize("transform", [*ALL, Remnants(1.0)], ids=repr)
def test_every_transform_takes_an_image_of_nothing(transform: Transform) -> None:
    empty = camera_image()
    empty = replace(empty, range=np.zeros_like(empty.range), labels=np.full_like(empty.labels, BACKGROUND))
    found = transform(empty, drawn())
    assert found.range.shape == transform.shape(60, 40)
    assert not found.range.any() and (found.labels == BACKGROUND).all()


def test_a_flip_exchanges_left_and_right_and_is_its_own_inverse() -> None:
    image = camera_image(centre=(17.25, 30.0))
    found = Flip(1.0)(image, drawn())
    assert np.array_equal(found.range, image.range[:, ::-1])
    assert found.centre_px == (40 - 17.25, 30.0)
    for row, column in np.argwhere(image.labels != BACKGROUND):
        part = PARTS[image.labels[row, column]]
        assert found.labels[row, 39 - column] == part.mirror
        assert (part.side == "middle") == (part.mirror == part.label)
    assert same(Flip(1.0)(found, drawn()), image)
    assert same(Flip(0.0)(image, drawn()), image)


def test_the_share_of_flips_is_that_asked_for() -> None:
    image, random = camera_image(), drawn()
    flipped = sum(not same(Flip(0.3)(image, random), image) for _ in range(1000))
    assert abs(flipped - 300) < 4 * math.sqrt(1000 * 0.3 * 0.7)


def test_a_roll_turns_the_body_against_the_camera() -> None:
    image = camera_image(centre=(20.0, 30.0))
    alone = replace(image, range=np.zeros_like(image.range), labels=np.full_like(image.labels, BACKGROUND))
    alone.range[30, 35], alone.labels[30, 35] = 25_000, 4  # to the right of the axis
    up = turned(alone, 90.0)  # the camera clockwise: what it sees counterclockwise
    assert np.argwhere(up.range).tolist() == [[14, 20]]
    assert up.range[14, 20] == 25_000 and up.labels[14, 20] == 4
    assert same(turned(image, 180.0), replace(image, range=image.range[::-1, ::-1], labels=image.labels[::-1, ::-1]))
    assert same(turned(image, 0.0), image)


def test_a_roll_agrees_with_a_plain_loop_over_pixels() -> None:
    image = camera_image(centre=(18.3, 31.7))
    cos, sin = math.cos(math.radians(23)), math.sin(math.radians(23))
    found, (x, y) = turned(image, 23.0), image.centre_px
    for row in range(60):
        for column in range(40):
            across, below = column + 0.5 - x, row + 0.5 - y
            source = math.floor(sin * across + cos * below + y), math.floor(cos * across - sin * below + x)
            inside = 0 <= source[0] < 60 and 0 <= source[1] < 40
            assert found.range[row, column] == (image.range[source] if inside else 0)
            assert found.labels[row, column] == (image.labels[source] if inside else BACKGROUND)


def test_rolls_are_spread_evenly_up_to_the_largest() -> None:
    image, random = camera_image(), drawn()
    image = replace(image, range=np.zeros_like(image.range), labels=np.full_like(image.labels, BACKGROUND))
    image.range[5, 20], image.labels[5, 20] = 25_000, 0  # 24.5 pixels above the axis
    columns = [np.argwhere(Roll(30)(image, random).range)[:, 1] for _ in range(500)]
    angles = [math.degrees(math.asin((20 - found.mean()) / 24.5)) for found in columns if len(found)]
    assert -32 < min(angles) < -25 and 25 < max(angles) < 32
    assert abs(np.mean(angles)) < 4 * 30 / math.sqrt(3 * len(angles)) + 1.2  # 1.2: half a pixel


def test_a_zoom_of_the_lens_leaves_ranges_and_grows_pixels() -> None:
    image = camera_image(centre=(20.0, 30.0))
    found = magnified(image, 2.0)
    assert found.focal_px == 2 * image.focal_px
    assert np.array_equal(found.range[::2, ::2], image.range[15:45, 10:30])
    assert np.array_equal(found.range[1::2, 1::2], image.range[15:45, 10:30])
    assert same(magnified(image, 1.0), image)
    smaller = magnified(image, 0.5)
    assert np.count_nonzero(smaller.range[:15]) == np.count_nonzero(smaller.range[:, :10]) == 0
    assert np.count_nonzero(smaller.range) > 0


def test_magnifications_are_spread_evenly_both_ways() -> None:
    image, random = camera_image(), drawn()
    logarithms = [math.log(Zoom(2.0)(image, random).focal_px / image.focal_px, 2) for _ in range(1000)]
    assert -1 <= min(logarithms) < -0.98 and 0.98 < max(logarithms) <= 1
    assert abs(np.mean(logarithms)) < 4 / math.sqrt(3 * 1000)


def test_crops_are_windows_at_their_place() -> None:
    image = camera_image(centre=(25.0, 20.0))  # the body: rows 15 to 44, columns 8 to 27
    at_axis = Crop(20, 10)(image, drawn())
    assert np.array_equal(at_axis.range, image.range[10:30, 20:30])
    assert at_axis.centre_px == (5.0, 10.0)
    at_body = Crop(30, 20, "body")(image, drawn())
    assert np.array_equal(at_body.range, image.range[15:45, 8:28])
    assert at_body.centre_px == (17.0, 5.0)
    larger = Crop(70, 50)(image, drawn())
    assert np.count_nonzero(larger.range) == np.count_nonzero(image.range)
    assert np.array_equal(larger.range[15:75, :40], image.range[:55, :])


def test_crops_anywhere_take_every_place() -> None:
    image, random = camera_image(centre=(0.0, 0.0)), drawn()
    places = {Crop(58, 43, "anywhere")(image, random).centre_px for _ in range(300)}
    assert places == {(float(x), float(-y)) for x in range(4) for y in range(3)}


def test_a_crop_to_the_body_holds_it_with_its_margin() -> None:
    image = camera_image()
    top, bottom, left, right = image.body_box or (0, 0, 0, 0)
    found = BodyCrop(60, 60, margin=0.0)(image, drawn())
    scale = 60 / (bottom - top)
    assert found.focal_px == image.focal_px * scale
    assert found.body_box is not None and found.body_box[:2] == (0, 60)
    around = BodyCrop(60, 60, margin=0.5)(image, drawn())
    assert around.body_box is not None
    first, end, start, stop = around.body_box
    assert (first, end) == (15, 45) and abs((start + stop) / 2 - 30) <= 1
    # The axis keeps its place beside the body.
    beside = (around.centre_px[0] - 30) / (scale / 2)
    assert beside == pytest.approx(image.centre_px[0] - (left + right) / 2)
    assert set(np.unique(around.labels)) <= set(np.unique(image.labels))


def body_before_a_wall(seed: int, lost: float = 0.0, noise_steps: float = 0.0) -> tuple[CameraImage, CameraImage]:
    """A disk 2.5 m away, 0.1 m in radius, as it is and with remnants of a wall 0.2 to 0.3 m behind."""
    image, random = camera_image(240, 200), np.random.default_rng(seed)
    down, across = np.mgrid[:240, :200]
    disk = np.hypot(down - 120, across - 100) < 0.1 * 500 / 2.5
    ranges = np.rint(25_000 + noise_steps * random.standard_normal(disk.shape)) * (random.random(disk.shape) >= lost)
    ranges = np.where(disk, ranges, 0).astype(np.uint16)
    image = replace(image, range=ranges, labels=np.where(ranges > 0, 4, BACKGROUND).astype(np.uint8))
    copy = replace(image, range=ranges.copy(), labels=image.labels.copy())
    return image, Remnants(1.0, nearest_m=0.2, farthest_m=0.3)(copy, drawn(seed))


def test_remnants_lie_beside_the_body_behind_its_outline_without_labels() -> None:
    wide = []
    for seed in range(20):
        image, found = body_before_a_wall(seed)
        body, added = image.range > 0, (found.range > 0) & (image.range == 0)
        assert np.array_equal(found.range[body], image.range[body]) and np.array_equal(found.labels, image.labels)
        down, across = np.nonzero(added)
        away_m = (np.hypot(down - 120, across - 100) - 20) * 2.5 / 500
        behind_m = (found.range[added].astype(float) - 25_000) * 1e-4
        assert (behind_m >= 0).all() and (away_m < 0.25 * 1.3).all()
        flat = behind_m[away_m > 0.08]
        assert ((flat > 0.2 - 0.15) & (flat < 0.3 + 0.15)).all(), "a plane, tilted, about the wall"
        wide.append(away_m.max(initial=0.0))
    assert max(wide) > 0.15 and min(wide) < 0.1, "of every width"


def test_remnants_are_surfaces_without_a_class_where_these_have_a_label(figures_set: Path) -> None:
    plain = RangeImages(figures_set, "none", transform=Remnants(1.0))
    told = RangeImages(figures_set, "none", transform=(Remnants(1.0), Flip(0.0)), unlabelled=True)
    people = RangeImages(figures_set, "none", transform=Remnants(1.0), labels="people")
    assert people.label_map.names == ("person", "none")
    added = 0
    for index in range(6):
        before, image, with_rest = (images.image(index) for images in (plain, told, people))
        remnants = (before.labels == BACKGROUND) & (before.range > 0)
        added += np.count_nonzero(remnants)
        assert np.array_equal(image.labels == BACKGROUND, image.range == 0)
        assert np.array_equal(image.labels, np.where(remnants, UNLABELLED, before.labels))
        assert (with_rest.labels[remnants] == 1).all() and (with_rest.labels[before.labels < 33] == 0).all()
    assert added > 100


def test_remnants_have_the_noise_of_the_body_and_lose_as_much() -> None:
    _, plain = body_before_a_wall(3)
    _, found = body_before_a_wall(3, lost=0.5, noise_steps=100)
    every = (plain.range > 0) & (plain.labels == BACKGROUND)
    kept = every & (found.range > 0)
    assert 0.4 < np.count_nonzero(kept) / np.count_nonzero(every) < 0.6
    off = found.range[kept].astype(float) - plain.range[kept]
    assert off.std() == pytest.approx(100, rel=0.15) and abs(off.mean()) < 20


def test_remnants_look_no_further_where_every_cell_knows_its_nearest(monkeypatch: pytest.MonkeyPatch) -> None:
    rings: list[bool] = []

    def counted(cells: Any, value: float, corners: bool) -> Any:
        rings.append(corners)
        return _around(cells, value, corners)

    random = np.random.default_rng(0)
    monkeypatch.setattr(transforms, "_around", counted)
    for shape in ((7, 9), (1, 6), (5, 5)):
        own = np.where(random.random(shape) < 0.1, random.integers(1, 9, shape), np.inf)
        own[0, 0] = 3.0
        rings.clear()
        ranges, away = _spread(own, 300)
        assert len(rings) == away.max() + 1 and (ranges > 0).all()
        assert np.array_equal(ranges, _spread(own, int(away.max()))[0])
    assert (_spread(np.full((2, 2), np.inf), 300)[1] == 301).all()


def test_the_share_of_images_with_remnants_is_that_asked_for() -> None:
    (image, _), random, altered = body_before_a_wall(0), drawn(), 0
    for _ in range(300):
        copy = replace(image, range=image.range.copy())
        altered += not np.array_equal(Remnants(0.3)(copy, random).range, image.range)
    assert 30 < altered <= 90 + 4 * math.sqrt(300 * 0.3 * 0.7), "some images draw remnants nowhere"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: Remnants(nearest_m=2.0),
            "Remnants: nearest_m must be at most farthest_m, found 2.0 and 0.8",
        ),
        (lambda: Flip(1.5), "Flip: share must be from 0 to 1, found 1.5"),
        (lambda: Flip(True), "Flip: share must be a number, found True"),
        (lambda: Roll(-1), "Roll: largest_deg must be from 0 to 180, found -1"),
        (lambda: Roll(float("nan")), "Roll: largest_deg must be from 0 to 180, found nan"),
        (lambda: Zoom(0.5), "Zoom: largest must be from 1 to 4, found 0.5"),
        (lambda: Crop(0, 5), "Crop: rows must be from 1 to 8192, found 0"),
        (lambda: Crop(5, 9000), "Crop: columns must be from 1 to 8192, found 9000"),
        (lambda: Crop(5, 5, "head"), "Crop: at must be 'axis' or 'body' or 'anywhere', found 'head'"),
        (lambda: BodyCrop(5, 5, "wide"), "BodyCrop: margin must be a number, found 'wide'"),
    ],
)
def test_parameters_out_of_range_are_refused(make: Any, message: str) -> None:
    with pytest.raises(BadConfig) as caught:
        make()
    assert str(caught.value) == message
