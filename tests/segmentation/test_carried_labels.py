"""Evidence that moves with bodies: still, shifted, turned and bending ones, and where it starts anew."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from benches.model.real.steady import RigidLabels, StillLabels
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.machine import torch_threads
from bodyseg_data.rigs import Camera
from bodyseg_model.segmentation import CarriedLabels, carried_labels
from bodyseg_model.segmentation.carried_labels import BodyPixels, Carrying, CellLens, Cells, nearest_first, part_shifts
from bodyseg_model.segmentation.carried_loops import SLOTS, UNIT, cells_met, middle_of, nearest

LENS = Camera(120, 160, 200.0, (80.0, 60.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
FINE = Camera(480, 640, 800.0, (320.0, 240.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
OTHER = Camera(120, 160, 190.0, (80.0, 60.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))

Image = NDArray[np.float32]
Labels = NDArray[np.uint8]


def pillar(
    x_m: float = 0.0, z_m: float = 2.0, turn: float = 0.0, arm: float | None = None, camera: Camera = LENS
) -> tuple[Image, Labels]:
    """An oval pillar 0.8 m high, half axes 0.25 and 0.12 m, before the camera, with labels 0 to 7 by the angle round
    its axis; turn: radians. arm: height of a bar, label 20, that stands out to the right, metres; None for no bar.
    """
    rays = camera.pixel_rays()
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
    if arm is not None:
        bar = (across * 2 > 0.24) & (across * 2 < 0.6) & (np.abs(down * 2 - arm) < 0.06)
        range_m[bar], labels[bar] = 2.0, 20
    return range_m, labels


def call(carried: CarriedLabels, range_m: Image, labels: Labels, sure: float = 1.0, camera: Camera = LENS) -> Labels:
    pixels = np.flatnonzero(range_m)
    return carried(range_m, labels, [(pixels, np.full(len(pixels), sure, np.float32))], camera)


def repeated(labels: Labels, share: float, seed: int) -> Labels:
    """Labels of which a share is 30, at places drawn anew for each seed."""
    wrong = np.random.default_rng(seed).random(labels.shape) < share
    return np.where(wrong & (labels != BACKGROUND), np.uint8(30), labels)


@pytest.mark.parametrize("count", [1, 2, 5, 8, 301])
def test_the_middle_of_deviations_is_that_of_a_sort(count: int) -> None:
    rng = np.random.default_rng(count)
    for values in (
        rng.exponential(0.01, count),
        rng.integers(0, 3, count),
        np.zeros(count),
        10.0 ** rng.uniform(-44, 38, count),
    ):
        exact = values.astype(np.float32)
        assert middle_of(exact) == np.sort(exact)[count // 2]


def test_the_first_frame_is_the_networks_own() -> None:
    range_m, labels = pillar()
    carried = CarriedLabels()
    np.testing.assert_array_equal(call(carried, range_m, labels), labels)


@pytest.mark.parametrize("nearest_m", [0.2, 1e-20])
def test_a_body_too_small_for_a_cell_keeps_the_networks_labels(nearest_m: float) -> None:
    carried, (range_m, labels) = CarriedLabels(), pillar()
    few = np.zeros_like(range_m)
    few[1, 1] = nearest_m  # of cells of so many pixels, every third or so row and column is used
    for _ in range(2):
        assert call(carried, few, np.where(few > 0, np.uint8(3), np.uint8(BACKGROUND)))[1, 1] == 3
        np.testing.assert_array_equal(call(carried, range_m, labels), labels)


def test_a_still_body_keeps_its_labels_in_the_last_columns_of_the_widest_image() -> None:
    camera = Camera(40, 8192, 4000.0, (4096.0, 20.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    range_m = np.zeros((40, 8192), np.float32)
    range_m[:, 7900:8190] = 2.0
    labels = np.where(range_m > 0, np.uint8(3), np.uint8(BACKGROUND))
    carried = CarriedLabels()
    for _ in range(3):
        call(carried, range_m, labels, camera=camera)
    doubtful = np.where(range_m > 0, np.uint8(4), labels)
    np.testing.assert_array_equal(call(carried, range_m, doubtful, 0.3, camera), labels)


def test_flicker_of_a_still_body_goes() -> None:
    range_m, labels = pillar()
    carried = CarriedLabels()
    shown = [call(carried, range_m, repeated(labels, 0.2, seed)) for seed in range(8)]
    body = range_m > 0
    alone = (repeated(labels, 0.2, 6) != repeated(labels, 0.2, 7))[body].mean()
    assert alone > 0.25 and (shown[-1] != shown[-2])[body].mean() < 0.05
    assert (shown[-1] != labels)[body].mean() < 0.05
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
def test_labels_stay_on_the_surface_of_a_body_that_moves(at: Callable[[int], dict[str, float]]) -> None:
    carried, still = CarriedLabels(Carrying(margin=0)), StillLabels(Carrying(margin=0))
    for frame in range(7):
        range_m, labels = pillar(**at(frame))
        # The network is right, then no longer sure of anything.
        answer, sure = (labels, 1.0) if frame < 2 else (np.where(range_m > 0, np.uint8(30), np.uint8(BACKGROUND)), 0.02)
        shown, behind = call(carried, range_m, answer, sure), call(still, range_m, answer, sure)
    body = (range_m > 0) & (shown != 30)
    assert body.sum() > 0.75 * (range_m > 0).sum()
    assert (shown == labels)[body].mean() > 0.9
    assert (behind == labels)[body].mean() < (shown == labels)[body].mean() - 0.05


def test_a_part_that_moves_by_itself_takes_its_label_along() -> None:
    shown = {}
    for motion, carried in (("rigid", RigidLabels()), ("parts", CarriedLabels())):
        for frame in range(5):
            range_m, labels = pillar(arm=-0.2 + 0.1 * frame)
            unsure = (labels == 20) & (repeated(labels, 0.3, frame) == 30) & (frame > 0)
            answer = np.where(unsure, np.uint8(21), labels)
            shown[motion] = call(carried, range_m, answer, 0.4 if frame else 1.0)
    arm = labels == 20
    wrong = {motion: (image != 20)[arm].mean() for motion, image in shown.items()}
    assert wrong["parts"] < 0.8 * wrong["rigid"]


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


def test_labels_do_not_depend_on_the_number_of_threads() -> None:
    shown = []
    for threads in (1, 2, 3):
        carried = CarriedLabels()
        with torch_threads(threads):
            for frame in range(4):
                range_m, labels = pillar(camera=FINE, arm=-0.2 + 0.1 * frame, turn=0.03 * frame)
                shown.append(call(carried, range_m, repeated(labels, 0.3, frame), 0.6, FINE))
    assert np.count_nonzero(range_m) > 3 * carried_labels._LEAST_PIXELS
    np.testing.assert_array_equal(shown[4:], shown[:4] * 2)
    assert (shown[3] != repeated(labels, 0.3, 3)).any()


def test_frames_that_do_not_fit_their_camera_or_bodies_are_refused() -> None:
    """Compiled loops would write beyond their arrays."""
    range_m, labels = pillar()
    pixels = np.flatnonzero(range_m)
    sure = np.ones(len(pixels), np.float32)
    carried = CarriedLabels()
    for image, named, camera in ((range_m, labels, FINE), (range_m[1:], labels, LENS), (range_m, labels[:, 1:], LENS)):
        with pytest.raises(BadConfig, match="^a frame must have the camera's size, "):
            carried(image, named, [(pixels, sure)], camera)
    for body in ((pixels, sure[1:]), (pixels[::-1], sure), (pixels + labels.size, sure), (pixels - labels.size, sure)):
        with pytest.raises(BadConfig, match="^a body has pixels of the frame, ascending, and a confidence for each"):
            carried(range_m, labels, [body], LENS)
    assert (call(carried, range_m, labels) == labels).all()


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


def tracks_of(carried: CarriedLabels, *places_m: float, camera: Camera = LENS) -> list[int]:
    """Numbers of pillars in the next frame."""
    frames = [pillar(x_m=x_m, camera=camera)[0] for x_m in places_m]
    bodies = [(np.flatnonzero(each), np.ones(np.count_nonzero(each), np.float32)) for each in frames]
    range_m = np.max([np.zeros_like(pillar(camera=camera)[0]), *frames], axis=0)
    carried(range_m, np.where(range_m > 0, np.uint8(3), np.uint8(BACKGROUND)), bodies, camera)
    return carried.tracks


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        ([(0.02,), (0.3, 0.0)], [2, 1]),  # the newcomer is larger, and so comes first
        ([(0.4, 0.2), (0.22,), (0.41,)], [2]),  # follows another one out of sight
        ([(-0.35, 0.0), (0.0,), (0.35, 0.0)], [1, 2]),  # walks past behind another one
    ],
)
def test_a_body_that_comes_near_another_one_takes_no_number_of_it(
    frames: list[tuple[float, ...]], expected: list[int]
) -> None:
    carried = CarriedLabels()
    assert [tracks_of(carried, *places_m) for places_m in frames][-1] == expected


def test_an_interrupted_frame_exchanges_no_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    carried = CarriedLabels()
    assert tracks_of(carried, 0.02) == [1]
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(carried, "_carry", interrupt)
        tracks_of(carried, 0.3, 0.0)
    assert tracks_of(carried, 0.3, 0.0) == [2, 1], "as if it had not come"


def test_bodies_keep_their_numbers_where_each_frame_has_a_camera_of_its_own() -> None:
    carried = CarriedLabels()
    assert tracks_of(carried, -0.4, 0.4) == [1, 2]
    assert tracks_of(carried, 0.4, -0.4, camera=OTHER) == [2, 1]


def test_a_body_keeps_its_number_also_out_of_sight_for_a_second() -> None:
    carried = CarriedLabels()
    tracks = partial(tracks_of, carried)

    assert tracks(-0.4, 0.4) == [1, 2]
    assert tracks(0.35, -0.35) == [2, 1], "the largest body comes first, whoever it is"
    for _ in range(carried_labels._AWAY_FRAMES - 1):
        assert tracks(-0.35) == [1]
    assert tracks(-0.35, 0.35) == [1, 2]
    for _ in range(carried_labels._AWAY_FRAMES):
        assert tracks() == []
    assert tracks(-0.35, 0.35) == [3, 4], "after longer they are others"
    carried.restart()
    assert tracks(0.35) == [1] and len(carried._tracked) == 1
    carried.restart(numbers=False)
    assert tracks(0.35) == [2], "numbers go on"


def counted(frames: list[tuple[Labels, NDArray[np.float32]]], rule: Carrying) -> list[Labels]:
    """Labels shown, [H, W], of a board that stays in place, by the rule in docs/how-to/steady.md, in whole numbers."""
    keeps = round(1024 * rule.keep), round(1024 * rule.stiff_border_share * rule.keep)
    margin, reach = round(rule.margin * UNIT), rule.stiff_border
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
    carried, found = StillLabels(rule), []
    for labels, confidence in frames:
        image = np.full(range_m.shape, BACKGROUND, np.uint8)
        image[20:80, 60:100] = labels
        found.append(carried(range_m, image, [(pixels, confidence.ravel())], LENS)[20:80, 60:100])
    np.testing.assert_array_equal(found, counted(frames, rule))
    assert any((shown != labels).any() for shown, (labels, _) in zip(found, frames, strict=True))


@pytest.mark.parametrize("reach", [0, 1, 2, 4])
def test_a_point_is_sought_at_the_nearest_pixel_of_its_range(reach: int) -> None:
    """Of equally near ones the first in reading order, none outside the image; by a plain search."""
    lens, draws = CellLens(30.0, 6.0, 5.0, 12, 10, 3, 4, 4), np.random.default_rng(5)
    old = draws.choice(np.array([0.0, 2.0, 2.02, 2.5], np.float32), 120, p=[0.6, 0.1, 0.1, 0.2])
    steps = nearest_first(reach)
    for line, column in np.ndindex(10, 12):
        fits = [
            ((v - line) ** 2 + (u - column) ** 2, v, u)
            for v, u in np.ndindex(10, 12)
            if max(abs(v - line), abs(u - column)) <= reach and abs(old[v * 12 + u] - 2.01) <= 0.03
        ]
        expected = -1 if not fits else min(fits)[1] * 12 + min(fits)[2]
        args = np.float32(2.01), old, lens, np.float32(0.03), reach, steps
        assert nearest(line, column, *args) == expected


def test_labels_that_slide_along_a_board_are_followed() -> None:
    """Ranges of a flat board say nothing of a motion along it: only its labels show that parts move."""
    range_m = np.zeros((120, 160), np.float32)
    range_m[20:100, 30:130] = 2.0
    followed, behind = CarriedLabels(), RigidLabels(Carrying(stiff_border=0))
    for frame in range(4):
        labels = np.where(range_m > 0, np.uint8(9), np.uint8(BACKGROUND))
        places = (22, 32 + 3 * frame), (22, 72 + 3 * frame), (62, 32 + 2 * frame), (62, 104 - 3 * frame)
        for part, (row, column) in enumerate(places):
            labels[row : row + 36, column : column + 25] = part
        shown = [call(video, range_m, labels) for video in (followed, behind)]
    wrong, late = ((image != labels)[range_m > 0].mean() for image in shown)
    assert wrong < 0.03 and late > 0.05


def cells_of(carried: CarriedLabels, range_m: Image) -> tuple[Cells, CellLens]:
    body = BodyPixels(np.flatnonzero(range_m), range_m.ravel(), range_m.ravel(), np.zeros(range_m.size, np.uint8))
    lens = carried._lens(body, LENS)
    return carried._cells(body, lens), lens


def test_cells_of_a_slanted_board_have_its_normal_and_their_neighbours() -> None:
    """None of them across the jump in its middle, nor beyond its ends."""
    slant = np.array([-0.3, -0.2, 1.0])  # the board is where slant @ point is 2
    range_m = 2 / (LENS.pixel_rays() @ slant)
    range_m[:, 80:] += 0.3
    shown = np.zeros(range_m.shape, bool)
    shown[:100, :130] = True
    cells, lens = cells_of(CarriedLabels(), np.where(shown, range_m, 0).astype(np.float32))
    rows, columns = np.divmod(np.flatnonzero(cells.grid >= 0), lens.across)
    places = {place: number for number, place in enumerate(zip(rows.tolist(), columns.tolist(), strict=True))}
    for (row, column), number in places.items():
        beside = (row, column - 1), (row, column + 1), (row - 1, column), (row + 1, column)
        found = [places.get(each, number) for each in beside]
        jumps = [abs(cells.points[each, 2] - cells.points[number, 2]) > 0.15 for each in found]
        expected = [number if jump else each for each, jump in zip(found, jumps, strict=True)]
        assert cells.neighbours[number].tolist() == expected
    inside = (cells.neighbours != np.arange(len(places))[:, None]).all(axis=1) & (columns * lens.side < 70)
    assert inside.sum() > 300
    np.testing.assert_allclose(
        cells.normals[inside], np.tile(slant / np.linalg.norm(slant), (inside.sum(), 1)), atol=0.02
    )


def test_a_place_meets_the_cell_that_it_projects_into_or_none() -> None:
    """None beside the image, off the surface by more than the gate, or behind the camera."""
    cells, lens = cells_of(CarriedLabels(), np.full((120, 160), 2.0, np.float32))
    row, column = np.divmod(np.arange(len(cells.points)), lens.across)

    def met(places: NDArray[np.float32]) -> NDArray[np.int64]:
        return cells_met(places, cells, lens, np.float32(0.05))

    assert met(cells.points).tolist() == list(range(lens.across * lens.down))
    cell_m = np.float32(lens.side * 2.0 / LENS.focal_px)
    for axis, at, last in ((0, column, lens.across - 1), (1, row, lens.down - 1)):
        for way in (-1, 1):
            moved = cells.points + way * cell_m * np.eye(3, dtype=np.float32)[axis]
            found, edge = met(moved), at == (0 if way < 0 else last)
            assert (found[edge] == -1).all()
            assert (found[~edge] == np.flatnonzero(~edge) + way * (1, lens.across)[axis]).all()
    for factor in (1.03, 0.97, 0.04, -1.0):
        assert (met(cells.points * np.float32(factor)) == -1).all()


@pytest.mark.parametrize("x_m", [0.06, 0.3])  # the farther one is sought from the shift of its middle
def test_a_rigid_motion_is_found_back_to_the_frame_before(x_m: float) -> None:
    carried = CarriedLabels()
    earlier, lens = cells_of(carried, pillar()[0])
    own, _ = cells_of(carried, pillar(x_m, 2.04, 0.1)[0])
    rigid = carried._rigid(own, earlier, lens, 0.05)
    np.testing.assert_allclose(rigid[:, :3] @ (x_m, 0, 2.04) + rigid[:, 3], (0, 0, 2), atol=0.004)
    assert np.arctan2(rigid[0, 2], rigid[0, 0]) == pytest.approx(0.1, abs=0.006)


def test_parts_shift_by_their_middles_unless_they_are_small_or_far() -> None:
    points = np.zeros((120, 3), np.float32)
    points[:, 0], points[:, 2] = np.linspace(0, 1.2, 120), 2.0
    labels = np.repeat(np.array([1, 2, 3], np.uint8), [50, 60, 10])
    before = points + np.where(labels[:, None] == 1, np.float32(0.1), np.float32(0.4))
    earlier = Cells(np.zeros(0, np.int32), before, before, np.zeros((0, 4), np.int64), labels, 0.0)
    shifts, weights = part_shifts(points, labels, earlier)
    np.testing.assert_allclose(shifts[:50], 0.1, atol=1e-5)
    assert not shifts[50:].any(), "further than a part comes in a frame, and ten cells are too few"
    assert (weights[:50] > 0).all() and not weights[50:].any()


def test_without_numba_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "bodyseg_model.segmentation.carried_loops", raising=False)
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(MissingLibrary, match="carrying labels through a video needs the package 'numba'"):
        CarriedLabels()


@pytest.mark.parametrize("nobody_between", [False, True])
def test_whoever_is_elsewhere_has_cells_of_their_size(nobody_between: bool) -> None:
    """Cells of 2 cm where the first body was are of 16 cm where another comes later, or the same one goes."""
    camera = Camera(120, 160, 400.0, (80.0, 60.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    steadied = CarriedLabels()

    def side_at(metres: float) -> int:
        ranges = np.full((120, 160), np.float32(metres))
        pixels = np.arange(ranges.size) if metres else np.zeros(0, np.intp)
        shown = steadied(ranges, np.zeros(ranges.shape, np.uint8), [(pixels, np.ones(len(pixels), np.float32))], camera)
        assert (shown == (0 if metres else 255)).all()
        last = steadied._last
        assert last is not None
        return last.bodies[0][1].side if last.bodies else 0

    assert side_at(0.5) == 16
    if nobody_between:
        assert side_at(0.0) == 0
    sides = [side_at(metres) for metres in (0.7, 0.9, 2.0, 4.0)]  # sizes seldom change
    assert sides == ([11, 11, 4, 2] if nobody_between else [16, 9, 4, 2])


def test_the_area_of_parts_is_that_of_cells_of_either_size() -> None:
    points = np.zeros((400, 3), np.float32)
    points[:, 2] = 1
    labels = np.zeros(400, np.uint8)
    normals, around = np.zeros((100, 3), np.float32), np.zeros((100, 4), np.int64)
    earlier = Cells(np.zeros(100, np.int32), points[:100] + np.float32(0.1), normals, around, labels[:100], 0.0)
    _, alike = part_shifts(points, labels, earlier._replace(points=np.tile(earlier.points, (4, 1)), labels=labels))
    shifts, weights = part_shifts(points, labels, earlier, larger=4.0)
    np.testing.assert_allclose(weights, alike)
    np.testing.assert_allclose(shifts, 0.1, rtol=1e-4)
