"""From a mesh and its parts to a stored sample: what every pixel must say, against geometry worked out here."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plain_views import take_whole_frames
from shapes import ball, figure

from bodyseg_data.artifacts import ShadowTest
from bodyseg_data.bodies import BodyRef, open_source
from bodyseg_data.core import BadSample, MissingLibrary
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.meshes import Mesh, Partition, partition
from bodyseg_data.meshes.partitioning import find_borders
from bodyseg_data.packing import Sampler
from bodyseg_data.packing.occluders import COARSEST_STEP
from bodyseg_data.packing.sampler import sample_key
from bodyseg_data.rendering import open_renderer
from bodyseg_data.rigs import Rig, load_rig
from bodyseg_data.samples import Sample, View, check_key
from bodyseg_data.shards import BODY_FIELDS, encode_sample
from bodyseg_data.shards.sample_codec import decode_sample

REF = BodyRef("people", "P007", "ball-1", "standing", "test")
RADIUS = 0.5
RIG = load_rig()


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


def test_a_key_names_body_and_view_however_long_both_are() -> None:
    long = [replace(REF, subject="s" * 20, mesh="m" * 38 + end) for end in ("1", "2")]
    views = View(215, 0), View(600, 350, -90), View(600, 350, -90, -179, -300), View(600, 350, -90, -179, 300)
    keys = [sample_key("labelled", ref, view) for ref in (REF, *long) for view in views]
    for key in keys:
        check_key(key)
    assert len(set(keys)) == 12 and all(key.endswith(view.name) for key, view in zip(keys, 3 * views, strict=True))
    assert keys[2] == "labelled-P007-ball-1-d600-a350-p-90-r-179-h-300"


def one_part(mesh: Mesh) -> Partition:
    labels, nowhere = np.zeros(len(mesh.vertices), np.uint8), np.full(len(mesh.vertices), np.inf)
    return Partition(labels, nowhere, find_borders(mesh, labels, nowhere))


def sample_of(renderer_name: str, view: View, rig: Rig | None = None) -> tuple[Sample, Rig]:
    rig = RIG if rig is None else rig
    mesh = ball(RADIUS, subdivisions=5)
    try:
        renderer = open_renderer(renderer_name, mesh)
    except MissingLibrary as missing:
        pytest.skip(str(missing))
    try:
        taken = Sampler(renderer, rig, mesh, halves(mesh), "open", REF).take(view)
    finally:
        renderer.close()
    return decode_sample(taken.key, encode_sample(taken)), rig


@pytest.mark.parametrize(("renderer", "azimuth"), [("raster", 0), ("embree", 200), ("opengl", 200)])
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
    assert np.abs(sample.range[inner] * rig.range_step_m - z[inner]).max() < 0.002
    points = camera.to_body(rays * z[..., None])
    left = points[..., 0] > 0
    clear = inner & (np.abs(points[..., 0]) > 0.002)
    assert np.array_equal(sample.labels[clear] == 3, left[clear])
    assert set(np.unique(sample.labels)) <= {3, 12, BACKGROUND}
    towards = np.einsum("hwc,hwc->hw", points - centre, projector.position - points)
    clear = foreground & (discriminant > 0.002) & (np.abs(towards) > 0.04)
    assert np.array_equal(sample.faces_projector[clear], (towards > 0)[clear])
    assert np.count_nonzero(towards[clear] < 0) > 500, "the ball's far side is turned away from the projector"


def test_next_to_nothing_is_stored_of_a_ball_which_shades_only_what_faces_away() -> None:
    sample, rig = sample_of("embree", View(255, 30))
    assert sample.occluder_range().shape == (rig.projector.rows, rig.projector.columns)
    assert (sample.occluder_range() > 0).sum() < 0.02 * (sample.range > 0).sum(), "where light grazes it"
    assert sample.faces_projector.any() and (~sample.faces_projector & (sample.range > 0)).any()


def check_against_whole_frames(rig: Rig, mesh: Mesh, parts: Partition, view: View) -> tuple[int, int, int]:
    """Texels stored, texels that see the body, and pixels put into shadow, once the sample equals the plain way's."""
    sample = Sampler(open_renderer("embree", mesh), rig, mesh, parts, "open", REF).take(view)
    camera_range, projector_range, labels, facing = take_whole_frames(rig, mesh, parts, view)
    assert np.array_equal(sample.range, camera_range)
    assert np.array_equal(sample.labels, labels)
    assert np.array_equal(sample.faces_projector, facing)
    occluder = sample.occluder_range()
    stored = occluder > 0
    assert (projector_range[stored] > 0).all()
    away = np.abs(occluder.astype(int) - projector_range)[stored]
    assert not stored.any() or away.max() < 2 * COARSEST_STEP, "rounded, but still about what the projector sees"
    test = ShadowTest(rig)
    expected = test.lit(camera_range, projector_range, facing)
    assert np.array_equal(test.lit(sample.range, occluder, sample.faces_projector), expected)
    by_nothing = test.lit(camera_range, np.zeros_like(projector_range), facing)
    return int(stored.sum()), int((projector_range > 0).sum()), int((by_nothing & ~expected).sum())


