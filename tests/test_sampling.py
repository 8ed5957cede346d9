"""From a mesh and its parts to a stored sample: what every pixel must say, against geometry worked out here."""

from __future__ import annotations

import numpy as np
import pytest
from shapes import ball

from bodyseg_data.bodies import BodyRef
from bodyseg_data.borders import find_borders
from bodyseg_data.codec import decode_sample, encode_sample
from bodyseg_data.errors import BadSample, MissingLibrary
from bodyseg_data.mesh import Mesh
from bodyseg_data.partition import Partition
from bodyseg_data.parts import BACKGROUND
from bodyseg_data.rendering import open_renderer
from bodyseg_data.rendering.sampling import take_sample
from bodyseg_data.rig import Rig, load_rig
from bodyseg_data.sample import RANGE_STEP_M, Sample
from bodyseg_data.views import View

REF = BodyRef("people", "P007", "ball-1", "standing", "test")
RADIUS = 0.5


def halves(mesh: Mesh) -> Partition:
    """Part 3 on the subject's left (x > 0), part 12 on the right, with the border exactly at x = 0."""
    x = mesh.vertices[:, 0]
    labels = np.where(x > 0, 3, 12).astype(np.uint8)
    borders = find_borders(mesh, labels, np.ones(len(x)))
    corner_x = x[mesh.faces[borders.faces]]
    # Distances to two far landmarks on either side: at every corner, 10 - x to the left one and 10 + x to the right.
    sign = np.where(labels[mesh.faces[borders.faces]] == 3, -1.0, 1.0)
    borders.distance[:] = 10 + sign[:, :, None] * corner_x[:, None, :]
    return Partition(labels, np.ones(len(x)), borders)


def sample_of(renderer_name: str, view: View, rig: Rig | None = None) -> tuple[Sample, Rig]:
    rig = load_rig() if rig is None else rig
    mesh = ball(RADIUS, subdivisions=5)
    try:
        renderer = open_renderer(renderer_name, mesh)
    except MissingLibrary as missing:
        pytest.skip(str(missing))
    try:
        taken = take_sample(renderer, rig, mesh, halves(mesh), "open", REF, view)
    finally:
        renderer.close()
    return decode_sample(taken.key, encode_sample(taken)), rig


@pytest.mark.parametrize("renderer", ["embree", "opengl"])
@pytest.mark.parametrize("azimuth", [0, 90, 200, 350])
def test_every_pixel_of_a_ball_says_what_geometry_says(renderer: str, azimuth: int) -> None:
    view = View(215, azimuth)
    sample, rig = sample_of(renderer, view)
    centre = np.array([0.0, 0.9, 0.0])
    camera, projector = rig.placed(centre, view)
    rays = rig.camera.pixel_rays()
    # |z r - m| = R for the ray r, with the ball's centre m at the view's distance on the axis.
    along = 2.15 / (rays**2).sum(axis=-1)
    discriminant = along**2 - (2.15**2 - RADIUS**2) / (rays**2).sum(axis=-1)
    sure = np.abs(discriminant) > 0.02  # away from the outline, where triangles differ from the ball
    z = np.where(discriminant > 0, along - np.sqrt(np.maximum(discriminant, 0)), 0)
    foreground = sample.range > 0
    assert np.array_equal(foreground[sure], (discriminant > 0)[sure])
    inner = foreground & sure
    assert np.abs(sample.range[inner] * RANGE_STEP_M - z[inner]).max() < 0.002
    points = camera.to_body(rays * z[..., None])
    left = points[..., 0] > 0
    clear = inner & (np.abs(points[..., 0]) > 0.002)
    assert np.array_equal(sample.labels[clear] == 3, left[clear])
    assert set(np.unique(sample.labels)) <= {3, 12, BACKGROUND}
    towards = np.einsum("hwc,hwc->hw", points - centre, projector.position - points)
    clear = foreground & (discriminant > 0.002) & (np.abs(towards) > 0.04)
    assert np.array_equal(sample.faces_projector[clear], (towards > 0)[clear])
    assert np.count_nonzero(towards[clear] < 0) > 500, "the ball's far side is turned away from the projector"


def test_the_projectors_range_is_what_the_projector_sees() -> None:
    sample, rig = sample_of("embree", View(255, 30))
    _, projector = rig.placed(np.array([0.0, 0.9, 0.0]), View(255, 30))
    pixel, away = projector.project(np.array([0.0, 0.9, 0.0]))
    nearest = sample.projector_range[int(pixel[1]), int(pixel[0])] * RANGE_STEP_M
    assert nearest == pytest.approx(away - RADIUS, abs=0.002)
    assert sample.projector_range.shape == (rig.projector.rows, rig.projector.columns)


def test_a_sample_is_named_and_described_by_body_and_view() -> None:
    sample, _ = sample_of("embree", View(255, 30))
    assert sample.key == "open-P007-ball-1-d255-a030"
    assert sample.info.split == "test"
    assert (sample.info.subset, sample.info.pose) == ("people", "standing")
    assert (sample.info.distance_cm, sample.info.azimuth_deg) == (255, 30)


def test_a_body_beyond_what_16_bits_hold_is_refused() -> None:
    with pytest.raises(BadSample, match=r"open-P007-ball-1-d700-a000: a range must be 0 to 6.5535 m, found"):
        sample_of("embree", View(700, 0))
