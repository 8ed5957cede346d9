"""Lens distortion: the formula, its derivative, and what a rig file may say of it."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import Distortion, load_rig, rig_from_json
from bodyseg_data.rigs.rig import parse_sensor

# A Kinect v1's, as N. Burrus published them with his calibration.
KINECT = Distortion(k1=-0.26386, k2=0.99966, p1=-0.00076275, p2=0.0050350, k3=-1.30536)

CAMERA = """format = "bodyseg rig 1"
name = "d1"
[camera]
rows = 480
columns = 640
focal_px = 594.2
distortion = {model = "brown_conrady", k1 = -0.26386, k2 = 0.99966, p1 = -0.00076275, p2 = 0.0050350, k3 = -1.30536}
"""


def test_the_formula_is_opencvs() -> None:
    """At (0.5, 0.25), r^2 = 0.3125; each coefficient alone, worked out by hand."""
    x, y = np.array(0.5), np.array(0.25)
    shifts = {
        name: tuple(float(value) for value in Distortion(**{name: 1.0}).apply(x, y))
        for name in ("k1", "k2", "p1", "p2", "k3")
    }
    assert shifts["k1"] == pytest.approx((0.5 * 1.3125, 0.25 * 1.3125))
    assert shifts["k2"] == pytest.approx((0.5 * 1.09765625, 0.25 * 1.09765625))
    assert shifts["k3"] == pytest.approx((0.5 * 1.030517578125, 0.25 * 1.030517578125))
    assert shifts["p1"] == pytest.approx((0.5 + 0.25, 0.25 + 0.3125 + 0.125))
    assert shifts["p2"] == pytest.approx((0.5 + 0.3125 + 0.5, 0.25 + 0.25))


@pytest.mark.parametrize("seed", range(20))
def test_folding_is_found_where_the_derivative_says_so(seed: int) -> None:
    """At each point, the derivative by differences has a positive determinant and trace, or it has not."""
    draws = np.random.default_rng(seed)
    lens = Distortion(*(draws.normal(size=5) * (0.6, 0.6, 0.4, 0.4, 0.6)))
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 15), np.linspace(-0.5, 0.5, 15))
    h = 1e-6
    across = [(a - b) / (2 * h) for a, b in zip(lens.apply(x + h, y), lens.apply(x - h, y), strict=True)]
    down = [(a - b) / (2 * h) for a, b in zip(lens.apply(x, y + h), lens.apply(x, y - h), strict=True)]
    determinant, trace = across[0] * down[1] - across[1] * down[0], across[0] + down[1]
    expected = (determinant > 0) & (trace > 0)
    assert lens.is_one_to_one(x, y) == expected.all()
    assert [lens.is_one_to_one(*point) for point in zip(x.ravel(), y.ravel(), strict=True)] == expected.ravel().tolist()


def test_both_answers_occur_among_lenses_drawn() -> None:
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 65), np.linspace(-0.5, 0.5, 65))
    assert KINECT.is_one_to_one(x * 0.5, y * 0.5)
    assert not Distortion(k1=-1.0).is_one_to_one(x, y)
    assert not Distortion(k1=1e6, k3=-1e6).is_one_to_one(x * 1e60, y)


def test_a_rig_file_may_hold_distortion() -> None:
    camera = parse_sensor(CAMERA, "x").camera
    assert camera.distortion == KINECT
    assert camera.to_json()["distortion"] == {
        "model": "brown_conrady",
        **dict(zip(("k1", "k2", "p1", "p2", "k3"), (-0.26386, 0.99966, -0.00076275, 0.0050350, -1.30536), strict=True)),
    }
    few = parse_sensor(CAMERA.replace(", p1 = -0.00076275, p2 = 0.0050350, k3 = -1.30536", ""), "x").camera
    assert few.distortion == Distortion(k1=-0.26386, k2=0.99966)


def test_a_stored_rig_keeps_distortion_and_its_images_ignore_it() -> None:
    rig = load_rig()
    bent = replace(rig, camera=replace(rig.camera, distortion=Distortion(k1=-0.1)))
    assert rig_from_json(json.loads(json.dumps(bent.to_json()))) == bent != rig
    assert np.array_equal(bent.camera.pixel_rays(), rig.camera.pixel_rays())
    with pytest.raises(BadConfig, match="^a projector has no lens distortion, found Distortion"):
        replace(rig, projector=bent.camera)
    tree: Any = bent.to_json()
    tree["projector"]["distortion"] = tree["camera"]["distortion"]
    with pytest.raises(BadConfig, match=r"^a stored rig, \[projector\]: unknown 'distortion'$"):
        rig_from_json(tree)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"brown_conrady"', '"fisheye"', r"\[distortion\]: 'model' must be 'brown_conrady', found 'fisheye'"),
        ('model = "brown_conrady", ', "", r"\[distortion\]: text 'model' is missing"),
        ("k1 = ", "k7 = ", r"\[distortion\]: unknown 'k7'"),
        ("k1 = -0.26386", "k1 = nan", r"\[distortion\]: 'k1' must be a finite number"),
        ("k1 = -0.26386", "k1 = 2e6", r"\[distortion\]: Distortion: k1 must be from -1e\+06 to 1e\+06, found 2"),
        ("k1 = -0.26386", "k1 = -2.6", r"lens distortion must not fold the image over, found Distortion\(k1=-2.6"),
        ("p2 = 0.0050350", "p2 = 0.6", "lens distortion must not fold the image over"),
    ],
)
def test_broken_distortion_is_refused_in_one_line(old: str, new: str, message: str) -> None:
    assert old in CAMERA
    with pytest.raises(BadConfig, match=message) as caught:
        parse_sensor(CAMERA.replace(old, new), "x")
    assert str(caught.value).startswith("rig x, [camera]") and "\n" not in str(caught.value)
