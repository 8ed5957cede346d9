"""Frames without lens distortion, against planes worked out for every ray."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from label_networks import Places
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import Camera, Distortion
from bodyseg_model.segmentation import Segmenter
from bodyseg_model.segmentation.views import Undistortion

LENSES = {
    "a Kinect v1's": Distortion(k1=-0.26386, k2=0.99966, p1=-0.00076275, p2=0.0050350, k3=-1.30536),
    "barrel": Distortion(k1=-0.2),
    "pincushion": Distortion(k1=0.2, p1=0.01, p2=-0.01),
}
IDEAL = Camera(240, 320, 297.1, (169.9, 121.6), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
NORMAL = np.array([0.3, -0.2, 1.0])  # of a plane 2 m away, along the axis


def camera(lens: str) -> Camera:
    return replace(IDEAL, distortion=LENSES[lens])


@cache
def directions(lens: str) -> NDArray[np.float64]:
    """The direction (x, y, 1) that each pixel of a frame taken through the lens sees, by fixed-point iteration."""
    drawn = np.moveaxis(IDEAL.pixel_rays(), -1, 0)[:2]
    seen = drawn.copy()
    for _ in range(200):
        seen += drawn - np.array(LENSES[lens].apply(*seen))
    assert np.abs(drawn - np.array(LENSES[lens].apply(*seen))).max() < 1e-9
    return np.concatenate([seen, np.ones((1, 240, 320))])


def plane(rays: NDArray[np.float64]) -> NDArray[np.float32]:
    """Range of the plane along rays [3, H, W]."""
    return (2.0 / np.einsum("i,i...->...", NORMAL, rays)).astype(np.float32)


@pytest.mark.parametrize("lens", LENSES)
def test_a_plane_lies_where_it_does_without_a_lens(lens: str) -> None:
    frame, ideal = plane(directions(lens)), plane(np.moveaxis(IDEAL.pixel_rays(), -1, 0))
    found = Undistortion(camera(lens))(frame)
    seen = found > 0
    assert seen.mean() > (0.85 if lens == "pincushion" else 0.999)
    # The pixel that contains a point is centred within half a pixel of it, which the lens stretches by less than half.
    slopes = np.abs(np.gradient(ideal.astype(np.float64)))
    within = 0.5 * 1.5 * sum(slopes) * 1.05 + 1e-6
    assert (np.abs(found - ideal) <= within)[seen].all()
    raw_error = np.abs(frame - ideal)[seen]
    assert np.abs(found - ideal)[seen].mean() < 0.3 * raw_error.mean(), "it does more good than none"


@pytest.mark.parametrize("lens", LENSES)
def test_there_and_back_is_the_same_place(lens: str) -> None:
    """Each pixel of a frame holds its own position: what comes out says where it was taken."""
    rows, columns = np.mgrid[1:241, 1:321].astype(np.float64)
    undistort = Undistortion(camera(lens))
    row, column = undistort(rows), undistort(columns)
    seen = row > 0
    x, y = np.moveaxis(directions(lens), 0, -1)[row[seen].astype(int) - 1, column[seen].astype(int) - 1, :2].T
    back = np.stack([y * 297.1 + 121.6, x * 297.1 + 169.9])
    wanted = np.stack([np.mgrid[0:240, 0:320][axis][seen] + 0.5 for axis in (0, 1)])
    assert np.hypot(*(back - wanted)).max() < 0.71 * 1.5


def test_values_are_never_mixed_and_nothing_is_measured_outside_the_frame() -> None:
    frame = np.full((240, 320), 4000, np.uint16)
    frame[50:200, 100:165] = 1500
    frame[5, :] = 65535
    found = Undistortion(camera("pincushion"))(frame)
    assert found.dtype == np.uint16
    assert set(np.unique(found)) == {0, 1500, 4000, 65535}
    assert (found[[0, 0, -1, -1], [0, -1, 0, -1]] == 0).all(), "this lens draws the corners outside"


@pytest.mark.parametrize("shape", [(240, 321), (320, 240), (240,)])
def test_a_frame_of_another_size_is_refused(shape: Any) -> None:
    with pytest.raises(BadConfig, match="^a frame must have the camera's size, 240 x 320, found "):
        Undistortion(camera("barrel"))(np.zeros(shape, np.uint16))


def test_a_camera_is_either_without_distortion_or_undistorted_first() -> None:
    places = Places(axis=0, step=20)
    with pytest.raises(BadConfig, match="^frames must be undistorted .*, found Distortion"):
        Segmenter(places, camera("barrel"))
    undistort = Undistortion(camera("barrel"))
    assert undistort.camera == IDEAL
    assert Segmenter(places, undistort.camera).camera == IDEAL
