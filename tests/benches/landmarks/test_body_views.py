"""Portraits: the right side of the body, in its colours, with a number for every landmark that can be seen."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from benches.landmarks import body_views as portrait
from benches.landmarks.body_views import LabelledBody, draw_body_views, draw_parts, draw_side
from numpy.typing import NDArray
from shapes import ball

from bodyseg_data.labels.label_map import COLOURS
from bodyseg_data.meshes import Mesh, Partition
from bodyseg_data.meshes.partitioning import find_borders


@cache
def quartered() -> LabelledBody:
    """A ball: label 0 where it faces the front, 1 its left, 2 the back, 3 its right; landmarks all round."""
    mesh = ball(subdivisions=4)
    x, y, z = (mesh.vertices - mesh.centre).T
    labels = np.where(np.abs(z) >= np.abs(x), np.where(z > 0, 0, 2), np.where(x > 0, 1, 3)).astype(np.uint8)
    ring = np.flatnonzero(np.abs(y) < 0.3)
    return "ball", mesh, whole_corners(mesh, labels), ring[:: len(ring) // 33][:33].astype(np.int64)


def whole_corners(mesh: Mesh, labels: NDArray[np.uint8]) -> Partition:
    """Parts given by vertex alone: points take the part of their nearest corner."""
    nowhere = np.full(len(mesh.vertices), np.inf)
    return Partition(labels, nowhere, find_borders(mesh, labels, nowhere))


def hue(colour: Any) -> Any:
    """A colour without its brightness."""
    return np.asarray(colour, float) / np.linalg.norm(colour)


@pytest.mark.parametrize(("azimuth", "label"), [(0, 0), (90, 1), (180, 2), (270, 3)])
def test_each_side_shows_its_own_parts(azimuth: int, label: int) -> None:
    image = np.asarray(draw_parts(quartered(), azimuth, 100)[0])
    rows, columns = image.shape[:2]
    np.testing.assert_allclose(hue(image[rows // 2, columns // 2]), hue(COLOURS[label]), atol=0.02)
    # Looking at the front, the subject's left is on the right.
    np.testing.assert_allclose(hue(image[rows // 2, columns // 2 + 42]), hue(COLOURS[(label + 1) % 4]), atol=0.02)
    np.testing.assert_allclose(hue(image[rows // 2, columns // 2 - 42]), hue(COLOURS[(label - 1) % 4]), atol=0.02)
    assert tuple(image[2, 2]) == portrait.PAPER


def test_landmarks_are_marked_where_they_are_and_only_if_seen() -> None:
    title, mesh, parts, landmarks = quartered()
    picture, dots = draw_parts((title, mesh, parts, landmarks), 0, 200)
    marked = np.asarray(draw_side((title, mesh, parts, landmarks), 0, 200)) != np.asarray(picture)
    assert all(marked[round(y) - 4 : round(y) + 5, round(x) - 4 : round(x) + 5].any() for x, y in dots.values())
    ways = mesh.vertices[landmarks] - mesh.centre
    assert set(dots) == set(np.flatnonzero(ways[:, 2] > 0.5 * 0.12 + 0.01)) | {
        label for label in dots if abs(ways[label, 2] - 0.06) <= 0.01
    }
    for label, (x, y) in dots.items():
        # 4 %: a point nearer to the viewer than the centre looks a little larger.
        expected = np.array([picture.width / 2, picture.height / 2]) + ways[label, :2] * (200, -200)
        np.testing.assert_allclose((x, y), expected, atol=0.04 * 100 + 0.5)


def test_a_landmark_behind_something_is_not_marked() -> None:
    _, whole, parts, landmarks = quartered()
    shield = ball(radius_m=0.45, centre=(0.0, 0.9, 1.1), subdivisions=4)
    mesh = Mesh(
        "hidden",
        np.concatenate([whole.vertices, shield.vertices]),
        np.concatenate([whole.faces, shield.faces + len(whole.vertices)]),
    )
    both = np.concatenate([parts.labels, np.full(len(shield.vertices), 9, np.uint8)])
    _, dots = draw_parts(("hidden", mesh, whole_corners(mesh, both), landmarks), 0, 200)
    ways = whole.vertices[landmarks] - whole.centre
    aside = np.hypot(ways[:, 0], ways[:, 1])
    assert not any(aside[label] < 0.40 for label in dots)
    assert len(dots) > 0


def test_numbers_do_not_cover_each_other_or_the_dots() -> None:
    rng = np.random.default_rng(1)
    size = (300, 500)
    dots = [tuple(place) for place in rng.uniform((60, 60), (240, 440), (33, 2))]
    taken = [(x - 4, y - 4, x + 4, y + 4) for x, y in dots]
    for x, y in dots:
        plate = portrait._label_box(x, y, 20, 15, size, taken)
        assert plate[0] >= 0 and plate[1] >= 0 and plate[2] < size[0] and plate[3] < size[1]
        assert not any(portrait._overlap(plate, other) for other in taken)
        taken.append(plate)


def test_a_number_finds_a_place_even_where_there_is_none() -> None:
    assert portrait._label_box(5, 5, 20, 15, (10, 10), []) is not None


def test_a_picture_has_a_row_for_each_body_and_a_legend() -> None:
    sitter = quartered()
    one, two = (draw_body_views([sitter] * count, 100) for count in (1, 2))
    assert one.mode == "RGB"
    assert one.height < two.height < 2 * one.height
    colours = {tuple(colour) for colour in np.asarray(one)[-200:].reshape(-1, 3).tolist()}
    assert all(tuple(colour) in colours for colour in COLOURS.tolist())  # the legend shows every part
    row = two.height - one.height  # the same bits each time
    assert np.array_equal(np.asarray(one)[:row], np.asarray(two)[:row])
    assert np.array_equal(np.asarray(one)[:row], np.asarray(two)[row : 2 * row])
