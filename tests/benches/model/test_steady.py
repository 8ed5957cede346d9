"""`bench steady`: changes of labels on a surface that is known, rows of the table, and both parts in one result."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from benches.model import chosen
from benches.model.real import steady
from benches.model.real.fusion import FusedSurface
from benches.model.real.recording import Frame
from benches.model.real.steady import ALONE, WAYS, changes, labelled, point_labels, ratio_of, table
from label_networks import Places

from bodyseg_data.labels import BACKGROUND
from bodyseg_data.rigs import Camera, PlacedCamera, load_rig
from bodyseg_model.networks import Trained

LENS = Camera(60, 80, 90.0, (40.0, 30.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
AWAY_M = 1.1


def board_frame(name: str = "0") -> Frame:
    """A board of 40 x 20 pixels square to the axis, from row 10 and column 30 on."""
    image = np.zeros((60, 80), np.float32)
    image[10:50, 30:50] = AWAY_M
    return Frame(name, image, np.flatnonzero(image), PlacedCamera(LENS, np.eye(3), np.zeros(3)))


def board_surface(frame: Frame, pixels: Any, normal: tuple[float, float, float] = (0, 0, -1)) -> FusedSurface:
    """The points that some pixels see, without faces."""
    points = frame.points(pixels)
    normals = np.broadcast_to(np.array(normal, np.float64), points.shape)
    return FusedSurface(points, np.zeros((0, 3), np.int64), normals, np.zeros(0, np.int64))


def test_points_have_the_labels_of_the_pixels_that_see_them() -> None:
    frame = board_frame()
    labels = np.full((60, 80), BACKGROUND, np.uint8)
    labels.ravel()[frame.pixels] = np.arange(800) % 7
    surface = board_surface(frame, frame.pixels)
    np.testing.assert_array_equal(point_labels(frame, surface, labels), np.arange(800) % 7)
    behind = replace(surface, vertices=surface.vertices + np.array([0, 0, 0.02]))  # another surface is before it
    assert (point_labels(frame, behind, labels) == BACKGROUND).all()
    assert (point_labels(frame, replace(surface, normals=-surface.normals), labels) == BACKGROUND).all()
    beside = replace(surface, vertices=surface.vertices + np.array([3.0, 0, 0]))
    assert (point_labels(frame, beside, labels) == BACKGROUND).all()


def test_changes_are_counted_between_frames_that_both_label() -> None:
    frame = board_frame()
    surface = board_surface(frame, frame.pixels)
    one, two = (np.full((60, 80), BACKGROUND, np.uint8) for _ in range(2))
    one.ravel()[frame.pixels[:600]] = 3
    two.ravel()[frame.pixels[200:]] = 3
    two.ravel()[frame.pixels[200:300]] = 4
    assert changes([frame, frame], surface, [one, two]) == (400, 100)
    assert changes([frame, frame, frame], surface, [one, two, one]) == (800, 200)


def test_every_way_labels_every_frame_and_mirrored_ones_are_turned_over() -> None:
    frames = [board_frame(str(number)) for number in range(4)]
    trained = Trained(Places(1, 8), {"rig": load_rig().to_json()})
    done: list[tuple[int, int]] = []
    answers = labelled(trained, frames, False, lambda *numbers: done.append(numbers))
    assert list(answers) == list(WAYS) and done[-1] == (4, 4)
    for way, given in answers.items():
        assert len(given) == 4
        for answer in given:  # nothing moves and the network is sure: all ways agree
            np.testing.assert_array_equal(answer.labels, answers[ALONE][0].labels, way)
            assert (answer.labels.ravel()[frames[0].pixels] != BACKGROUND).all()
    turned = labelled(trained, frames[:1], True)[ALONE][0]
    assert (turned.labels[10:50, 30:50] != BACKGROUND).all() and (turned.confidence[10:50, 30:50] > 0.9).all()


SCORES = {"vc_right_where_truth_stays": 0.8, "pixel_accuracy": 0.9}


def test_rows_name_every_way_and_leave_open_what_was_not_measured() -> None:
    still = {way: {"changed": 0.0182, "pixel_accuracy": 0.761} for way in WAYS}
    rows = table(still, {"none": SCORES, "all": SCORES, "none, carried": SCORES | {"pixel_accuracy": None}})
    assert len(rows) == len(WAYS) and len({tuple(row) for row in rows}) == 1
    assert list(rows[0].values()) == ["each frame alone", "1.82", "76.1", *(["80.0", "90.0", "0.889"] * 2)]
    assert list(rows[1].values())[3:] == ["–"] * 6
    assert list(rows[-1].values())[3:6] == ["80.0", "–", "–"]
    assert ratio_of(SCORES) == 0.889 and ratio_of(SCORES | {"vc_right_where_truth_stays": None}) is None


def test_the_bench_joins_both(monkeypatch: pytest.MonkeyPatch) -> None:
    still = {"ways": {way: {"changed": 0.02, "pixel_accuracy": 0.7} for way in WAYS}}
    done: list[tuple[int, int]] = []

    def still_person(trained: Any, folder: Any, views: int, progress: Any) -> Any:
        progress(3, 3)
        return still | {"recording": folder.name, "frames": views}

    def temporal(networks: Any, progress: Any) -> Any:
        progress(1, 2)
        progress(2, 2)
        facts = {"shots": [], "frames": 16, "window": 8}
        return facts | {"networks": {name: {"none": SCORES, "none, carried": SCORES} for name in networks}}

    monkeypatch.setattr(chosen, "load_network", lambda path: SimpleNamespace(network=None))
    monkeypatch.setattr(steady, "still_person", still_person)
    monkeypatch.setattr(steady, "temporal", temporal)
    found = steady.bench_steady("folder/made", 5, progress=lambda *numbers: done.append(numbers))
    assert done == [(500, 1000), (750, 1000), (1000, 1000)]
    assert found["still"]["recording"] == "made" and found["moving"]["window"] == 8
    assert len(found["tables"]["steady"]) == len(WAYS)
    json.dumps(found)
