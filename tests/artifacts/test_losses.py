"""Pixels lost together: exact shares, and shapes that hang together."""

from __future__ import annotations

from collections import Counter
from functools import partial
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from skimage.measure import label, regionprops

from bodyseg_data.artifacts import SHAPES, Losses, RangeImage
from bodyseg_data.artifacts.lost_pixels import LONGEST, MOST_PATCHES, MOST_STRIPES
from bodyseg_data.core import BadConfig, Draws
from bodyseg_data.rigs import Camera

CAMERA = Camera(120, 90, 140.0, (47.3, 55.9), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def draws(key: str = "k") -> np.random.Generator:
    return Draws(0, 0, key).generator("losses")


def lose(kind: str, image: NDArray[np.uint16], share: float, key: str = "k") -> NDArray[np.bool_]:
    return SHAPES[kind](image, share, draws(key))


def lost_by(losses: Losses, image: NDArray[np.uint16], key: str) -> NDArray[np.bool_]:
    made = RangeImage(key, image.copy(), np.zeros(image.shape, np.uint8), {})
    scene: Any = SimpleNamespace(sample=SimpleNamespace(range=image))
    losses.apply(made, scene, Draws(0, 0, key))
    return np.asarray(made.range != image)


def body() -> NDArray[np.uint16]:
    """A ball with a block before its lower half, so that there are an edge, a hole and a row of their own."""
    rays = CAMERA.pixel_rays()
    squared = (rays**2).sum(axis=2)
    inside = 2.5**2 - squared * (2.5**2 - 0.6**2)
    z = np.where(inside > 0, (2.5 - np.sqrt(np.maximum(inside, 0))) / squared, 0)
    image = np.rint(z / 1e-4).astype(np.uint16)
    image[70:95, 30:50] = 17_000
    image[50:53, 40:44] = 0
    image[0, 3] = 30_000
    return image


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 1 / 3, 0.5, 0.999, 1.0])
def test_the_share_is_exact_and_of_the_foreground(kind: str, share: float) -> None:
    image = body()
    lost = lose(kind, image, share)
    assert lost.dtype == np.bool_ and lost.shape == image.shape
    assert not lost[image == 0].any()
    assert abs(np.count_nonzero(lost) - share * np.count_nonzero(image)) <= 0.5


@pytest.mark.parametrize("kind", SHAPES)
def test_more_is_the_same_and_more(kind: str) -> None:
    image = body()
    masks = [lose(kind, image, share) for share in (0.05, 0.1, 0.3, 0.7)]
    for fewer, more in pairwise(masks):
        assert (fewer <= more).all() and fewer.sum() < more.sum()


@pytest.mark.parametrize("kind", SHAPES)
def test_draws_belong_to_the_generator(kind: str) -> None:
    image = body()
    before = image.copy()
    np.testing.assert_array_equal(lose(kind, image, 0.3), lose(kind, image, 0.3))
    np.testing.assert_array_equal(image, before)
    assert (lose(kind, image, 0.3, "a") != lose(kind, image, 0.3, "b")).any()


@pytest.mark.parametrize("kind", SHAPES)
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


@pytest.mark.parametrize("most", [0.0, 0.4])
def test_training_draws_kinds_and_shares_evenly(most: float) -> None:
    image = body()
    pixels = np.count_nonzero(image)
    losses = Losses(most)
    shares = []
    for number in range(200):
        lost = lost_by(losses, image, f"{number}")
        assert not lost[image == 0].any()
        shares.append(np.count_nonzero(lost) / pixels)
    assert max(shares) <= most + 1 / pixels
    if most:
        drawn = np.sort([share for share in shares if share])
        assert 105 < len(drawn) < 160, "one kind of three loses nothing"
        assert np.abs(drawn / most - (np.arange(len(drawn)) + 0.5) / len(drawn)).max() < 0.15


def test_training_draws_every_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = Counter[str]()

    def note(kind: str, image: NDArray[np.uint16], *others: Any) -> NDArray[np.bool_]:
        asked[kind] += 1
        return np.zeros(image.shape, np.bool_)

    for kind in SHAPES:
        monkeypatch.setitem(SHAPES, kind, partial(note, kind))
    image = body()
    for number in range(300):
        assert not lost_by(Losses(0.5), image, f"{number}").any()
    assert set(asked) == set(SHAPES)
    assert all(60 < count < 140 for count in asked.values())


@pytest.mark.parametrize("share", [-0.1, 1.5, float("nan")])
def test_shares_are_from_0_to_1(share: float) -> None:
    with pytest.raises(BadConfig, match=f"Losses: most must be from 0 to 1, found {share}"):
        Losses(share)
