"""Furniture: closed surfaces that turn outwards, stand on the floor, and follow from their numbers."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from shapes import mean_by_place

from bodyseg_data.core import Draws
from bodyseg_data.meshes import Solid, cuboid, together, turned_solid
from bodyseg_data.packing import FURNITURE, Numbers

MIRROR = np.diag([1.0, 1.0, -1.0])


def numbers(seed: int) -> Numbers:
    return Numbers(Draws(seed, 0, "k"), "test")


def volume(solid: Solid) -> float:
    """Enclosed volume; negative if faces point inwards."""
    a, b, c = np.moveaxis(solid.vertices[solid.faces], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def is_closed(solid: Solid) -> bool:
    """True if every edge is traversed as often one way as the other."""
    sides = Counter[tuple[int, int]]()
    for a, b in solid.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).tolist():
        sides[min(a, b), max(a, b)] += 1 if a < b else -1
    return not any(sides.values())


def test_a_cuboid_has_its_size_and_its_place() -> None:
    solid = cuboid((0.4, 2.0, 1.0), (1.0, 2.0, 3.0))
    assert volume(solid) == pytest.approx(0.8) and is_closed(solid)
    assert np.allclose(solid.vertices.min(axis=0), (0.8, 1.0, 2.5))
    assert np.allclose(solid.vertices.max(axis=0), (1.2, 3.0, 3.5))
    assert np.allclose(np.abs(solid.normals).sum(axis=0), [2 * 2 * 2.0, 2 * 2 * 0.4, 2 * 2 * 0.8])


def test_a_turned_solid_has_the_volume_of_its_cones() -> None:
    solid = turned_solid([(0.3, 0.0), (0.2, 0.5), (0.4, 0.6)])
    of_circle = 24 / 2 * math.sin(2 * math.pi / 24) / math.pi  # of 24 segments
    cones = [(0.3, 0.2, 0.5), (0.2, 0.4, 0.1)]
    expected = sum(math.pi * height / 3 * (a * a + a * b + b * b) for a, b, height in cones)
    assert volume(solid) == pytest.approx(of_circle * expected, rel=1e-9) and is_closed(solid)


@pytest.mark.parametrize("axes", [np.eye(3), MIRROR], ids=["rotation", "mirroring"])
def test_normals_point_outwards_in_any_frame(axes: np.ndarray) -> None:
    placed = cuboid((1.0, 1.0, 1.0), (0.0, 0.0, 5.0)).turned(0.4).moved((1.0, 0.0, 0.0)).placed(axes, np.ones(3))
    assert volume(placed) == pytest.approx(1.0)
    middle = placed.vertices.mean(axis=0)
    outwards = placed.vertices[placed.faces].mean(axis=1) - middle
    assert (np.einsum("ij,ij->i", outwards, placed.normals) > 0).all()


@pytest.mark.parametrize("kind", FURNITURE)
def test_things_are_closed_and_stand_on_the_floor(kind: str) -> None:
    for seed in range(20):
        thing = FURNITURE[kind](numbers(seed))
        low, high = thing.vertices.min(axis=0), thing.vertices.max(axis=0)
        assert is_closed(thing) and volume(thing) > 0
        assert -1e-9 <= low[1] < (1.7 if kind == "plank" else 1e-9) and high[1] <= 2.2
        assert max(high[0] - low[0], high[2] - low[2]) <= 2.3
        again = FURNITURE[kind](numbers(seed))
        assert np.array_equal(thing.vertices, again.vertices) and np.array_equal(thing.faces, again.faces)


DRAWN = {
    "box": 0.1733991, "table": 0.1660551, "chair": 0.1709488, "bed": 0.0077754, "machine": 0.1680164,
    "bin": 0.1002761, "plant": 0.2190934, "lamp": 0.1968406, "plank": 0.2962608,
}  # fmt: skip


def test_things_stay_as_they_were_drawn() -> None:
    """Others are other bytes of sets with things, and need a new `PACKING_VERSION`."""
    for kind, make in FURNITURE.items():
        places = np.concatenate([make(numbers(seed)).vertices for seed in range(8)])
        assert mean_by_place(places) == pytest.approx(DRAWN[kind], abs=1e-6), kind


def test_numbers_are_those_of_the_stream() -> None:
    drawn = numbers(1)
    several = [drawn.between(-2.0, 3.0) for _ in range(400)] + [drawn.whole(1, 4) for _ in range(400)]
    assert -2 <= min(several[:400]) < -1.9 and 2.9 < max(several[:400]) < 3
    assert Counter(several[400:]).keys() == {1, 2, 3, 4} and min(Counter(several[400:]).values()) > 70
    assert [numbers(1).between(0, 1) for _ in range(2)] == [(several[0] + 2) / 5] * 2


def test_nothing_together_has_no_faces() -> None:
    empty = together([])
    assert empty.vertices.shape == (0, 3) and empty.faces.shape == (0, 3) and empty.faces.dtype == np.int32
