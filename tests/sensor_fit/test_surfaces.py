"""Local surfaces, where the answer is known."""

from __future__ import annotations

import numpy as np
import pytest
from known_sensors import RIG

from bodyseg_model.sensor_fit.recording import smooth_surface, third_differences

CAMERA = RIG.camera


def test_a_plane_is_found_with_its_slope() -> None:
    rays = CAMERA.pixel_rays()
    normal = np.array([np.sin(0.7), 0.0, -np.cos(0.7)])
    z = (-2.0 * np.cos(0.7)) / (rays @ normal)
    known = np.zeros(z.shape, np.bool_)
    known[200:260, 100:160] = True
    surface, slope = smooth_surface(z, known, 0.0, CAMERA)
    inside = np.s_[205:255, 105:155]
    np.testing.assert_allclose(surface[inside], z[inside], atol=1e-5)
    np.testing.assert_allclose(slope[inside], np.gradient(z, axis=1)[inside] * CAMERA.focal_px / z[inside], atol=1e-3)
    assert abs(slope[230, 112] - np.tan(0.7)) < 0.01, "at the image's middle a slope is the tangent of its angle"
    assert np.isfinite(surface[201:259, 103:157]).all() and np.isnan(surface[200, 100]) and np.isnan(surface[100, 50])


def test_noise_widens_the_window() -> None:
    noise = 0.01 * np.random.default_rng(0).standard_normal((CAMERA.rows, CAMERA.columns))
    known = np.ones(noise.shape, np.bool_)
    narrow, wide = (smooth_surface(2 + noise, known, sigma, CAMERA)[0][20:-20, 20:-20] for sigma in (0.0, 0.01))
    assert np.std(wide) < 0.5 * np.std(narrow) < 0.003


def test_nothing_known_gives_no_surface() -> None:
    empty = np.zeros((CAMERA.rows, CAMERA.columns))
    assert np.isnan(smooth_surface(empty, empty > 0, 0.0, CAMERA)[0]).all()


@pytest.mark.parametrize("sigma", [0.0, 0.004])
def test_third_differences_keep_noise_and_cancel_quadratics(sigma: float) -> None:
    v, u = np.mgrid[:120, :150] / 50
    noise = sigma * np.random.default_rng(0).standard_normal(v.shape)
    values = third_differences(2 + 0.3 * u + 0.2 * v * u + 0.1 * v**2 + noise, np.ones(v.shape, np.bool_))
    assert len(values) == 120 * 147 + 117 * 150
    assert np.std(values) == pytest.approx(sigma, rel=0.03, abs=1e-12)
