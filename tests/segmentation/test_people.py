"""People and things: measures of known shapes, the score, and what a segmenter does with it."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from benches.model.things.rooms import rooms_of
from label_networks import Places
from numpy.typing import NDArray
from PIL import Image

from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.rigs import Camera, load_sensor
from bodyseg_model.networks import load_network
from bodyseg_model.segmentation import Background, PersonScore, Segmenter, shipped_score
from bodyseg_model.segmentation.person_score import (
    MEASURES,
    SeenShape,
    SurfaceShape,
    shipped_shape_network,
    surface_shape,
)

CAMERA = Camera(240, 320, 262.5, (160.0, 120.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))

Frame = NDArray[np.float32]


def board(z: float = 2.0, slant: float = 0.3) -> Frame:
    """A slanted board, 0.6 m wide and 1 m high."""
    rays = CAMERA.pixel_rays()
    depth = z / (1 + slant * rays[..., 0])
    x, y = rays[..., 0] * depth, rays[..., 1] * depth
    return np.where((abs(x) < 0.3) & (abs(y) < 0.5), depth, 0).astype(np.float32)


def column(z: float = 2.0, radius: float = 0.15) -> Frame:
    """An upright cylinder, 1 m high."""
    rays = CAMERA.pixel_rays()
    a, b, c = 1 + rays[..., 0] ** 2, z, z**2 - radius**2
    root = b**2 - a * c
    depth = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 0)
    return np.where(abs(rays[..., 1] * depth) < 0.5, depth, 0).astype(np.float32)


def shape_of(frame: Frame) -> dict[str, float]:
    found = surface_shape(np.flatnonzero(frame), frame, CAMERA)
    return dict(zip(MEASURES, found.measures.tolist(), strict=True))


def noisy(frame: Frame, sigma_m: float) -> Frame:
    noise = np.random.default_rng(0).normal(0, sigma_m, frame.shape)
    return np.where(frame > 0, frame + noise, 0).astype(np.float32)


@pytest.mark.parametrize("sigma_m", [0.0, 0.003, 0.01])
def test_boards_are_flat_and_columns_are_not(sigma_m: float) -> None:
    flat, bent = shape_of(noisy(board(), sigma_m)), shape_of(noisy(column(), sigma_m))
    assert flat["flat share"] > 0.93 and bent["flat share"] < 0.75
    assert bent["flat share across"] < 0.5 and bent["flat share down"] > 0.9, "a column is straight from top to bottom"
    # d² / r for cells of 5 cm on a radius of 15 cm, and more at the sides; in centimetres.
    assert 1.3 < bent["curvature across"] < 4 and abs(flat["curvature across"]) < 0.5
    assert bent["log curved share"] > flat["log curved share"] + 1


def test_sizes_are_in_metres() -> None:
    found = shape_of(board(slant=0.0))
    assert found["width"] == pytest.approx(0.6, abs=0.03) and found["height"] == pytest.approx(1.0, abs=0.03)
    assert found["depth"] == pytest.approx(0, abs=1e-6) and math.exp(found["log area"]) == pytest.approx(0.6, rel=0.05)
    assert found["area of bounding box"] == pytest.approx(1, abs=0.05) and found["filled cells"] > 0.9
    near, far = (math.exp(shape_of(board(z, 0.0))["log area"]) for z in (1.0, 3.0))
    assert near == pytest.approx(far, rel=0.08), "whatever the distance, and however many pixels are read"


@pytest.mark.parametrize("pixels", [[0], [5, 6], list(range(0, 76800, 320))])
def test_slight_surfaces_are_measured_and_judged_too(pixels: list[int]) -> None:
    frame = np.full((240, 320), 0.8, np.float32)
    found = surface_shape(np.array(pixels), frame, CAMERA)
    assert np.isfinite(found.measures).all() and math.isfinite(shipped_shape_network()(found))


def test_cells_are_means_of_five_centimetres() -> None:
    frame = board(slant=0.0)
    cells = surface_shape(np.flatnonzero(frame), frame, CAMERA).cells
    assert abs(cells.shape[0] - 20) <= 1 and abs(cells.shape[1] - 12) <= 1, "of 1 m x 0.6 m"
    np.testing.assert_allclose(cells[:-1, :-1], 2.0, rtol=1e-6)
    hole = frame.copy()
    hole[110:130, 150:170] = 0
    cells = surface_shape(np.flatnonzero(hole), hole, CAMERA).cells
    assert np.isnan(cells[9:11, 5:7]).any() and np.isfinite(cells[:6, :-1]).all()


# The score.


def always(odds: float) -> Callable[[SurfaceShape], float]:
    return lambda shape: odds


def flat_is_thing(shape: SurfaceShape) -> float:
    """Boards are flat."""
    return 8.0 - 10.0 * float(shape.measures[MEASURES.index("flat share")])


def test_a_score_is_the_probability_of_a_persons_shape() -> None:
    frame = column()
    pixels = np.flatnonzero(frame)
    for odds, expected in ((3.0, 1 / (1 + math.exp(-3))), (0.0, 0.5), (1e9, 1.0), (-1e9, 0.0)):
        score = PersonScore(always(odds), 0.5)
        assert score(score.seen(pixels, frame, CAMERA)) == pytest.approx(expected, abs=1e-300)
    with pytest.raises(BadConfig, match="^a score of people needs a cutoff from 0 to 1, found 2.0$"):
        PersonScore(always(0.0), 2.0)


def test_what_counts_for_a_person() -> None:
    """The confidence of a large surface without noise; doubts by the shape count against it, noise and size for it."""
    score = PersonScore(always(0.0), 0.5, by_confidence=True)
    assert score(SeenShape(3.0, 0.01, 0.5), 0.6) == pytest.approx(0.6)
    doubted = score(SeenShape(-5.0, 0.01, 0.5), 0.6)
    assert math.log(doubted / (1 - doubted)) == pytest.approx(math.log(1.5) - 1.0)
    assert score(SeenShape(-50.0, 0.01, 0.5), 0.6) == score(SeenShape(-6.0, 0.01, 0.5), 0.6) < doubted
    assert score(SeenShape(3.0, 0.06, 0.5), 0.6) > 0.65 and score(SeenShape(3.0, 0.01, 0.1), 0.6) > 0.75
    assert 0 < score(SeenShape(3.0, 0.0, 0.0), 0.0) < score(SeenShape(3.0, 0.0, 0.5), 1.0) < 1
    assert score.rules_out(SeenShape(-7.0, 0.01, 0.5))
    assert not score.rules_out(SeenShape(-9.0, 0.08, 0.5)), "a noisy person's shape may be far from a person's"


@pytest.mark.parametrize(("sigma_m", "least"), [(0.0, 0.0), (0.03, 0.028), (0.08, 0.07)])
def test_noise_of_ranges_is_estimated(sigma_m: float, least: float) -> None:
    frame = noisy(board(), sigma_m)
    found = surface_shape(np.flatnonzero(frame), frame, CAMERA).noise_m
    assert least <= found <= 1.15 * sigma_m + 0.002


def test_the_limit_belongs_to_a_networks_card() -> None:
    alone, network = shipped_score({}), shipped_shape_network()
    assert not alone.by_confidence and alone.cutoff == network.cutoff and alone.by_shape is network
    assert shipped_score() == shipped_score(load_network().card) and shipped_score().by_confidence
    assert shipped_score({"least_confidence_of_people": 0.7}).cutoff == 0.7
    for bad in (2, "high", [0.5]):
        with pytest.raises(BadConfig, match="^a score of people needs a cutoff from 0 to 1, found "):
            shipped_score({"least_confidence_of_people": bad})


def test_a_thing_is_not_shown_to_the_network() -> None:
    frame = np.maximum(np.roll(board(slant=0.0), -60, axis=1), np.roll(column(), 60, axis=1))
    network = Places(0, 10)
    found = Segmenter(network, CAMERA, people=PersonScore(flat_is_thing, 0.5))(frame)
    assert len(network.seen) == len(found.bodies) == len(found.things) == 1
    (thing,) = found.things
    assert thing.mean_confidence is None and thing.person < 0.5 and thing.median_range_m == pytest.approx(2.0)
    np.testing.assert_array_equal(thing.pixels, np.flatnonzero(np.roll(board(slant=0.0), -60, axis=1)))
    assert (found.labels.ravel()[thing.pixels] == BACKGROUND).all()


def test_a_segmenter_labels_people_alone() -> None:
    frame = np.maximum(np.roll(board(slant=0.0), -60, axis=1), np.roll(column(), 60, axis=1))
    everything = Segmenter(Places(0, 10), CAMERA)(frame)
    assert len(everything.bodies) == 2 and not everything.things and everything.bodies[0].person is None
    found = Segmenter(Places(0, 10), CAMERA, people=PersonScore(flat_is_thing, 0.5))(frame)
    (person,), (thing,) = found.bodies, found.things
    assert person.person is not None and thing.person < 0.5 <= person.person
    assert (found.labels.ravel()[thing.pixels] == BACKGROUND).all()
    np.testing.assert_array_equal(
        found.labels.ravel()[person.pixels], everything.labels.ravel()[everything.bodies[1].pixels]
    )
    assert found.pixels == len(person.pixels) and min(found.milliseconds[stage] for stage in ("shape", "network")) > 0
    doubting = PersonScore(always(9.0), 0.6, by_confidence=True)
    doubted = Segmenter(Places(0, 10, sure_m=0.1), CAMERA, people=doubting)(frame)
    assert not doubted.bodies and [len(thing.pixels) for thing in doubted.things] == [
        len(body.pixels) for body in everything.bodies
    ]
    assert doubted.things[0].mean_confidence == pytest.approx(0.52, abs=0.01)
    assert (doubted.labels == BACKGROUND).all()
    kept = Segmenter(Places(0, 10), CAMERA, Background("keep"), people=PersonScore(always(-9.0), 0.5))(frame)
    assert len(kept.bodies) == 1 and not kept.things, "who keeps all that was measured has said what it is"


def test_people_in_made_rooms_are_kept_and_most_things_are_not() -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    (maker, _) = rooms_of("open", "test", seed=7, parts=False, most=6)
    segmenter = Segmenter(load_network().network, maker.camera, people=shipped_score())
    people = lost = things = labelled = 0
    for number in range(6):
        room = maker(number)
        result = segmenter(room.range_m)
        for body, kept in [(body, True) for body in result.bodies] + [(body, False) for body in result.things]:
            share = (room.person.ravel()[body.pixels] >= 0).mean()
            people, lost = people + (share > 0.5), lost + (share > 0.5 and not kept)
            things, labelled = things + (share < 0.1), labelled + (share < 0.1 and kept)
    torch.set_num_threads(before)
    assert people >= 5 and things >= 5 and lost <= 1 and labelled <= things / 3


@pytest.mark.parametrize(
    ("sequence", "names"),
    [
        ("kinect_v1", [f"{number:010d}_depth.png" for number in range(0, 100, 9)]),
        ("kinect_v2", ["01.png", "02.png", "03.png"]),
    ],
)
def test_real_people_are_kept(sequence: str, names: list[str], shared_data: Callable[[str], Path]) -> None:
    folder = shared_data(f"real/{sequence}")
    camera = load_sensor(sequence).camera
    segmenter = Segmenter(load_network().network, camera, people=shipped_score())
    for name in names:
        with Image.open(folder / name) as picture:
            found = segmenter((np.asarray(picture) / 1000).astype(np.float32))
        assert found.bodies and len(found.bodies[0].pixels) > 19_000, name
