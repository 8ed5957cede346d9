"""Distances of pixels to the parts predicted for them: against every pair of points, in images, and summed up."""

from pathlib import Path

import numpy as np
import pytest
import torch

from bodyseg_data import RangeImages
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.loading import Flip
from bodyseg_data.rigs import Camera
from bodyseg_data.samples import metres
from bodyseg_model.commands.evaluate import headline
from bodyseg_model.evaluation import evaluate, evaluation, open_images, report
from bodyseg_model.evaluation.evaluation import PredictedImage
from bodyseg_model.evaluation.gross_errors import FARTHEST_M, GrossErrors, TrueSurface, distances_to_parts
from bodyseg_model.networks import Network

CAMERA = Camera(40, 30, 50.0, (15.0, 20.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


class Striped(Network):
    """Calls every five rows another class."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.classes = classes

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        rows = torch.arange(range_m.shape[2]) // 5 % self.classes
        scores = torch.nn.functional.one_hot(rows, self.classes).T[None, :, :, None].float()
        return scores.expand(len(range_m), -1, -1, range_m.shape[3])


def copied(image: PredictedImage) -> PredictedImage:
    """The image, whose arrays are valid until the next one."""
    return image._replace(**{name: getattr(image, name).copy() for name in ("range_m", "labels", "predicted")})


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


def flat_image() -> tuple[np.ndarray, np.ndarray]:
    """A plane at 1 m, 20 mm a pixel: labels 0, 1, 2 in columns 5 to 11, 12 to 18 and 19 to 24."""
    labels = np.full((40, 30), BACKGROUND, np.uint8)
    for label, (start, end) in enumerate(((5, 12), (12, 19), (19, 25))):
        labels[5:35, start:end] = label
    return np.where(labels == BACKGROUND, 0, 1).astype(np.float32), labels


def test_distances_in_an_image_are_by_the_clean_surface() -> None:
    surface = TrueSurface(*flat_image(), CAMERA)
    # 20 mm from the part's border; 13 pixels of 20 mm; a part that is nowhere in the image; the pixel's own part.
    pixels = np.array([10 * 30 + 11, 10 * 30 + 6, 20 * 30 + 7, 8 * 30 + 8])
    found = surface.distances(pixels, np.array([1, 2, 9, 0], np.uint8))
    assert found == pytest.approx([0.02, 0.26, np.inf, 0])
    assert surface.points(pixels[:1]) == pytest.approx(np.array([[(11.5 - 15) / 50, (10.5 - 20) / 50, 1]]))


def test_a_part_behind_is_as_far_as_its_range_says() -> None:
    """The nearest point of a part behind may lie inside it: every fourth pixel is kept there."""
    labels = np.zeros((40, 30), np.uint8)
    range_m = np.full(labels.shape, 1.0, np.float32)
    labels[:, 14], range_m[:, 14] = 1, 0.9
    surface, pixel = TrueSurface(range_m, labels, CAMERA), np.array([20 * 30 + 14])
    behind = surface.points(np.flatnonzero(labels == 0))
    nearest = np.linalg.norm(behind - surface.points(pixel), axis=1).min()
    assert surface.distances(pixel, np.zeros(1, np.uint8)) == pytest.approx([nearest], abs=5e-4)


def test_of_an_evaluation_they_are_by_the_stored_samples(small_set: Path) -> None:
    """Artifacts take pixels out and move ranges, and joined classes join parts; the surface stays."""
    for labels in (None, "limbs14"):
        images = open_images(str(small_set), "all", labels=labels)
        classes = len(images.label_map)
        seen: list[PredictedImage] = []
        found = evaluate(Striped(classes).eval(), images, 1, watch=lambda one, _, seen=seen: seen.append(copied(one)))
        total = GrossErrors()
        for one in seen:
            sample = images.clean(images.keys.index(one.key))
            own = images.label_map.table[sample.labels]
            points = images.manifest.rig.camera.pixel_rays() * metres(sample.range, images.step_m)[..., None]
            body, wrong = own != BACKGROUND, (one.labels != BACKGROUND) & (one.labels != one.predicted)
            away = by_pairs(points[wrong], one.predicted[wrong], points[body], own[body])
            assert one.away == pytest.approx(away, rel=0.02), "pixels of 20 mm, of which some stand for others"
            total.add(away, np.count_nonzero((one.labels != BACKGROUND) & ~wrong))
        scores = found.total().gross_errors
        assert scores.pixels == total.pixels == found.total().confusion.pixels > 0
        assert scores.micrometres == pytest.approx(total.micrometres, rel=0.01)
        assert report(found)["gross_errors"] == scores.to_json()
        assert sum(each.gross_errors.pixels for each in found.subsets.values()) == total.pixels


def test_images_that_transforms_change_have_none(small_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = RangeImages(small_set, "none", "test", transform=Flip())
    assert report(evaluate(Striped(33).eval(), images, 2))["gross_errors"] is None
    monkeypatch.setattr(evaluation, "MEASURABLE", False)
    tree = report(evaluate(Striped(33).eval(), open_images(str(small_set), "none"), 2))
    assert tree["gross_errors"] is None, "without SciPy"
    assert "30 mm" not in headline(tree)


def test_counts_add_up_and_merge() -> None:
    one, other = GrossErrors(), GrossErrors()
    assert one.to_json() is None
    one.add(np.array([0.01, 0.03, 0.05], np.float32), right=5)
    other.add(np.array([0.1, 3.0, np.inf], np.float32), right=9)
    one.merge(other)
    assert one.pixels == 20
    mean_mm = round((10 + 30 + 50 + 100 + 2 * 1000 * FARTHEST_M) / 20, 2)
    assert one.to_json() == {"beyond_30_mm": 4 / 20, "beyond_60_mm": 3 / 20, "mean_mm": mean_mm}
