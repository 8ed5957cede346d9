"""Lenses as drivers describe them: all become five coefficients, exactly or to a pixel, or one line."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pngs import png

from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import Distortion
from bodyseg_model.recordings import FrameCameras, Skipping, find_frames, frame_camera
from bodyseg_model.recordings.cameras import Intrinsics, driver_camera
from bodyseg_model.segmentation import FrameLabeller
from bodyseg_model.segmentation.views import Undistortion

Floats = NDArray[np.float64]
CAMERA = (504.0, 504.0, 319.5, 287.5)
SIZE = (576, 640)
AZURE = (0.5867, -0.0926, 0.002, -0.003, 0.0030, 0.9227, 0.0128, 0.0167)  # p1 and p2 are larger than one has


def five(model: str, *coefficients: float, camera: tuple[float, float, float, float] = CAMERA) -> Distortion | None:
    return driver_camera(model, coefficients, camera, SIZE, "a.mcap: /info").distortion


def directions() -> tuple[Floats, Floats]:
    fx, fy, cx, cy = CAMERA
    x, y = np.meshgrid((np.arange(0, 640, 7) - cx) / fx, (np.arange(0, 576, 7) - cy) / fy)
    return x, y


def check_drawn(found: Distortion | None, across: Floats, down: Floats) -> None:
    assert found is not None
    x, y = found.apply(*directions())
    assert np.hypot(x - across, y - down).max() * CAMERA[0] < 1


@pytest.mark.parametrize("model", ["plumb_bob", "Brown Conrady", "brown-conrady", "rational_polynomial"])
def test_five_coefficients_are_taken_as_they_are(model: str) -> None:
    expected = Distortion(0.01, -0.02, 0.001, 0.002, 0.003)
    assert five(model, 0.01, -0.02, 0.001, 0.002, 0.003) == expected
    assert five(model, 0.01, -0.02, 0.001, 0.002, 0.003, 0, 0, 0) == expected, "zeros behind say nothing"
    assert five(model, 0.01, -0.02, 0.001, 0.002) == Distortion(0.01, -0.02, 0.001, 0.002)
    assert five(model, *[0.0] * 8) is None
    for shape in ((1, 5), (5, 1)):  # as OpenCV's calibration returns them
        matrix = np.reshape([0.01, -0.02, 0.001, 0.002, 0.003], shape)
        driven = driver_camera(model, matrix, CAMERA, SIZE, "a.yml")  # type: ignore[arg-type]
        assert driven.distortion == expected
        assert driven.frame_camera([*SIZE]).camera.distortion == expected  # type: ignore[arg-type]


@pytest.mark.parametrize("behind", [(), (0.0,) * 4, (0.0,) * 6, (0.001, -0.003, 0.002, -0.004)])
def test_an_azure_kinect_s_eight_coefficients_are_fitted(behind: tuple[float, ...]) -> None:
    x, y = directions()
    k1, k2, p1, p2, k3, k4, k5, k6 = AZURE
    r = x * x + y * y
    factor = (1 + k1 * r + k2 * r**2 + k3 * r**3) / (1 + k4 * r + k5 * r**2 + k6 * r**3)
    s1, s2, s3, s4 = (*behind, 0.0, 0.0, 0.0, 0.0)[:4]
    across, down = (
        x * factor + 2 * p1 * x * y + p2 * (r + 2 * x * x) + s1 * r + s2 * r**2,
        y * factor + p1 * (r + 2 * y * y) + 2 * p2 * x * y + s3 * r + s4 * r**2,
    )
    check_drawn(five("rational_polynomial", *AZURE, *behind), across, down)


@pytest.mark.parametrize("model", ["equidistant", "fisheye", "Kannala Brandt4"])
def test_fisheyes_of_moderate_width_are_fitted(model: str) -> None:
    x, y = directions()
    r = np.hypot(x, y)
    theta = np.arctan(r)
    drawn = theta * (1 + 0.05 * theta**2 - 0.01 * theta**4 + 0.04 * theta**6 - 0.05 * theta**8)
    found = five(model, 0.05, -0.01, 0.04, -0.05, 0.0)
    check_drawn(found, x * drawn / r, y * drawn / r)
    unsized = driver_camera(model, (0.05, -0.01, 0.04, -0.05), CAMERA, None, "a.mcap: /info")
    assert unsized.distortion == found, "the principal point is taken for the middle"
    with pytest.raises(BadConfig, match=r"^a.mcap: /info: five coefficients must follow the lens to 1 pixel, found"):
        five(model, 0.05, -0.01, 0.0, 0.0, camera=(150.0, 150.0, 319.5, 287.5))


@pytest.mark.parametrize("model", ["Modified Brown Conrady", "Inverse Brown Conrady"])
def test_realsense_s_forms_are_drawn_as_librealsense_draws_them(model: str) -> None:
    """By `rs2_project_point_to_pixel`, into images aligned to a D455's colour camera, too; all of them are forward."""
    k1, k2, p1, p2, k3 = given = (-0.057, 0.066, 0.004, 0.002, -0.021)
    x, y = directions()
    r = x * x + y * y
    factor = 1 + k1 * r + k2 * r**2 + k3 * r**3
    u, v = x * factor, y * factor
    across, down = u + 2 * p1 * u * v + p2 * (r + 2 * u * u), v + p1 * (r + 2 * v * v) + 2 * p2 * u * v
    found = five(model, *given)
    check_drawn(found, across, down)
    assert found is not None
    off = np.subtract(found.apply(x, y), (across, down))
    assert np.abs(off).max() * CAMERA[0] < 0.05, "five coefficients are nearly enough"


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_coefficients_that_are_no_numbers_are_told_with_their_place(value: float) -> None:
    with pytest.raises(BadConfig, match=r"^a.mcap: /info: Distortion: k1 must be from"):
        five("plumb_bob", value, 0.0, 0.0, 0.0, 0.0)


