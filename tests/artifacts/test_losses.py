"""Pixels lost together: exact shares, shapes that hang together, and angles against those of planes and a ball."""

from __future__ import annotations

from collections import Counter
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import label, regionprops

from bodyseg_data.artifacts import SHAPES, Losses, lost, slants
from bodyseg_data.artifacts.lost_pixels import (
    LONGEST,
    MOST_PATCHES,
    MOST_STRIPES,
    lost_grazing,
    lost_patches,
    lost_stripes,
)
from bodyseg_data.core import BadConfig, generator
from bodyseg_data.rigs import Camera

CAMERA = Camera(120, 90, 140.0, (47.3, 55.9), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
WHOLE = slice(None), slice(None)


def draws(key: str = "k") -> np.random.Generator:
    return generator(0, 0, key, "losses")


def lose(kind: str, image: NDArray[np.uint16], share: float, key: str = "k") -> NDArray[np.bool_]:
    if kind == "grazing":
        return lost_grazing(image, share, CAMERA)
    return {"patches": lost_patches, "stripes": lost_stripes}[kind](image, share, draws(key))


def ball(radius_m: float = 0.6, middle_m: float = 2.5) -> tuple[NDArray[np.uint16], NDArray[np.float64]]:
    """A ball straight ahead, in steps, and the cosine of the angle between each pixel's ray and the surface."""
    rays = CAMERA.pixel_rays()
    squared = (rays**2).sum(axis=2)
    inside = middle_m**2 - squared * (middle_m**2 - radius_m**2)
    z = np.where(inside > 0, (middle_m - np.sqrt(np.maximum(inside, 0))) / squared, 0)
    normals = (rays * z[..., None] - (0, 0, middle_m)) / radius_m
    cosines = -(normals * rays).sum(axis=2) / np.sqrt(squared)
    return np.rint(z / 1e-4).astype(np.uint16), cosines


def body() -> NDArray[np.uint16]:
    """A ball with a block before its lower half, so that there are an edge, a hole and a row of their own."""
    image, _ = ball()
    image[70:95, 30:50] = 17_000
    image[50:53, 40:44] = 0
    image[0, 3] = 30_000
    return image


@pytest.mark.parametrize("kind", ["patches", "stripes", "grazing"])
@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 1 / 3, 0.5, 0.999, 1.0])
def test_the_share_is_exact_and_of_the_foreground(kind: str, share: float) -> None:
    image = body()
    lost = lose(kind, image, share)
    assert lost.dtype == np.bool_ and lost.shape == image.shape
    assert not lost[image == 0].any()
    assert abs(np.count_nonzero(lost) - share * np.count_nonzero(image)) <= 0.5


@pytest.mark.parametrize("kind", ["patches", "stripes", "grazing"])
def test_more_is_the_same_and_more(kind: str) -> None:
    image = body()
    masks = [lose(kind, image, share) for share in (0.05, 0.1, 0.3, 0.7)]
    for fewer, more in pairwise(masks):
        assert (fewer <= more).all() and fewer.sum() < more.sum()


@pytest.mark.parametrize("kind", ["patches", "stripes"])
def test_draws_belong_to_the_generator(kind: str) -> None:
    image = body()
    before = image.copy()
    np.testing.assert_array_equal(lose(kind, image, 0.3), lose(kind, image, 0.3))
    np.testing.assert_array_equal(image, before)
    assert (lose(kind, image, 0.3, "a") != lose(kind, image, 0.3, "b")).any()


@pytest.mark.parametrize("kind", ["patches", "stripes", "grazing"])
def test_nothing_is_lost_of_nothing(kind: str) -> None:
    assert not lose(kind, np.zeros((120, 90), np.uint16), 0.5).any()


def test_patches_are_a_few_ellipses() -> None:
    image = np.full((200, 200), 25_000, np.uint16)
    counts = Counter[int]()
    for number in range(80):
        regions = regionprops(label(lose("patches", image, 0.04, f"{number}"), connectivity=1))
        counts[len(regions)] += 1
        assert 1 <= len(regions) <= MOST_PATCHES
        for region in regions if len(regions) == 1 else []:
            top, left, bottom, right = region.bbox
            if 0 not in (top, left) and 200 not in (bottom, right) and region.extent > 0.77:
                whole = "one whole ellipse: pi / 4 of its box"
                assert 1 / LONGEST - 0.1 <= (bottom - top) / (right - left) <= LONGEST + 0.2, whole
                assert region.extent == pytest.approx(np.pi / 4, abs=0.03)
    assert set(counts) == {1, 2, 3, 4}


def test_stripes_are_whole_rows_evenly_apart() -> None:
    image = np.zeros((240, 90), np.uint16)
    image[20:220, 10:80] = 25_000
    stripes = set()
    for number in range(60):
        lost = lose("stripes", image, 0.3, f"{number}")
        rows = lost[:, 10:80].sum(axis=1)
        assert np.count_nonzero((rows > 0) & (rows < 70)) <= 1, "at most one row is lost in part, from the left"
        starts = np.flatnonzero(np.diff((rows == 70).astype(int)) == 1)
        apart = np.diff(starts[1:])
        assert not len(apart) or apart.max() - apart.min() <= 2
        stripes.add(len(starts))
    assert stripes <= set(range(2, MOST_STRIPES + 2)) and {2, 6, 12} <= stripes, "one that is cut by the end makes two"


