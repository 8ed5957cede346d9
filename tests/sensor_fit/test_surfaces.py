"""Local surfaces, where the answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from known_sensors import RIG

from bodyseg_model.sensor_fit.recording import smooth_surface, third_differences

CAMERA = RIG.camera


def test_a_plane_is_found_with_its_incidence() -> None:
    rays = CAMERA.pixel_rays()
    normal = np.array([np.sin(0.7), 0.0, -np.cos(0.7)])
    z = (-2.0 * np.cos(0.7)) / (rays @ normal)
    known = np.zeros(z.shape, np.bool_)
    known[200:260, 100:160] = True
    surface = smooth_surface(z, known, CAMERA, 3)
    inside = np.s_[205:255, 105:155]
    np.testing.assert_allclose(surface.range_m[inside], z[inside], atol=1e-5)
    cosine = np.abs(rays @ normal) / np.linalg.norm(rays, axis=-1)
    np.testing.assert_allclose(surface.incidence_rad[inside], np.arccos(cosine)[inside], atol=1e-3)
    assert np.isnan(surface.range_m[100, 50]) and not surface.at(np.ones_like(known))[100, 50]
    assert np.isfinite(surface.range_m[200:260, 103:157]).all() and np.isnan(surface.range_m[200, 100])
    assert (surface.misfit_m[inside] < 1e-5).all()


def test_nothing_known_gives_no_surface() -> None:
    empty = np.zeros((CAMERA.rows, CAMERA.columns))
    assert np.isnan(smooth_surface(empty, empty > 0, CAMERA, 3).range_m).all()


@pytest.mark.parametrize("sigma", [0.0, 0.004])
def test_third_differences_keep_noise_and_cancel_quadratics(sigma: float) -> None:
    v, u = np.mgrid[:120, :150] / 50
    noise = sigma * np.random.default_rng(0).standard_normal(v.shape)
    values, pixels = third_differences(2 + 0.3 * u + 0.2 * v * u + 0.1 * v**2 + noise, np.ones(v.shape, np.bool_))
    assert len(values) == len(pixels) == 120 * 147 + 117 * 150
    assert np.std(values) == pytest.approx(sigma, rel=0.03, abs=1e-12)
