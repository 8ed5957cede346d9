"""Distances of pixels to the parts predicted for them: against every pair of points, in images, and summed up."""

import numpy as np
import pytest

from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.rigs import Camera
from bodyseg_model.evaluation.gross_errors import FARTHEST_M, GrossErrors, distances_in_image, distances_to_parts

CAMERA = Camera(40, 30, 50.0, (15.0, 20.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def by_pairs(points: np.ndarray, predicted: np.ndarray, surface: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """The same distances from every pair of a point and a point of the surface."""
    away = np.linalg.norm(points[:, None] - surface[None], axis=2)
    away[predicted[:, None] != labels[None]] = np.inf
    return away.min(axis=1)


def test_distances_are_those_of_all_pairs() -> None:
    rng = np.random.default_rng(1)
    points, surface = rng.normal(size=(200, 3)), rng.normal(size=(500, 3))
    predicted, labels = rng.integers(0, 6, 200).astype(np.uint8), rng.integers(0, 5, 500).astype(np.uint8)
    found = distances_to_parts(points, predicted, surface, labels)
    assert found.dtype == np.float32
    assert np.allclose(found, by_pairs(points, predicted, surface, labels))
    assert np.array_equal(np.isinf(found), predicted == 5)


def test_a_point_of_the_surface_is_at_no_distance_of_its_own_part() -> None:
    surface = np.random.default_rng(2).normal(size=(90, 3))
    labels = np.repeat(np.arange(3, dtype=np.uint8), 30)
    assert not distances_to_parts(surface, labels, surface, labels).any()
    assert distances_to_parts(surface[:0], labels[:0], surface, labels).shape == (0,)
    assert np.isinf(distances_to_parts(surface, labels, surface[:0], labels[:0])).all()


def test_arrays_must_fit() -> None:
    labels = np.zeros(4, np.uint8)
    with pytest.raises(BadConfig, match=r"the surface must be \[N, 3\] with labels \[N\], found \(5, 3\) and \(4,\)"):
        distances_to_parts(np.zeros((4, 3)), labels, np.zeros((5, 3)), labels)


def flat_image() -> tuple[np.ndarray, np.ndarray]:
    """A plane at 1 m, 20 mm a pixel: labels 0, 1, 2 in columns 5 to 11, 12 to 18 and 19 to 24."""
    labels = np.full((40, 30), BACKGROUND, np.uint8)
    for label, (start, end) in enumerate(((5, 12), (12, 19), (19, 25))):
        labels[5:35, start:end] = label
    return np.where(labels == BACKGROUND, 0, 1).astype(np.float32), labels


def test_distances_in_an_image_are_by_the_clean_surface() -> None:
    range_m, labels = flat_image()
    truth, predicted = labels.copy(), labels.copy()
    predicted[10, 11] = 1  # 20 mm from its border
    predicted[10, 6] = 2  # 13 pixels of 20 mm
    predicted[20, 7] = 9  # nowhere in the image
    truth[30, 6], predicted[30, 6] = BACKGROUND, 2  # lost by an artifact
    predicted[:5] = 2  # of the background
    found = distances_in_image(truth, predicted, range_m, labels, CAMERA)
    assert found == pytest.approx([0.26, 0.02, np.inf])  # reading order


def test_a_part_behind_is_as_far_as_its_range_says() -> None:
    """The nearest point of a part behind may lie inside it: every fourth pixel is kept there."""
    labels = np.zeros((40, 30), np.uint8)
    range_m = np.full(labels.shape, 1.0, np.float32)
    labels[:, 14], range_m[:, 14] = 1, 0.9
    predicted = labels.copy()
    predicted[20, 14] = 0
    (found,) = distances_in_image(labels, predicted, range_m, labels, CAMERA)
    rays = CAMERA.pixel_rays() * range_m[..., None]
    assert found == pytest.approx(np.linalg.norm(rays[labels == 0] - rays[20, 14], axis=1).min(), abs=5e-4)


def test_counts_add_up_and_merge() -> None:
    one, other = GrossErrors(), GrossErrors()
    assert one.to_json() is None
    assert np.isnan(one.shares()).all()
    one.add(np.array([0.01, 0.03, 0.05], np.float32), right=5)
    other.add(np.array([0.1, 3.0, np.inf], np.float32), right=9)
    one.merge(other)
    assert one.pixels == 20
    assert one.shares() == pytest.approx([4 / 20, 3 / 20])
    assert one.mean_mm() == pytest.approx((10 + 30 + 50 + 100 + 2 * 1000 * FARTHEST_M) / 20)
    assert one.to_json() == {"beyond_30_mm": 0.2, "beyond_60_mm": 0.15, "mean_mm": 59.5}