def test_models_that_are_not_known_are_named() -> None:
    for model, coefficients in (
        ("spherical", (0.1,) * 4),
        ("plumb_bob", (0.1,) * 8),
        ("plumb_bob", (0.1,) * 3),  # k1, k2, k3 would be taken for k1, k2, p1
        ("equidistant", (0.1,)),
        ("rational_polynomial", (1.0,) * 14),
        ("F-Theta", (0.4,) * 5),
    ):
        with pytest.raises(BadConfig) as caught:
            five(model, *coefficients)
        assert f"found {model!r} of {len(coefficients)}" in str(caught.value)
        assert str(caught.value).startswith("a.mcap: /info: distortion must be plumb_bob, of 4 or 5 coefficients")


def test_pixels_that_are_nearly_square_are_resampled() -> None:
    """A point at (x, y, 1) is drawn at (fx x + cx, fy y + cy); without the lens, at one focal length."""
    camera = Intrinsics(105.0, 96.0, 41.5, 29.5, None, (60, 84), "a.json").frame_camera((60, 84)).camera
    assert camera.focal_px == pytest.approx((105 * 96) ** 0.5) and camera.distortion is not None
    frame = np.arange(60 * 84).reshape(60, 84)
    ideal = Undistortion(camera)(frame)
    for x, y in ((0.0, 0.0), (0.2, 0.1), (-0.3, -0.2)):
        column, row = camera.focal_px * x + 42, camera.focal_px * y + 30
        there = frame[int(96 * y + 30), int(105 * x + 42)]
        near = ideal[int(row) - 1 : int(row) + 2, int(column) - 1 : int(column) + 2]
        assert there in near
    assert Intrinsics(100.5, 100.0, 41.5, 29.5, None, None, "").lens is None, "up to 1 % as ever"
    bent = Intrinsics(105.0, 96.0, 41.5, 29.5, Distortion(0.1), None, "").lens
    assert bent is not None and bent.k1 == 0.1 and bent.aspect == pytest.approx((105 / 96) ** 0.5)
    assert bent.turned().aspect == pytest.approx((96 / 105) ** 0.5) and "aspect" in bent.to_json()
    assert "aspect" not in Distortion(0.1).to_json()
    with pytest.raises(BadConfig, match="a.json: .* above 0, and pixels square, found 'fx' 115 and 'fy' 100"):
        Intrinsics(115.0, 100.0, 41.5, 29.5, None, None, "a.json")
    with pytest.raises(BadConfig, match="aspect must be above 0"):
        Distortion(aspect=0.0)


