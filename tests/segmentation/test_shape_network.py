"""The network that tells people from things by their shape: what it sees, and the file of its weights."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from bodyseg_data.core import BadConfig
from bodyseg_model.segmentation import person_score
from bodyseg_model.segmentation.person_score import (
    shape_image,
    shipped_shape_network,
    with_curvature,
)


def test_a_surface_lies_in_the_middle_of_its_image() -> None:
    cells = np.array([[2.0, 2.2, np.nan], [2.0, 1.8, 9.0]])
    image = shape_image(cells)
    assert image.shape == (2, 48, 48) and image.dtype == np.float32
    np.testing.assert_array_equal(image[1, 23:25, 22:25], [[1, 1, 0], [1, 1, 1]])
    np.testing.assert_allclose(image[0, 23:25, 22:25], [[0, 0.5, 0], [0, -0.5, 2]], atol=1e-6)
    assert image[1].sum() == 5, "and nothing elsewhere"


@pytest.mark.parametrize("size", [47, 48, 49, 50, 80])
def test_of_large_surfaces_the_middle_is_seen(size: int) -> None:
    cells = np.full((size, 3), 2.0)
    cells[size // 2, 1] = 2.4
    image = shape_image(cells)
    assert image[1].sum() == 3 * min(size, 48)
    (row, column), *others = np.argwhere(image[0] > 0.5)
    assert not others and abs(row - 24) <= 1 and column == 23


def test_nothing_measured_is_an_empty_image() -> None:
    assert not with_curvature(shape_image(np.full((4, 4), np.nan))).any()


def test_curvature_is_the_range_from_the_mean_around() -> None:
    plane = 2.0 + 0.01 * np.arange(9)[:, None] + 0.02 * np.arange(9)[None]
    bulge = with_curvature(shape_image(plane))[2, 19:28, 19:28]
    np.testing.assert_allclose(bulge[1:-1, 1:-1], 0, atol=1e-4)
    assert abs(bulge[0, 0]) > 0.1, "on a border the mean is of cells on one side"
    plane[4, 4] -= 0.009
    bulge = with_curvature(shape_image(plane))[2, 19:28, 19:28]
    # Eight ninths of 9 mm, in units of 3 cm; a ninth for the cells around.
    assert bulge[4, 4] == pytest.approx(-0.8 / 3, abs=1e-3) and bulge[4, 5] == pytest.approx(0.1 / 3, abs=1e-3)
    images = np.stack([shape_image(plane), shape_image(plane.T)])
    np.testing.assert_array_equal(with_curvature(images)[1], with_curvature(images[1]))


def test_the_network_that_ships_names_its_source(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    tree = json.loads((resources.files("bodyseg_model") / "weights" / person_score.FILE).read_text())
    assert tree["source"]["command"].startswith("tools/bench shapes") and tree["source"]["fitted to"]["people"] > 5000
    assert 0.01 < shipped_shape_network().cutoff < 0.5
    (tmp_path / "other.json").write_text(json.dumps({"format": "bodyseg shape network 0"}))
    monkeypatch.setattr(person_score, "FILE", str(tmp_path / "other.json"))
    shipped_shape_network.cache_clear()
    with pytest.raises(BadConfig, match="'format' must be 'bodyseg shape network 2', found 'bodyseg shape network 0'$"):
        shipped_shape_network()
    shipped_shape_network.cache_clear()