@pytest.mark.parametrize("normal", [(0, 0, -1), (0.8, 0, -0.6), (-0.3, 0.6, -0.4), (0.2, -0.9, -0.3)])
def test_slants_of_a_plane_are_those_of_its_normal(normal: tuple[float, float, float]) -> None:
    rays = CAMERA.pixel_rays()
    towards = np.maximum(-(rays @ np.asarray(normal)), 1e-9)
    z = 2.0 * -normal[2] / towards
    image = np.where(z < 6, np.rint(np.minimum(z, 6) / 1e-4), 0).astype(np.uint16)
    cosines = towards / np.linalg.norm(rays, axis=2) / np.linalg.norm(normal)
    found = slants(image, CAMERA, WHOLE)
    inside = ndimage.binary_erosion(image > 0) & (cosines > 0.15)
    assert inside.sum() > 3000
    np.testing.assert_allclose(found[inside] ** -0.5, cosines[inside], rtol=0.05)


def test_the_most_grazing_are_lost_first() -> None:
    image, cosines = ball()
    foreground = image > 0
    lost = lost_grazing(image, 0.3, CAMERA)
    exact = foreground & (cosines <= np.quantile(cosines[foreground], 0.3))
    assert np.count_nonzero(lost != exact) < 0.04 * np.count_nonzero(exact)


def test_an_edge_in_front_of_something_is_no_wall() -> None:
    image = np.full((120, 90), 25_000, np.uint16)
    image[40:80, 30:60] = 20_000
    cosines = 1 / np.linalg.norm(CAMERA.pixel_rays(), axis=2)
    np.testing.assert_allclose(slants(image, CAMERA, WHOLE) ** -0.5, cosines, rtol=1e-5)


def test_a_sliver_without_neighbours_is_lost_before_all() -> None:
    image, _ = ball()
    image[2, 2] = 25_000
    assert lost_grazing(image, 0.01, CAMERA)[2, 2]


@pytest.mark.parametrize("most", [0.0, 0.4])
def test_training_draws_kinds_and_shares_evenly(most: float) -> None:
    image = body()
    pixels = np.count_nonzero(image)
    losses = Losses(most)
    shares = []
    for number in range(200):
        lost = losses.lost(image, CAMERA, draws(f"{number}"))
        assert not lost[image == 0].any()
        shares.append(np.count_nonzero(lost) / pixels)
    assert max(shares) <= most + 1 / pixels
    if most:
        drawn = np.sort([share for share in shares if share])
        assert 120 < len(drawn) < 180, "one kind of four loses nothing"
        assert np.abs(drawn / most - (np.arange(len(drawn)) + 0.5) / len(drawn)).max() < 0.15


def test_training_draws_every_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    from bodyseg_data.artifacts import lost_pixels as losses

    asked = Counter[str]()

    def note(kind: str, image: NDArray[np.uint16], *others: Any) -> NDArray[np.bool_]:
        asked[kind] += 1
        return np.zeros(image.shape, np.bool_)

    for kind in SHAPES:
        monkeypatch.setattr(losses, f"lost_{kind}", partial(note, kind))
    image = body()
    for number in range(400):
        assert not Losses(0.5).lost(image, CAMERA, draws(f"{number}")).any()
    assert set(asked) == set(SHAPES)
    assert all(60 < count < 140 for count in asked.values())


@pytest.mark.parametrize("share", [-0.1, 1.5, float("nan")])
def test_shares_are_from_0_to_1(share: float) -> None:
    for kind in ("patches", "stripes", "grazing"):
        with pytest.raises(BadConfig, match=f"the share of lost pixels must be from 0 to 1, found {share}"):
            lose(kind, body(), share)
    with pytest.raises(BadConfig, match=f"Losses: most must be from 0 to 1, found {share}"):
        Losses(share)


def test_every_shape_goes_by_its_name() -> None:
    image = body()
    for shape in SHAPES:
        expected = {
            "patches": lambda: lost_patches(image, 0.2, draws("k")),
            "stripes": lambda: lost_stripes(image, 0.2, draws("k")),
            "grazing": lambda: lost_grazing(image, 0.2, CAMERA),
        }[shape]()
        np.testing.assert_array_equal(lost(shape, image, 0.2, CAMERA, draws("k")), expected)
    with pytest.raises(BadConfig, match="pixels are lost in one of patches, stripes, grazing, found 'rings'"):
        lost("rings", image, 0.2, CAMERA, draws("k"))


def test_grazing_needs_the_image_of_its_camera() -> None:
    with pytest.raises(BadConfig, match="as large as its camera's, 120 x 90, found 90 x 120"):
        lost_grazing(body().T, 0.1, CAMERA)
