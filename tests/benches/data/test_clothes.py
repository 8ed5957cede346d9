"""The bench of clothes: what counts as roughness, and what does not."""

from __future__ import annotations

import numpy as np
import pytest
from benches.data.surface import clothes

from bodyseg_data.bodies.sources.open_bodies import OpenBodies

pytestmark = pytest.mark.usefixtures("quick_geodesics")


def image(noise_mm: float) -> np.ndarray:
    rows, columns = np.mgrid[0:90, 0:60] / 200
    smooth = 2.5 + 0.3 * rows - 0.2 * columns + 0.1 * rows * columns + 0.2 * columns**2
    return (smooth + np.random.default_rng(0).normal(0, noise_mm / 1e3, rows.shape)).astype(np.float32)


@pytest.mark.parametrize(("noise_mm", "expected"), [(0.0, 0.0), (1.0, 1.0), (3.0, 3.0)])
def test_roughness_is_what_a_quadratic_surface_leaves(noise_mm: float, expected: float) -> None:
    found = clothes._residuals(image(noise_mm), np.ones((90, 60), bool))
    assert len(found) == 16 * 10
    # Six of a window's 225 numbers are fitted away.
    assert np.median(found) == pytest.approx(expected * np.sqrt(1 - 6 / 225), rel=0.03, abs=2e-3)


def test_windows_with_an_edge_or_a_hand_do_not_count() -> None:
    stepped, wanted = image(0.0), np.ones((90, 60), bool)
    stepped[45:] += 0.2
    wanted[:, 30:] = False
    found = clothes._residuals(stepped, wanted)
    assert 0 < len(found) < 16 * 4
    assert found.max() < 2e-3


def test_the_bench_writes_what_it_promises(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clothes, "AZIMUTHS", (0,))
    monkeypatch.setattr(clothes, "FRAMES", 1)
    listed = OpenBodies().bodies()
    few = [next(body for body in listed if body.subset == subject) for subject in ("B", "C")]
    monkeypatch.setattr(OpenBodies, "bodies", lambda self: few)
    figures = clothes.bench_clothes()
    assert set(figures) == {"bodies", "frames_per_motion", "azimuths", "distance_cm"}
    for rows in figures["bodies"].values():
        assert rows["roughness_mm"]["dressed"]["50%"] > 1.2 * rows["roughness_mm"]["bare"]["50%"]
        assert 5 < rows["distance_mm"]["50%"] < 50
