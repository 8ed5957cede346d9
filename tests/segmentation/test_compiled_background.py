"""The background's compiled loops, beside plain forms: the same surfaces, planes and bodies."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from plain_loops import plain_best_candidate, plain_near_plane

from bodyseg_data.rigs import Camera
from bodyseg_model.segmentation import Background, find_bodies, surfaces
from bodyseg_model.segmentation import surfaces as room_planes
from bodyseg_model.segmentation.surfaces import Surfaces, on_largest_plane

LENS = Camera(120, 160, 131.0, (81.0, 57.5), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def room(seed: int) -> NDArray[np.float32]:
    """A noisy, holey frame of a floor, a wall and some upright cylinders, metres."""
    draws = np.random.default_rng(seed)
    rays = LENS.pixel_rays()
    with np.errstate(divide="ignore"):
        floor = np.where(rays[..., 1] > 0, 1.1 / rays[..., 1], np.inf)
    seen = np.minimum(floor, 3.8 / (1 + 0.2 * rays[..., 0]))
    for _ in range(4):
        x, z, width = draws.uniform(-1.2, 1.2), draws.uniform(1.2, 3.2), draws.uniform(0.05, 0.3)
        across = (rays[..., 0] * z - x) / width
        inside = (np.abs(across) < 1) & (rays[..., 1] * z < 1.1) & (rays[..., 1] * z > -0.6)
        bulge = z - width * np.sqrt(np.maximum(1 - across**2, 0))
        seen = np.where(inside & (bulge < seen), bulge, seen)
    noisy = seen + draws.normal(0, 0.002, seen.shape) * seen**2
    return np.where(draws.random(seen.shape) < 0.05, 0, noisy).astype(np.float32)


@settings(max_examples=40)
@given(
    st.integers(6, 40),
    st.integers(1, 20),
    st.integers(2, 5),
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.05, 0.3, 1.0]),
    st.sampled_from([0.05, 0.5, 0.8]),
)
def test_rows_that_threads_share_give_the_same_surfaces(
    rows: int, columns: int, threads: int, seed: int, spread: float, missing: float
) -> None:
    draws = np.random.default_rng(seed)
    shape = rows, columns
    image = np.where(draws.random(shape) < missing, 0, 2.45 + spread * draws.normal(0, 0.3, shape)).astype(np.float32)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surfaces, "_LEAST_PIXELS", 1)
        (one, count), (other, others) = (
            surfaces.find_segments(image, surfaces.jumps(image), 80.0, many) for many in (1, threads)
        )
    assert count == others
    np.testing.assert_array_equal(one.segments, other.segments)
    np.testing.assert_array_equal(one.area_m2, other.area_m2)


@pytest.mark.parametrize("seed", range(3))
def test_bodies_do_not_depend_on_the_number_of_threads(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surfaces, "_LEAST_PIXELS", 1000)
    one, three = (find_bodies(room(seed), LENS, Background(), threads) for threads in (1, 3))
    assert len(one) == len(three) > 0
    for body, other in zip(one, three, strict=True):
        np.testing.assert_array_equal(body, other)


@pytest.mark.parametrize("seed", range(3))
def test_a_table_measures_its_surfaces_also_after_a_removal(seed: int) -> None:
    image = room(seed)
    table, focal_px, (across, down) = Surfaces(image, LENS), LENS.focal_px, LENS.centre_px
    for _ in range(2):
        boxes, large = table.bounding_boxes(), table.by_size(0.05)
        assert large == sorted(large, key=lambda number: -table.area_m2[number]) and len(large) > 1
        for number in large:
            pixels = table.pixels_of(number)
            assert (np.diff(pixels) > 0).all()
            (rows, columns), z = np.divmod(pixels, LENS.columns), image.ravel()[pixels].astype(np.float64)
            assert table.area_m2[number] == pytest.approx(np.square(z / focal_px).sum())
            axes = (columns + 0.5 - across) * z / focal_px, (rows + 0.5 - down) * z / focal_px, z
            assert table.extents_m(number) == pytest.approx([np.ptp(axis) for axis in axes])
            for corners, reduce in zip(boxes, (np.min, np.max), strict=True):
                assert corners[:, number].tolist() == [reduce(axis) for axis in (rows, columns, z)]
        every = np.concatenate([table.pixels_of(number) for number in range(len(table.area_m2))])
        np.testing.assert_array_equal(np.sort(every), np.flatnonzero(image))
        pixels = table.pixels_of(large[0])
        gone = np.arange(len(pixels)) % 7 > 2
        table.remove([pixels], [gone])
        assert not image.ravel()[pixels[gone]].any() and image.ravel()[pixels[~gone]].all()


@pytest.mark.parametrize("seed", range(3))
def test_planes_are_those_of_plain_forms(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    image = room(seed)
    found = on_largest_plane(image, np.flatnonzero(image), LENS)
    monkeypatch.setattr(room_planes, "_best_candidate", plain_best_candidate)
    monkeypatch.setattr(room_planes, "_near_plane", plain_near_plane)
    np.testing.assert_array_equal(found, on_largest_plane(image, np.flatnonzero(image), LENS))
    assert 0.2 < found.mean() < 0.9


def test_limits_belong_to_what_is_kept() -> None:
    near, far = np.float32(0.7), np.float32(3.3)  # neither is the number of 64 bits that is written so
    image = np.zeros((LENS.rows, LENS.columns), np.float32)
    image[20:80, 30:60], image[20:80, 70:100] = near, far
    image[20:80, 60:63], image[20:80, 100:103] = np.nextafter(near, np.float32(0)), np.nextafter(far, np.float32(9))
    (found,) = find_bodies(image, LENS, Background("limits", 0.7, 3.3))
    np.testing.assert_array_equal(found, np.flatnonzero((image == near) | (image == far)))


def test_an_empty_frame_has_no_surfaces() -> None:
    table = Surfaces(np.zeros((4, 5), np.float32), LENS)
    assert len(table.area_m2) == 0 and table.bounding_boxes()[0].shape == (3, 0)
