"""The background's compiled loops, beside their NumPy forms: the same bits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_forms import by_both, computed_by
from numpy.typing import NDArray

from bodyseg_data.core.rig import Camera
from bodyseg_model.segmentation.foreground import Background, find_bodies
from bodyseg_model.segmentation.people import surfaces
from bodyseg_model.segmentation.people.room_planes import on_largest_plane
from bodyseg_model.segmentation.people.surface_table import Surfaces
from bodyseg_model.segmentation.people.surfaces import connected_surfaces

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


@settings(max_examples=25)
@given(
    st.tuples(st.integers(1, 9), st.integers(1, 30)),
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.05, 0.3, 1.0]),
    st.sampled_from([0.05, 0.4, 0.8]),
    st.sampled_from([1.0, 111.0]),
)
def test_surfaces_are_the_same(
    shape: tuple[int, int], seed: int, spread: float, missing: float, focal_px: float
) -> None:
    draws = np.random.default_rng(seed)
    ranges = np.where(draws.random(shape) < missing, 0, 2.45 + spread * draws.normal(0, 0.3, shape))
    image = np.maximum(ranges, 0).astype(np.float32)
    np.testing.assert_array_equal(*by_both(lambda: connected_surfaces(image, focal_px)))


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
    pytest.importorskip("numba")
    draws = np.random.default_rng(seed)
    shape = rows, columns
    image = np.where(draws.random(shape) < missing, 0, 2.45 + spread * draws.normal(0, 0.3, shape)).astype(np.float32)
    with computed_by("compiled"), pytest.MonkeyPatch.context() as patch:
        patch.setattr(surfaces, "_LEAST_PIXELS", 1)
        found = [surfaces.find_segments(image, surfaces.jumps(image), 80.0, many) for many in (1, threads)]
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("seed", range(3))
def test_bodies_do_not_depend_on_the_number_of_threads(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surfaces, "_LEAST_PIXELS", 1000)
    one, three = (find_bodies(room(seed), LENS, Background(), threads) for threads in (1, 3))
    assert len(one) == len(three) > 0
    for body, other in zip(one, three, strict=True):
        np.testing.assert_array_equal(body, other)


@pytest.mark.parametrize("seed", range(3))
def test_tables_of_surfaces_are_the_same_also_after_a_removal(seed: int) -> None:
    def table() -> list[Any]:
        table = Surfaces(room(seed), LENS)
        found: list[Any] = []
        for _ in range(2):
            boxes, large = table.bounding_boxes(), table.by_size(0.05)
            pixels = [table.pixels_of(number) for number in large]
            extents = [table.extents_m(number) for number in large]
            found += [table.area_m2, boxes.lowest, boxes.highest, np.array(large), np.array(extents), *pixels]
            table.remove(pixels[:1], [np.arange(len(pixels[0])) % 7 > 2])
        return found

    compiled, plain = by_both(table)
    assert len(compiled) == len(plain) > 12
    for one, other in zip(compiled, plain, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("seed", range(3))
def test_planes_are_the_same(seed: int) -> None:
    image = room(seed)
    compiled, plain = by_both(lambda: on_largest_plane(image, np.flatnonzero(image), LENS))
    np.testing.assert_array_equal(compiled, plain)
    assert 0.2 < compiled.mean() < 0.9


@pytest.mark.parametrize("seed", range(4))
def test_bodies_are_the_same(seed: int) -> None:
    compiled, plain = by_both(lambda: find_bodies(room(seed), LENS, Background()))
    assert len(compiled) == len(plain) > 0
    for one, other in zip(compiled, plain, strict=True):
        np.testing.assert_array_equal(one, other)


def test_limits_are_the_same_and_belong_to_what_is_kept() -> None:
    near, far = np.float32(0.7), np.float32(3.3)  # neither is the number of 64 bits that is written so
    image = np.zeros((LENS.rows, LENS.columns), np.float32)
    image[20:80, 30:60], image[20:80, 70:100] = near, far
    image[20:80, 60:63], image[20:80, 100:103] = np.nextafter(near, np.float32(0)), np.nextafter(far, np.float32(9))
    compiled, plain = by_both(lambda: find_bodies(image, LENS, Background("limits", 0.7, 3.3)))
    expected = np.flatnonzero((image == near) | (image == far))
    for (found,) in (compiled, plain):
        np.testing.assert_array_equal(found, expected)


def test_an_empty_frame_has_no_surfaces() -> None:
    def empty() -> tuple[int, tuple[int, ...], str]:
        table = Surfaces(np.zeros((4, 5), np.float32), LENS)
        return len(table.area_m2), table.bounding_boxes().lowest.shape, repr(table)

    assert by_both(empty) == ((0, (3, 0), "Surfaces(0 of 4 x 5 pixels)"),) * 2
