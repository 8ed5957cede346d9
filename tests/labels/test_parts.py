from __future__ import annotations

import numpy as np

from bodyseg_data.labels import BACKGROUND, LANDMARKS, PART_CLASSES, PART_COUNT, PARTS, colour_labels
from bodyseg_data.labels.parts import COLOURS


def test_there_are_33_parts_in_the_documented_order() -> None:
    assert PART_COUNT == len(LANDMARKS) == len(set(LANDMARKS)) == 33
    assert [part.label for part in PARTS] == list(range(33))
    expected = {0: "Sellion", 6: "Substernale", 8: "Lt. ASIS", 9: "Cervicale", 10: "10th Rib Midspine"}
    expected |= {13: "Rt. Axilla, Post.", 22: "Lt. Dactylion", 25: "Rt. Femoral Lateral Epicn", 32: "Lt. Digit II"}
    assert {label: LANDMARKS[label] for label in expected} == expected


def test_every_right_part_is_followed_by_its_left_twin() -> None:
    rights = [part for part in PARTS if part.side == "right"]
    assert len(rights) == 13
    for part in rights:
        twin = PARTS[part.label + 1]
        assert twin.side == "left"
        assert twin.landmark == part.landmark.replace("Rt.", "Lt.")
        assert twin.face == part.face


def test_a_mirror_exchanges_left_and_right_and_nothing_else() -> None:
    exchanged = {"left": "right", "right": "left", "middle": "middle"}
    for part in PARTS:
        other = PARTS[part.mirror]
        assert other.landmark == part.landmark.replace("Rt.", "@").replace("Lt.", "Rt.").replace("@", "Lt.")
        assert (other.side, other.face, other.location) == (exchanged[part.side], part.face, part.location)
        assert other.mirror == part.label
    assert sum(part.mirror == part.label for part in PARTS) == 7


def test_mirrored_labels_are_those_of_the_table() -> None:
    assert PART_CLASSES.mirrored.dtype == np.uint8
    assert PART_CLASSES.mirrored[:PART_COUNT].tolist() == [part.mirror for part in PARTS]
    assert PART_CLASSES.mirrored[PART_COUNT:].tolist() == list(range(PART_COUNT, 256))


def test_colours_are_told_apart() -> None:
    distances = np.linalg.norm(COLOURS[:, None].astype(float) - COLOURS[None], axis=-1) + 1e3 * np.eye(PART_COUNT)
    assert distances.min() > 25


def test_labels_are_drawn_in_their_colours() -> None:
    drawn = colour_labels(np.array([[0, 32, BACKGROUND]], np.uint8), background=(1, 2, 3))
    assert drawn.tolist() == [[COLOURS[0].tolist(), COLOURS[32].tolist(), [1, 2, 3]]]
