"""Evidence that moves with bodies: still, shifted and turned ones, and where it starts anew."""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from bodyseg_data.core import MissingLibrary
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.rigs import Camera
from bodyseg_model.segmentation import CarriedLabels, carried_labels
from bodyseg_model.segmentation.carried_labels import SLOTS, Carrying, Lens, nearest_first, rotation
from bodyseg_model.segmentation.pixel_loops import UNIT, nearest

LENS = Camera(120, 160, 200.0, (80.0, 60.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
OTHER = Camera(120, 160, 190.0, (80.0, 60.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))

Image = NDArray[np.float32]
Labels = NDArray[np.uint8]


def pillar(x_m: float = 0.0, z_m: float = 2.0, turn: float = 0.0) -> tuple[Image, Labels]:
    """An oval pillar 0.8 m high, half axes 0.25 and 0.12 m, before the camera, with labels 0 to 7 by the angle round
    its axis; turn: radians.
    """
    rays = LENS.pixel_rays()
    across, down = rays[..., 0], rays[..., 1]
    cosine, sine = np.cos(turn), np.sin(turn)
    # In the pillar's own frame a ray is origin + range * way; the oval is (u / 0.25)^2 + (w / 0.12)^2 = 1.
    origin = np.array([cosine * -x_m + sine * -z_m, -sine * -x_m + cosine * -z_m])
    way = np.stack([cosine * across + sine, -sine * across + cosine], axis=-1)
    scaled_origin, scaled_way = origin / (0.25, 0.12), way / (0.25, 0.12)
    a, b = (scaled_way**2).sum(axis=-1), (scaled_way * scaled_origin).sum(axis=-1)
    inside = b**2 - a * ((scaled_origin**2).sum() - 1)
    depth = (-b - np.sqrt(np.maximum(inside, 0))) / a
    hit = (inside > 0) & (np.abs(down * depth) < 0.4)
    place = origin + depth[..., None] * way
    angle = np.arctan2(place[..., 0] / 0.25, -place[..., 1] / 0.12)
    range_m = np.where(hit, depth, 0).astype(np.float32)
    labels = np.where(hit, np.floor(angle / (np.pi / 4)) % 8, BACKGROUND).astype(np.uint8)
    return range_m, labels


def call(carried: CarriedLabels, range_m: Image, labels: Labels, sure: float = 1.0, camera: Camera = LENS) -> Labels:
    pixels = np.flatnonzero(range_m)
    return carried(range_m, labels, [(pixels, np.full(len(pixels), sure, np.float32))], camera)


def repeated(labels: Labels, share: float, seed: int) -> Labels:
    """Labels of which a share is 30, at places drawn anew for each seed."""
    wrong = np.random.default_rng(seed).random(labels.shape) < share
    return np.where(wrong & (labels != BACKGROUND), np.uint8(30), labels)


def test_the_first_frame_is_the_networks_own() -> None:
    range_m, labels = pillar()
    carried = CarriedLabels()
    np.testing.assert_array_equal(call(carried, range_m, labels), labels)


def test_flicker_of_a_still_body_goes() -> None:
    range_m, labels = pillar()
    carried = CarriedLabels()
    shown = [call(carried, range_m, repeated(labels, 0.2, seed)) for seed in range(8)]
    body = range_m > 0
    alone = (repeated(labels, 0.2, 6) != repeated(labels, 0.2, 7))[body].mean()
    assert alone > 0.25 and (shown[-1] != shown[-2])[body].mean() < 0.1
    assert (shown[-1] != labels)[body].mean() < 0.1
    assert (shown[-1][~body] == BACKGROUND).all()


@pytest.mark.parametrize(
    "at",
    [
        lambda frame: {"x_m": 0.02 * frame},
        lambda frame: {"z_m": 2 + 0.03 * frame},
        lambda frame: {"turn": 0.05 * frame},
    ],
    ids=["aside", "away", "turning"],
)
def test_labels_stay_on_the_surface_of_a_body_that_moves(
    at: Callable[[int], dict[str, float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    carried, still = CarriedLabels(Carrying(margin=0)), CarriedLabels(Carrying(margin=0))
    sought = carried_labels._motion
    for frame in range(7):
        range_m, labels = pillar(**at(frame))
        # The network is right, then no longer sure of anything.
        answer, sure = (labels, 1.0) if frame < 2 else (np.where(range_m > 0, np.uint8(30), np.uint8(BACKGROUND)), 0.02)
        shown = call(carried, range_m, answer, sure)
        monkeypatch.setattr(carried_labels, "_motion", lambda *_: (np.eye(3, 4), 0.0))
        behind = call(still, range_m, answer, sure)
        monkeypatch.setattr(carried_labels, "_motion", sought)
    body = (range_m > 0) & (shown != 30)
    assert body.sum() > 0.75 * (range_m > 0).sum()
    assert (shown == labels)[body].mean() > 0.9
    assert (behind == labels)[body].mean() < (shown == labels)[body].mean() - 0.05


def test_evidence_starts_anew_for_restarts_cameras_and_bodies() -> None:
    range_m, labels = pillar()
    other = np.where(labels == BACKGROUND, labels, np.uint8(9))
    beside = pillar(x_m=0.6)[0]  # further than a body comes in a frame
    for change in ("none", "restart", "camera", "body"):
        carried = CarriedLabels()
        call(carried, range_m, labels)
        if change == "restart":
            carried.restart()
        frame = beside if change == "body" else range_m
        answer = np.where(frame > 0, np.uint8(9), np.uint8(BACKGROUND))
        shown = call(carried, frame, answer, 0.1, OTHER if change == "camera" else LENS)
        np.testing.assert_array_equal(shown, labels if change == "none" else answer, change)
    assert (other[range_m > 0] == 9).all()


def test_two_bodies_keep_to_themselves_and_nobody_is_no_error() -> None:
    (left, left_labels), (right, right_labels) = pillar(x_m=-0.4), pillar(x_m=0.4)
    right_labels = np.where(right_labels == BACKGROUND, right_labels, right_labels + np.uint8(10))
    range_m, labels = left + right, np.minimum(left_labels, right_labels)
    bodies = [(np.flatnonzero(each), np.ones(np.count_nonzero(each), np.float32)) for each in (left, right)]
    carried = CarriedLabels()
    assert (carried(np.zeros_like(range_m), labels, [], LENS) == BACKGROUND).all()
    first = carried(range_m, labels, bodies, LENS)
    weak = [(pixels, confidence * np.float32(0.1)) for pixels, confidence in bodies[::-1]]
    second = carried(range_m, np.where(range_m > 0, np.uint8(30), labels), weak, LENS)
    np.testing.assert_array_equal(first, labels)
    np.testing.assert_array_equal(second, labels)
    assert (carried(np.zeros_like(range_m), labels, [], LENS) == BACKGROUND).all()
    anew = carried(range_m, np.where(range_m > 0, np.uint8(30), labels), weak, LENS)
    assert (anew[range_m > 0] == 30).all(), "nobody was seen in the frame between"


def counted(frames: list[tuple[Labels, NDArray[np.float32]]], rule: Carrying) -> list[Labels]:
    """Labels shown, [H, W], of a board that stays in place, by the rule in docs/how-to/steady.md, in whole numbers."""
    keeps = round(1024 * rule.keep), round(1024 * rule.border_share * rule.keep)
    margin, reach = round(rule.margin * UNIT), rule.border
    rows, columns = frames[0][0].shape
    slots: dict[tuple[int, int], list[list[int]]] = {place: [] for place in np.ndindex(rows, columns)}
    shown = []
    for labels, confidence in frames:
        for (v, u), has in slots.items():
            label, sure = int(labels[v, u]), confidence[v, u]
            weight = int(sure * sure * np.float32(UNIT) + np.float32(0.5))
            if shown:
                beside = shown[-1][max(v - reach, 0) : v + reach + 1, max(u - reach, 0) : u + reach + 1]
                keep = keeps[bool(shown[-1][v, u] != label and (beside == label).any())]
                for slot in has:
                    slot[0] = slot[0] * keep >> 10
            has[1:] = sorted(has[1:], key=lambda slot: -slot[0])
            known = [slot for slot in has if slot[1] == label]
            if known:
                known[0][0] += weight
            elif len(has) < SLOTS:
                has.append([weight, label])
            elif weight >= has[-1][0]:
                has[-1] = [weight, label]
            has[1:] = sorted(has[1:], key=lambda slot: -slot[0])
            if len(has) > 1 and has[1][0] > has[0][0] + margin:
                has[0], has[1] = has[1], has[0]
        shown.append(np.array([has[0][1] for has in slots.values()], np.uint8).reshape(rows, columns))
    return shown


def test_evidence_is_that_of_a_plain_count() -> None:
    range_m = np.zeros((120, 160), np.float32)
    range_m[20:80, 60:100] = 2.0
    pixels, draws = np.flatnonzero(range_m), np.random.default_rng(3)
    rule = Carrying()
    frames = [
        (draws.integers(0, 12, (60, 40)).astype(np.uint8), draws.random((60, 40)).astype(np.float32)) for _ in range(9)
    ]
    carried, found = CarriedLabels(rule), []
    for labels, confidence in frames:
        image = np.full(range_m.shape, BACKGROUND, np.uint8)
        image[20:80, 60:100] = labels
        found.append(carried(range_m, image, [(pixels, confidence.ravel())], LENS)[20:80, 60:100])
    np.testing.assert_array_equal(found, counted(frames, rule))
    assert any((shown != labels).any() for shown, (labels, _) in zip(found, frames, strict=True))


@pytest.mark.parametrize("reach", [0, 1, 2, 4])
def test_a_point_is_sought_at_the_nearest_pixel_of_its_range(reach: int) -> None:
    """Of equally near ones the first in reading order, none outside the image; by a plain search."""
    lens, draws = Lens(30.0, 6.0, 5.0, 12, 10, 3), np.random.default_rng(5)
    old = draws.choice(np.array([0.0, 2.0, 2.02, 2.5], np.float32), 120, p=[0.6, 0.1, 0.1, 0.2])
    steps = nearest_first(reach)
    for line, column in np.ndindex(10, 12):
        fits = [
            ((v - line) ** 2 + (u - column) ** 2, v, u)
            for v, u in np.ndindex(10, 12)
            if max(abs(v - line), abs(u - column)) <= reach and abs(old[v * 12 + u] - 2.01) <= 0.03
        ]
        expected = -1 if not fits else min(fits)[1] * 12 + min(fits)[2]
        assert nearest(line, column, np.float32(2.01), old, lens, np.float32(0.03), steps) == expected


def test_a_motion_back_is_found_to_a_tenth_of_a_degree_and_a_millimetre() -> None:
    """By the placement of an oval pillar that turns and shifts: what a rigid motion of its points would be."""
    lens, cells = Lens(LENS.focal_px, *LENS.centre_px, LENS.columns, LENS.rows, 2), []
    for x_m, z_m, turn in ((0.0, 2.0, 0.0), (0.03, 2.02, 0.05)):
        range_m = pillar(x_m, z_m, turn)[0].ravel()
        cells.append(carried_labels._cells_of(np.flatnonzero(range_m), range_m, lens))
    motion, unmet = carried_labels._motion(cells[1], cells[0], lens)
    assert unmet < 0.1
    np.testing.assert_allclose(motion[:, :3], rotation(np.array([0.0, 0.05, 0.0])), atol=0.002)
    np.testing.assert_allclose(motion @ (0.03, 0.0, 2.02, 1.0), (0.0, 0.0, 2.0), atol=0.001)


def test_a_body_that_bends_keeps_less_of_its_evidence(monkeypatch: pytest.MonkeyPatch) -> None:
    range_m, labels = pillar()
    other = np.where(labels == BACKGROUND, labels, np.uint8(9))
    for unmet, shown in ((0.04, labels), (0.06, other)):
        monkeypatch.setattr(carried_labels, "_motion", lambda *_, unmet=unmet: (np.eye(3, 4), unmet))
        carried = CarriedLabels()
        call(carried, range_m, labels)
        np.testing.assert_array_equal(call(carried, range_m, other, 0.8), shown)


def test_a_rotation_turns_about_its_vector() -> None:
    np.testing.assert_allclose(rotation(np.array([0.0, 0.0, np.pi / 2])) @ (1, 0, 0), (0, 1, 0), atol=1e-12)
    np.testing.assert_array_equal(rotation(np.zeros(3)), np.eye(3))


def test_without_numba_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "bodyseg_model.segmentation.pixel_loops", raising=False)
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(MissingLibrary, match="labelling frames needs the package 'numba'"):
        CarriedLabels()