@pytest.mark.parametrize("focal_px", [(0.0, 0.0), (525.0, 0.0), (-525.0, -525.0), (float("nan"), 525.0)])
def test_focal_lengths_of_a_driver_are_above_0(focal_px: tuple[float, float]) -> None:
    with pytest.raises(BadConfig, match="a.json: focal lengths must be above 0"):
        driver_camera("plumb_bob", [0.0] * 5, (*focal_px, 319.5, 239.5), (480, 640), "a.json")


@pytest.mark.parametrize(
    ("focal", "hint"),
    [
        (3.67, "in millimetres"),
        (0.82, "a share of the image"),
        (45.0, "in millimetres"),
        (525_000.0, "in another unit"),
    ],
)
def test_focal_lengths_in_other_units_are_named(focal: float, hint: str, tmp_path: Path) -> None:
    message = (
        f"a focal length must be in pixels, 128 to 32000 for images of 480 x 640, found {focal:.5g}: is it {hint}?"
    )
    (tmp_path / "a.png").write_bytes(png(np.full((480, 640), 2000, np.uint16)))
    with pytest.raises(BadConfig) as caught:
        FrameLabeller().recording(tmp_path / "a.png", focal_px=focal)
    assert str(caught.value) == f"--focal and --centre, {tmp_path / 'a.png'}: {message}"
    (tmp_path / "a.json").write_text(json.dumps({"fx": focal, "fy": focal, "cx": 319.5, "cy": 239.5}))
    frames = find_frames([tmp_path / "a.png"])
    trained = FrameLabeller().rig
    with pytest.raises(BadConfig) as caught:
        FrameCameras(frames, None, None, (), trained, Skipping())
    assert str(caught.value) == f"{tmp_path / 'a.json'}: {message}"


@pytest.mark.parametrize(
    ("centre", "hint"),
    [
        ((0.5, 0.5), "shares of the image"),
        ((319_500.0, -239_500.0), "in another unit"),
        ((320.0, -239_500.0), "in another unit"),
    ],
)
def test_a_principal_point_in_another_unit_is_named(centre: tuple[float, float], hint: str, tmp_path: Path) -> None:
    found = f"found {centre[0]:g} and {centre[1]:g} for images of 480 x 640: are they {hint}?"
    with pytest.raises(BadConfig, match=rf"x.png: a principal point must be in pixels, {re.escape(found)}"):
        frame_camera((480, 640), "x.png", focal_px=525.0, centre_px=centre)
    camera = f"rows = 480\ncolumns = 640\nfocal_px = 525.0\ncentre_px = {list(centre)}\n"
    (tmp_path / "r.toml").write_text(f'format = "bodyseg rig 1"\nname = "r"\n[camera]\n{camera}')
    with pytest.raises(
        BadConfig, match=rf"r.toml, \[camera\]: a principal point must be in pixels, {re.escape(found)}"
    ):
        frame_camera((480, 640), "x.png", rig=str(tmp_path / "r.toml"))
    assert frame_camera((48, 64), "x.png", focal_px=525.0, centre_px=(-1900.0, 1000.0)).camera.rows == 48
    assert frame_camera((48, 64), "x.png", focal_px=60.0, centre_px=(0.9, 24.0)).camera.rows == 48, "as of a part"
    assert frame_camera((3, 3), "x.png", focal_px=3.0).camera.centre_px == (1.5, 1.5)
