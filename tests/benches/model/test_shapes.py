"""`bench shapes`: the fit of the network of shapes, and what the bench writes."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
import torch
from benches.model.things import shapes as bench
from benches.model.things.rooms import Rooms
from benches.model.things.shapes import Shapes, bench_shapes, fitted, logits, quality
from fakes import Figures

from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import load_sensor
from bodyseg_model.segmentation.person_score import (
    MEASURES,
    SHAPES,
    ShapeNetwork,
    network_from_json,
    shape_image,
    with_curvature,
)


def balls_and_boards(count: int = 320, seed: int = 0) -> Shapes:
    """Half balls, which are to be people, half flat squares, with noise; measures say nothing."""
    draws = np.random.default_rng(seed)
    images, person = [], np.arange(count) % 2 == 0
    across, down = np.meshgrid(np.linspace(-1, 1, 12), np.linspace(-1, 1, 12))
    for ball in person:
        bulge = 0.2 * np.sqrt(np.maximum(1 - across**2 - down**2, 0)) if ball else np.zeros((12, 12))
        images.append(shape_image(2.0 - bulge + draws.normal(0, 0.003, (12, 12))))
    measures = draws.normal(size=(count, len(MEASURES)))
    measures[:, MEASURES.index("log area")] = 0.0
    return Shapes(np.stack(images), measures, person, np.arange(count))


def test_a_fit_tells_balls_from_boards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench, "_EPOCHS", 12)
    network = fitted(balls_and_boards())
    others = balls_and_boards(60, seed=1)
    found = logits(network, others)
    assert found[others.person].min() > found[~others.person].max()
    again = fitted(balls_and_boards())
    assert all(np.array_equal(weight, again.weights[name]) for name, weight in network.weights.items())


def test_numpy_computes_what_pytorch_fitted() -> None:
    torch.manual_seed(3)
    draws = np.random.default_rng(3)
    fit = bench._Fit(torch.randn(len(MEASURES)), torch.rand(len(MEASURES)) + 0.5).eval()
    network = fit.network()
    for cells in (draws.normal(2, 0.2, (40, 18)), draws.normal(1, 0.01, (60, 50)), np.full((3, 2), np.nan)):
        image, measures = shape_image(cells), draws.normal(size=len(MEASURES))
        with torch.no_grad():
            seen = torch.from_numpy(with_curvature(image))[None], torch.from_numpy(measures).float()[None]
            expected = float(fit(*seen))
        assert network.logit(image, measures) == pytest.approx(expected, abs=1e-4)


def test_who_is_lost_at_which_cutoff() -> None:
    shapes = balls_and_boards(40)
    weights = {name: np.zeros(shape, np.float32) for name, shape in SHAPES.items()}
    weights["hidden.weight"][0, -len(MEASURES)] = 1  # the first measure
    weights["out.weight"][0, 0] = 1
    shapes.measures[:, 0] = np.where(shapes.person, 3.0, 1.0)
    shapes.measures[0, 0] = 0.5  # a person
    shapes.measures[1, 0] = 4.0  # a thing
    found = quality(ShapeNetwork(weights, cutoff=1 / (1 + np.exp(-2.0))), shapes)
    assert (found["people"], found["people_lost"], found["things"]) == (20, 1, 20)
    assert found["things_dropped"] == pytest.approx(0.95)
    assert found["things_dropped_where_people_lost"] == {"0": 0.0, "1": 0.95, "2": 0.95, "5": 0.95, "10": 0.95}
    assert found["lowest_people"] == [0.5, 3.0, 3.0, 3.0, 3.0]
    small = Shapes(shapes.images, shapes.measures - 9.0, shapes.person, shapes.room)
    assert not small.large.any() and shapes.large.all()


def test_augmented_images_are_moved_and_erased_in_both_channels() -> None:
    images = balls_and_boards(64).images
    kept = images.copy()
    found = bench._augmented(images, np.random.default_rng(0))
    np.testing.assert_array_equal(images, kept)
    assert found.shape == images.shape and not np.array_equal(found, images)
    assert (found[:, 0][found[:, 1] == 0] == 0).all() and set(np.unique(found[:, 1])) == {0, 1}
    pixels = found[:, 1].sum(axis=(1, 2))
    assert (pixels <= 144).all() and 0.1 < (pixels < 144).mean() < 0.5


def test_what_the_bench_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    source = Figures()
    camera = load_sensor("kinect_v2").camera
    asked: list[tuple[str, str, int, bool]] = []

    def rooms_of(name: str, split: str, seed: int, parts: bool, touching: bool) -> list[Any]:
        asked.append((name, split, seed, touching))
        return [Rooms(source, list(source.bodies())[:2], camera, seed, parts, touching)]

    class Pool:
        """In this process, which knows the made bodies."""

        def __init__(self, *options: Any) -> None: ...

        def __enter__(self) -> Any:
            return self

        def __exit__(self, *error: object) -> None: ...

        map = staticmethod(map)

    bench._makers.cache_clear()
    monkeypatch.setattr(bench, "rooms_of", rooms_of)
    monkeypatch.setattr(bench, "ProcessPoolExecutor", Pool)
    monkeypatch.setattr(bench, "_ROOMS_A_TASK", 2)
    monkeypatch.setattr(bench, "_EPOCHS", 1)
    seen: list[tuple[int, int]] = []
    figures = bench_shapes(views=22, progress=lambda done, total: seen.append((done, total)))
    bench._makers.cache_clear()
    assert seen == [*((done, 25) for done in range(2, 24, 2)), (23, 25), (24, 25), (25, 25)]
    assert asked == [
        ("wide", "train", 11, False),
        ("everyday", "train", 13, True),
        ("wide", "train", 12, True),
        ("open", "test", 31, False),
        ("hard", "test", 32, False),
        ("open", "test", 33, True),
    ]
    assert list(figures["measured"]) == ["held out", "open", "hard", "touching"]
    network = network_from_json(json.loads(json.dumps(figures["network"])))
    assert 0 < network.cutoff < 1 and figures["network"]["source"]["command"] == "tools/bench shapes --views 22"


def test_rooms_without_people_fit_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    shapes = balls_and_boards(64)
    nobody = Shapes(shapes.images, shapes.measures - 9.0, shapes.person, shapes.room)
    monkeypatch.setattr(bench, "seen_shapes", lambda plans, count, progress: nobody)
    monkeypatch.setattr(bench, "_EPOCHS", 1)
    with pytest.raises(BadConfig, match="^no person shows 0.1 m² in the rooms held out: give bench shapes more --vie"):
        bench_shapes(views=22)