@pytest.mark.parametrize(("distance", "azimuth"), [(295, 0), (150, 60), (150, 170), (295, 290)])
def test_a_sample_is_that_of_whole_frames(distance: int, azimuth: int) -> None:
    mesh = figure()
    stored, seen, shaded = check_against_whole_frames(RIG, mesh, halves(mesh), View(distance, azimuth))
    assert (shaded > 0) <= (stored > 0) and stored < 0.25 * seen
    assert shaded > 100 or azimuth != 60, "the arm is between the light and the trunk"


@pytest.mark.parametrize(
    "projector",
    [
        {"centre_px": (60.0, 100.0)},
        {"centre_px": (300.0, 610.0)},
        {"rows": 97, "columns": 31},
        {"position_m": (1.5, -0.8, 0.5)},
        {"position_m": (0.3, 0.0, 2.4), "aims_at_m": (-1.0, 0.0, 2.5)},
    ],
)
def test_a_sample_is_that_of_whole_frames_with_any_projector(projector: dict[str, Any]) -> None:
    """Bodies that leave its frame on any side, grazing light, a projector beside the body."""
    rig = replace(RIG, projector=replace(RIG.projector, **projector))
    mesh = figure()
    check_against_whole_frames(rig, mesh, halves(mesh), View(215, 10))


@pytest.mark.parametrize(
    ("view", "roll"),
    [
        (View(215, 60, -35, 25, 10), 0.0),
        (View(255, 200, 20, -70), 0.0),
        (View(255, 200, 20, -70), 40.0),
        (View(295, 0, -90), 40.0),
    ],
)
def test_a_sample_from_above_and_turned_is_that_of_whole_frames(view: View, roll: float) -> None:
    rig, mesh = replace(RIG, projector=replace(RIG.projector, roll_deg=roll)), figure()
    stored, seen, shaded = check_against_whole_frames(rig, mesh, halves(mesh), view)
    assert stored < 0.25 * seen
    assert shaded > 100 or view.azimuth_deg != 60, "the arm is between the light and the trunk"


@pytest.mark.parametrize(("index", "view"), [(20, View(215, 0)), (400, View(295, 130))], ids=["bare", "dressed"])
def test_open_bodies_samples_are_those_of_whole_frames(index: int, view: View) -> None:
    source = open_source("open")
    body = source.build(source.bodies()[index])
    parts = partition(body.mesh, body.landmarks, "edges")  # whatever parts there are; exact ones take ten times longer
    stored, seen, shaded = check_against_whole_frames(RIG, body.mesh, parts, view)
    assert 0 < stored < 0.3 * seen and shaded > 0


def test_a_real_frames_sample_is_that_of_whole_frames(mit_folder: Path) -> None:
    source = open_source("mit", mit_folder)
    body = source.build(source.bodies()[0])
    check_against_whole_frames(RIG, body.mesh, partition(body.mesh, body.landmarks, "edges"), View(215, 40))


def test_a_sample_is_named_and_described_by_body_and_view() -> None:
    sample, _ = sample_of("embree", View(255, 30))
    assert sample.key == "open-P007-ball-1-d255-a030"
    assert sample.info.split == "test"
    assert (sample.info.subset, sample.info.pose) == ("people", "standing")
    assert (sample.info.distance_cm, sample.info.azimuth_deg) == (255, 30)
    described = json.loads(encode_sample(sample)["json"])
    assert set(described) == {"split", *BODY_FIELDS.kinds}
    assert (described["pitch_deg"], described["roll_deg"], described["height_cm"]) == (0, 0, 0)


def test_a_sample_from_above_is_named_and_described_by_its_pitch_roll_and_height() -> None:
    sample, _ = sample_of("raster", View(255, 30, -20, 5, 15))
    assert sample.key == "open-P007-ball-1-d255-a030-p-20-r005-h015"
    assert sample.info.view == View(255, 30, -20, 5, 15), "also once it was stored and read"
    described = json.loads(encode_sample(sample)["json"])
    assert (described["pitch_deg"], described["roll_deg"], described["height_cm"]) == (-20, 5, 15)


def test_a_body_beyond_what_16_bits_hold_is_refused() -> None:
    with pytest.raises(
        BadSample, match=r"open-P007-ball-1-d700-a000: a range must be 0 to 6.5535 m, 65535 steps of 0.1 mm, found"
    ):
        sample_of("embree", View(700, 0), replace(RIG, range_step_mm=0.1))
