"""Rays are cast only where the body can be: the image is the one of all rays, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
from plain_views import cast_whole_frame, check_rays
from shapes import ball, figure

from bodyseg_data.rendering.embree import EmbreeRenderer
from bodyseg_data.rendering.renderer import Outline
from bodyseg_data.rigs import PlacedCamera, load_rig
from bodyseg_data.samples import View

RIG = load_rig()


def test_a_camera_with_the_body_on_both_sides_of_its_plane() -> None:
    mesh = figure()
    across = np.array([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]])
    assert check_rays(mesh, PlacedCamera(RIG.camera, across, np.array([0.1, 1.3, 0.28]))) > 1000


@pytest.mark.parametrize("block", [1, 2, 3, 8, 64])
def test_an_outline_holds_every_pixel_that_is_seen_and_few_more(block: int) -> None:
    mesh = figure()
    for view in (View(215, 0), View(255, 100)):
        for camera in RIG.placed(mesh.centre, view):
            seen = cast_whole_frame(mesh, camera).face >= 0
            covered = Outline(mesh, block).covered(camera)
            assert covered.shape == seen.shape
            assert not (seen & ~covered).any()
            if block <= 3:
                assert covered.sum() < 1.25 * seen.sum()


def test_no_pixels_have_no_ranges() -> None:
    camera = RIG.placed(ball().centre, View(215, 0))[0]
    assert EmbreeRenderer(ball()).ranges(camera, np.zeros(0, np.intp)).shape == (0,)
