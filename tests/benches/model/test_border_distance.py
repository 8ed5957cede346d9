from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benches.model.border_distance import BIN_NAMES, EDGES, BorderErrors, distance_bins
from label_networks import Places
from scipy import ndimage
from skimage.segmentation import find_boundaries

from bodyseg_data.labels import BACKGROUND, PARTS33, LabelMap
from bodyseg_data.loading import RangeImages
from bodyseg_model.evaluation import evaluate, open_images


def by_transform(labels: np.ndarray) -> np.ndarray:
    """The exact distance, part by part, by SciPy's Euclidean distance transform."""
    bins = np.full(labels.shape, BACKGROUND, np.uint8)
    for part in set(labels.ravel().tolist()) - {BACKGROUND}:
        others = (labels != part) & (labels != BACKGROUND)
        away = ndimage.distance_transform_edt(~others) if others.any() else np.full(labels.shape, np.inf)
        bins[labels == part] = np.searchsorted(EDGES, away[labels == part])
    return bins


def random_labels(seed: int, rows: int, columns: int, parts: int) -> np.ndarray:
    """Patches of parts with holes and an outline of background."""
    generator = np.random.default_rng(seed)
    seeds = generator.random((parts, 2)) * (rows, columns)
    places = np.stack(np.mgrid[:rows, :columns], axis=-1)
    labels = np.argmin(((places[:, :, None] - seeds) ** 2).sum(-1), axis=-1).astype(np.uint8) * 2
    labels[generator.random(labels.shape) < 0.25] = BACKGROUND
    labels[ndimage.zoom(generator.random((5, 5)), (rows / 5, columns / 5), order=1) > 0.62] = BACKGROUND
    return labels


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(
    ("rows", "columns", "parts"), [(70, 90, 6), (150, 60, 3), (40, 3, 2), (3, 60, 2), (90, 90, 17)]
)
def test_bins_are_those_of_the_exact_distance(seed: int, rows: int, columns: int, parts: int) -> None:
    labels = random_labels(seed, rows, columns, parts)
    expected = by_transform(labels)
    found = distance_bins(labels)
    assert found.dtype == np.uint8
    assert np.array_equal(found, expected)


@pytest.mark.parametrize("seed", range(3))
def test_the_first_bin_is_a_boundary_of_scikit_image_where_there_is_no_background(seed: int) -> None:
    labels = np.random.default_rng(seed).integers(0, 4, (16, 12)).astype(np.uint8).repeat(5, axis=0).repeat(4, axis=1)
    boundary = find_boundaries(labels, connectivity=1, mode="thick")
    assert 0.2 < boundary.mean() < 0.8
    assert np.array_equal(distance_bins(labels) == 0, boundary)


def test_distances_by_hand() -> None:
    labels = np.full((1, 40), 5, np.uint8)
    labels[0, 0] = 6
    labels[0, 2] = BACKGROUND
    assert distance_bins(labels)[0].tolist() == [0, 0, BACKGROUND, 2, 2, *[3] * 4, *[4] * 8, *[5] * 23]
    corner = np.array([[3, BACKGROUND], [BACKGROUND, 32]], np.uint8)
    assert distance_bins(corner).tolist() == [[1, BACKGROUND], [BACKGROUND, 1]], "the square root of 2 is above 1"


def test_a_single_part_is_far_from_any_border_and_background_is_none() -> None:
    labels = np.full((20, 20), BACKGROUND, np.uint8)
    assert (distance_bins(labels) == BACKGROUND).all()
    labels[5:9, 5:9] = 0
    assert np.unique(distance_bins(labels)).tolist() == [len(EDGES), BACKGROUND]
    assert len(BIN_NAMES) == len(EDGES) + 1


def test_labels_at_both_ends_of_the_range_make_borders() -> None:
    labels = np.array([[0, 32, 0, 1]], np.uint8)
    assert distance_bins(labels).tolist() == [[0, 0, 0, 0]]


@pytest.mark.parametrize("variant", ["all", "none"])
def test_errors_are_counted_by_distance_in_the_clean_image(small_set: Path, variant: str) -> None:
    images, network = RangeImages(small_set, variant, "test"), Places(0, 20)
    errors = BorderErrors(images)
    confusion = evaluate(network, images, watch=errors.watch).total().confusion
    assert errors.counts[:, 0].sum() == confusion.counts.trace() and errors.counts.sum() == confusion.pixels
    near = 0
    for index in range(len(images)):
        shown = images[index]["labels"].numpy()
        near += int((by_transform(images.clean(index).labels)[shown != BACKGROUND] == 0).sum())
    rows = errors.to_json()
    assert [row["distance"] for row in rows] == [*BIN_NAMES]
    assert rows[0]["pixels"] == near and rows[0]["wrong"] == round(errors.counts[0, 1] / near, 5)


def test_a_bin_without_a_pixel_has_no_share(small_set: Path) -> None:
    rows = BorderErrors(RangeImages(small_set, "all", "test")).to_json()
    assert all(row["pixels"] == 0 and row["wrong"] is None for row in rows)


def test_borders_between_joined_parts_are_none(small_set: Path) -> None:
    images = open_images(str(small_set), "md", labels=LabelMap("one", (("body", PARTS33.names),)))
    errors = BorderErrors(images)
    found = evaluate(Places(0, 20), images, label_map=PARTS33, watch=errors.watch).total()
    assert errors.counts[:-1].sum() == 0 and errors.counts[-1].tolist() == [found.confusion.pixels, 0]
    assert found.confusion.pixel_accuracy() == 1
