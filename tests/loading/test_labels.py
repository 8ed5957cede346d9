"""Label maps in the loader: the classes of every variant, by index and in batches."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from kernel_forms import by_both

from bodyseg_data import RangeImages, loader
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND, PARTS33, LabelMap, load_label_map
from bodyseg_data.loading import CameraImage, Transform

LIMBS = load_label_map("limbs14")
FEET = LabelMap("feet", (("feet", ("Rt. Digit II", "Lt. Digit II")),))


@dataclass(frozen=True)
class Upside(Transform):
    """Turns images upside down, and fails unless it is given parts."""

    name = "upside"

    def __call__(self, image: CameraImage, random: np.random.Generator) -> CameraImage:
        assert len(np.unique(image.labels)) > 15, "labels are joined after transforms"
        return replace(image, range=image.range[::-1].copy(), labels=image.labels[::-1].copy())


@pytest.mark.parametrize("variant", ["none", "all"])
@pytest.mark.parametrize("label_map", [LIMBS, FEET])
def test_classes_are_those_of_the_parts(figures_set: Path, variant: str, label_map: LabelMap) -> None:
    parts, classes = RangeImages(figures_set, variant), RangeImages(figures_set, variant, labels=label_map)
    for index in (0, 7, 20):
        one = parts[index]
        for other in by_both(partial(classes.__getitem__, index)):
            assert torch.equal(one["range"], other["range"])
            np.testing.assert_array_equal(other["labels"].numpy(), label_map.table[one["labels"].numpy()])
        assert (classes.clean(index).labels == parts.clean(index).labels).all(), "as stored"
    if label_map is FEET:
        assert set(np.unique(other["labels"].numpy())) <= {0, BACKGROUND}


@pytest.mark.parametrize("method", ["thread", "process"])
def test_batches_have_the_classes_of_single_images(figures_set: Path, method: Any) -> None:
    images = RangeImages(figures_set, "all", labels="limbs14", epoch=1)
    single = {each["key"]: each["labels"] for each in (images[index] for index in range(len(images)))}
    for batch in loader(images, 5, 2, worker_method=method):
        for key, labels in zip(batch["key"], batch["labels"], strict=True):
            assert torch.equal(labels, single[key])


@pytest.mark.parametrize("sensor", ["paper", "kinect_v1"])
@pytest.mark.parametrize("variant", ["none", "all"])
def test_arrays_that_are_written_into_hold_the_classes(figures_set: Path, sensor: str, variant: str) -> None:
    """Lateral noise of a Kinect labels pixels outside the clean silhouette, too."""
    parts = RangeImages(figures_set, variant, sensor=sensor)
    classes = RangeImages(figures_set, variant, sensor=sensor, labels="limbs14")
    image, labels = np.empty(classes.shape, np.uint16), np.empty(classes.shape, np.uint8)
    for index in range(0, 24, 5):
        classes.write(index, 2, image, labels)
        expected = parts.image(index, 2)
        np.testing.assert_array_equal(labels, LIMBS.table[expected.labels])
        np.testing.assert_array_equal(image, expected.range)


def test_labels_are_joined_after_transforms(figures_set: Path) -> None:
    parts = RangeImages(figures_set, "none")
    turned = RangeImages(figures_set, "none", transform=Upside(), labels="limbs14")
    expected = LIMBS.table[parts[3]["labels"].numpy()[::-1]]
    np.testing.assert_array_equal(turned[3]["labels"].numpy(), expected)
    image, labels = np.empty(turned.shape, np.uint16), np.empty(turned.shape, np.uint8)
    turned.write(3, 0, image, labels)
    np.testing.assert_array_equal(labels, expected)


def test_the_map_is_in_the_identity_unless_it_changes_nothing(figures_set: Path) -> None:
    plain = RangeImages(figures_set).identity()
    assert RangeImages(figures_set, labels=PARTS33).identity() == plain and "labels" not in plain
    assert RangeImages(figures_set, labels="limbs14").identity() == {**plain, "labels": LIMBS.to_json()}


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        ("limbs", "no label map is called 'limbs'"),
        (Path("nowhere.toml"), "cannot read the label map file nowhere.toml"),
        (3, "a label map is given by its name or a path, found 3"),
    ],
)
def test_maps_that_are_none_are_refused(figures_set: Path, labels: Any, message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        RangeImages(figures_set, labels=labels)
