from __future__ import annotations

import numpy as np
import pytest

from bodyseg_data.labels import LANDMARKS, PARTS, PARTS33
from bodyseg_model.evaluation import KINDS, kinds_of
from bodyseg_model.evaluation.scores import REGIONS, count_kinds


def kind(truth: str, predicted: str) -> str:
    return KINDS[kinds_of(PARTS33)[LANDMARKS.index(truth), LANDMARKS.index(predicted)]]


@pytest.mark.parametrize(
    ("truth", "predicted", "expected"),
    [
        ("Sellion", "Sellion", "right"),
        ("Rt. Olecranon", "Lt. Olecranon", "left/right"),
        ("Lt. ASIS", "Rt. ASIS", "left/right"),
        ("Sellion", "Nuchale", "front/back"),
        ("Nuchale", "Supramenton", "front/back"),
        ("Substernale", "10th Rib Midspine", "front/back"),
        ("Suprasternale", "Lt. PSIS", "front/back"),
        ("Rt. ASIS", "Rt. PSIS", "front/back"),
        ("Rt. ASIS", "Lt. PSIS", "both"),
        ("Lt. Axilla, Post.", "Rt. Thelion/Bustpoint", "both"),
        ("Rt. Femoral Lateral Epicn", "Rt. Knee Crease", "front/back"),
        ("Rt. Femoral Lateral Epicn", "Lt. Knee Crease", "both"),
        ("Sellion", "Cervicale", "other"),  # head and trunk do not face each other
        ("Lt. ASIS", "Lt. Knee Crease", "other"),
        ("Lt. PSIS", "Lt. Trochanterion", "other"),  # the side of the hip has no face
        ("Rt. Thelion/Bustpoint", "Lt. ASIS", "other"),  # the other side, but no mirror image
        ("Suprasternale", "Substernale", "other"),
    ],
)
def test_kinds_of_mistakes(truth: str, predicted: str, expected: str) -> None:
    assert kind(truth, predicted) == expected
    assert kind(predicted, truth) == expected


def test_every_part_with_a_face_is_of_one_region_that_has_both() -> None:
    plain = {part.landmark: part.landmark.removeprefix("Rt. ").removeprefix("Lt. ") for part in PARTS}
    listed = [name for names in REGIONS.values() for name in names]
    assert len(listed) == len(set(listed))
    assert set(listed) == {plain[part.landmark] for part in PARTS if part.face != "both"}
    for names in REGIONS.values():
        assert {part.face for part in PARTS if plain[part.landmark] in names} == {"front", "back"}


def test_kinds_are_counted_from_a_confusion_matrix() -> None:
    confusion = np.zeros((33, 33), np.int64)
    confusion[0, 0], confusion[4, 5], confusion[0, 1], confusion[7, 12], confusion[3, 6] = 10, 4, 3, 2, 1
    assert count_kinds(confusion) == {"right": 10, "left/right": 4, "front/back": 3, "both": 2, "other": 1}
    pairs = {name: int(np.sum(KINDS.index(name) == kinds_of(PARTS33))) for name in KINDS}
    assert pairs["right"] == 33
    assert pairs["left/right"] == 26
    # Of the trunk's 6 front and 6 back parts 2 and 2 are on the right and as many on the left: 36 pairs, 8 of them on
    # different sides. Of the knees' 2 and 2 it is 2 of 4 pairs, of the head's 2 and 1 none. All of it both ways.
    assert pairs["both"] == 2 * (8 + 2)
    assert pairs["front/back"] == 2 * (2 + 36 - 8 + 2)
    assert sum(pairs.values()) == 33**2
