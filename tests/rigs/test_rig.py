from __future__ import annotations

import hashlib
import json
import math
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benches.data.occlusion.scaled_rig import with_projector_scale

from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import load_rig, load_sensor, rig_from_json, rig_names
from bodyseg_data.rigs.rig import parse_sensor
from bodyseg_data.samples import View, ViewGrid

PAPER = (resources.files("bodyseg_data.rigs") / "paper.toml").read_text()


def test_the_paper_rig_has_the_papers_numbers() -> None:
    rig = load_rig()
    assert (rig.camera.rows, rig.camera.columns) == (640, 329)
    assert rig.baseline_m == pytest.approx(0.75)
    assert rig.stand_off_m == 2.5
    # 12.5 mm over three pixels of 5.5 um, and 12 mm for the projector.
    assert rig.camera.focal_px == pytest.approx(757.576, abs=1e-3)
    assert rig.projector.focal_px / rig.camera.focal_px == pytest.approx(12 / 12.5)
    # At full resolution a pixel covers about a millimetre at the stand-off.
    assert rig.stand_off_m / (3 * rig.camera.focal_px) * 1000 == pytest.approx(1.1, abs=0.01)
    toe_in = math.degrees(math.acos(rig.projector.axes[2, 2]))
    assert toe_in == pytest.approx(math.degrees(math.atan(0.75 / 2.5)))


def test_the_centre_of_the_body_is_on_the_optical_axis_at_the_views_distance() -> None:
    rig, centre = load_rig(), np.array([0.1, 0.9, -0.2])
    for view in ViewGrid(span_deg=360):
        camera, projector = rig.placed(centre, view)
        assert camera.to_local(centre) == pytest.approx([0, 0, view.distance_cm / 100])
        pixel, depth = camera.project(centre)
        assert pixel == pytest.approx([329 / 2, 320])
        assert depth == pytest.approx(view.distance_cm / 100)
        assert np.linalg.norm(projector.position - camera.position) == pytest.approx(0.75)
        assert np.linalg.det(projector.axes) == pytest.approx(1)
        assert projector.to_body(projector.to_local(centre)) == pytest.approx(centre)


def test_azimuth_0_sees_the_front_and_90_the_subjects_left_side() -> None:
    rig = load_rig()
    front, _ = rig.placed(np.zeros(3), View(250, 0))
    assert front.position == pytest.approx([0, 0, 2.5])
    left_hand, _ = front.project(np.array([0.3, 0.0, 0.0]))
    head, _ = front.project(np.array([0.0, 0.5, 0.0]))
    assert left_hand[0] > 329 / 2, "facing a person, their left hand is on the image's right"
    assert head[1] < 320, "image rows go down"
    assert rig.placed(np.zeros(3), View(250, 90))[0].position == pytest.approx([2.5, 0, 0])


def test_camera_to_projector_agrees_with_the_placed_cameras() -> None:
    rig = load_rig()
    rotation, offset = rig.camera_to_projector()
    camera, projector = rig.placed(np.array([0.0, 0.9, 0.0]), View(255, 70))
    points = np.random.default_rng(0).normal(size=(20, 3))
    assert camera.to_local(points) @ rotation.T + offset == pytest.approx(projector.to_local(points))


def test_pixel_rays_go_through_pixel_centres() -> None:
    camera = load_rig().camera
    rays = camera.pixel_rays()
    assert rays.shape == (640, 329, 3)
    assert rays[0, 0] == pytest.approx([(0.5 - 164.5) / camera.focal_px, (0.5 - 320) / camera.focal_px, 1])
    assert rays[..., :2].mean(axis=(0, 1)) == pytest.approx([0, 0])


def test_a_finer_projector_image_covers_the_same_view() -> None:
    rig = with_projector_scale(load_rig(), 2)
    assert (rig.projector.rows, rig.projector.columns) == (1280, 658)
    coarse, fine = load_rig().projector.pixel_rays(), rig.projector.pixel_rays()
    assert fine[:2, :2].mean(axis=(0, 1)) == pytest.approx(coarse[0, 0])


def test_the_step_of_range_is_the_rigs_and_a_tenth_of_a_millimetre_where_it_does_not_say() -> None:
    said = "range_step_mm = 1.0 "
    assert said in PAPER
    assert load_rig().range_step_mm == 1
    silent, fine = (
        parse_sensor(PAPER.replace(said, "# "), "x").rig,
        parse_sensor(PAPER.replace(said, "range_step_mm = 0.25 "), "x").rig,
    )
    assert (silent.range_step_mm, silent.range_step_m) == (0.1, 1e-4)
    assert (fine.range_step_mm, fine.range_step_m) == (0.25, 2.5e-4)
    assert len({str(rig.to_json()) for rig in (silent, fine, load_rig())}) == 3
    assert rig_from_json(json.loads(json.dumps(fine.to_json()))) == fine
    older = {key: value for key, value in silent.to_json().items() if key != "range_step_mm"}
    assert rig_from_json(older) == silent


def test_a_rig_reaches_what_16_bits_hold_of_both_devices() -> None:
    rig = replace(load_rig(), range_step_mm=0.1)
    rig.check_reach(6.05)
    with pytest.raises(BadConfig, match=r"0.5 m behind a body 6.06 m away, 6.56 m: found 0.1 mm, which reach 6.554 m$"):
        rig.check_reach(6.06)
    far = replace(rig, projector=replace(rig.projector, position_m=(-0.75, 0.0, -2.0), aims_at_m=(-0.75, 0.0, 2.5)))
    far.check_reach(4.0)
    with pytest.raises(BadConfig, match=r"behind a body 4.1 m away, 6.6 m: found 0.1 mm"):
        far.check_reach(4.1)


def test_a_rig_survives_json() -> None:
    rig = replace(load_rig(), stand_off_m=0.5)
    assert rig_from_json(rig.to_json()) == rig
    assert rig_from_json(json.loads(json.dumps(rig.to_json()))) == rig
    with pytest.raises(BadConfig, match="^a stored rig must be an object, found list$"):
        rig_from_json([])
    with pytest.raises(
        BadConfig, match="^a stored rig's 'format' must be one of bodyseg rig 1, found 'bodyseg rig 2'$"
    ):
        rig_from_json({**rig.to_json(), "format": "bodyseg rig 2"})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rows": "640"}, "'rows' must be a finite number, found '640'"),
        ({"rows": 640.7}, "'rows' must be a whole number, found 640.7"),
        ({"columns": True}, "'columns' must be a finite number, found 'True'"),
        ({"focal_px": "500"}, "'focal_px' must be a finite number, found '500'"),
        ({"centre_px": "12"}, "'centre_px' must be 2 finite numbers, found 12"),
        ({"skew": 0}, "unknown 'skew'"),
    ],
)
def test_a_stored_rig_is_read_as_strictly_as_a_file(change: dict[str, Any], message: str) -> None:
    tree = load_rig().to_json()
    with pytest.raises(BadConfig, match=rf"^a stored rig, \[camera\]: {message}"):
        rig_from_json({**tree, "camera": {**tree["camera"], **change}})
    with pytest.raises(BadConfig, match="number 'rows' is missing"):
        rig_from_json({**tree, "camera": {}})
    with pytest.raises(BadConfig, match="^a stored rig: unknown 'lens'"):
        rig_from_json({**tree, "lens": 1})
    with pytest.raises(BadConfig, match="^a rig's name must be one plain word of at most 40 letters, found 'a/b'"):
        rig_from_json({**tree, "name": "a/b"})


def test_another_rig_is_another_file(tmp_path: Path) -> None:
    file = tmp_path / "kinect.toml"
    file.write_text(
        PAPER.replace('"paper"', '"kinect"').replace("rows = 640 ", "rows = 480 ").replace("[-0.75,", "[0.075,")
    )
    rig = load_rig(file)
    assert rig.name == "kinect"
    assert rig.camera.rows == 480
    assert rig.baseline_m == pytest.approx(0.075)
    assert rig.to_json() != load_rig().to_json()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("bodyseg rig 1", "bodyseg rig 9", "rig x: 'format' must be 'bodyseg rig 1'"),
        ("stand_off_m = 2.5", "stand_off_m = -1.0", "rig x: a rig's stand-off must be positive, found -1.0 m"),
        ("stand_off_m", "standoff", "rig x: number 'stand_off_m' is missing"),
        ("stand_off_m = 2.5", "stand_off_m = 2.5\nlens = 1", "^rig x: unknown 'lens'"),
        (
            "range_step_mm = 1.0",
            "range_step_mm = 0.001",
            "rig x: Rig: range_step_mm must be from 0.01 to 10, found 0.001",
        ),
        ("range_step_mm = 1.0", "range_step_mm = 11", "rig x: Rig: range_step_mm must be from 0.01 to 10, found 11"),
        ("range_step_mm = 1.0", "range_step_mm = '1'", "rig x: 'range_step_mm' must be a finite number, found '1'"),
        (
            "range_step_mm = 1.0",
            "range_step_mm = 0.04",
            "rig x: 65535 steps of 'range_step_mm' must reach 0.5 m behind a body 2.5 m away, 3.11 m: found 0.04 mm, "
            "which reach 2.621 m",
        ),
        ("rows = 640 ", "rows = 0 ", r"rig x, \[camera\]: Camera: rows must be from 1 to 8192, found 0"),
        ("rows = 640 ", "rows = 640.5 ", r"rig x, \[camera\]: 'rows' .* found 640\.5"),
        ("rows = 640 ", "rows = true ", "'rows' must be a finite number, found 'True'"),
        ("focal_length_mm = 12.5", "focal_length_mm = nan", "'focal_length_mm' must be a finite number"),
        ("focal_length_mm = 12.5", "focal_length_mm = -3", "'focal_length_mm' must be positive, found -3"),
        ("[projector]", "[projector]\nfov = 3", r"rig x, \[projector\]: unknown 'fov'"),
        ("[projector]", "[[projector]]", "'projector' must be a table"),
        (PAPER[PAPER.index("position_m = [-0.75") :], "", r"rig x, \[projector\]: list 'position_m' is missing"),
        ("[0.0, 0.0, 0.0]", "[0.0, 0.0]", "'position_m' must be 3 finite numbers"),
        ("[0.0, 0.0, 2.5]  # assumed: the", "[0.0, 1.0, 0.0]  #", "must not look straight up or down"),
        ('name = "paper"', 'name = "my rig"', "a rig's name must be one plain word"),
        ('name = "paper"', "name = 3", "'name' must be text, found 3"),
        ("rows = 640 ", "rows = ", "is not TOML"),
        ("rows = 640 ", f"rows = 1{'0' * 400} ", "'rows' must be a finite number, found '1000"),
        (
            "focal_length_mm = 12.5",
            "focal_pixels = 12.5",
            r"\[camera\]: give either 'focal_px' or 'focal_length_mm' with",
        ),
        (
            "focal_length_mm = 12.5",
            "focal_length_mm = 12.5\nfocal_px = 9.0",
            "give either 'focal_px' or 'focal_length_mm'",
        ),
        ("[0.0, 0.0, 2.5]  # assumed: the", "[0.0, 0.0, 0.0]  #", "must not aim at its own position"),
        ("focal_length_mm = 12.0", "focal_length_mm = 0.2", r"rig x, \[projector\]: .* found 12.121: is it in mill"),
        ("rows = 640 ", "centre_px = [0.5, 0.5]\nrows = 640 ", r"\[camera\]: .*: are they shares of the image\?"),
        ("focal_length_mm = 12.5", "focal_length_mm = 1e200", "at most 1e\\+06"),
        ("pixel_pitch_um = 16.5 ", "pixel_pitch_um = 0.0 ", "'pixel_pitch_um' must be positive, found 0"),
        ("[0.0, 0.0, 0.0]", "[1e250, 0.0, -1e250]", "must be from -100 to 100"),
        ("[0.0, 0.0, 0.0]", '"123"', "'position_m' must be 3 finite numbers, found 123"),
        ("[0.0, 0.0, 0.0]", "[0.0, 0.0, inf]", "'position_m' must be 3 finite numbers"),
        ('name = "paper"', f'name = "{"x" * 41}"', "a rig's name must be one plain word of at most 40 letters"),
        (
            PAPER[PAPER.index("[-0.75,") :],
            "[40.0, 0.0, 0.0]\naims_at_m = [40.0, 0.0, 2.5]",
            r"rig x: a projector must light something that the camera sees 2.5 m away: "
            r"found one at \[40.0, 0.0, 0.0\] m that aims at \[40.0, 0.0, 2.5\]",
        ),
    ],
)
def test_a_broken_rig_file_is_refused_in_one_line(old: str, new: str, message: str) -> None:
    assert old in PAPER
    with pytest.raises(BadConfig, match=message) as caught:
        parse_sensor(PAPER.replace(old, new, 1), "x")
    assert "\n" not in str(caught.value)


SECOND = PAPER[PAPER.index("[projector]") :].replace("[projector]", "[second_projector]").replace("[-0.75,", "[0.5,")
"""The table of a second projector on the other side."""


def test_a_rig_may_have_two_projectors() -> None:
    one, two = load_rig(), parse_sensor(PAPER + SECOND, "x").rig
    assert two.second_projector == replace(one.projector, position_m=(0.5, 0.0, 0.0))
    assert two.projectors == (one.projector, two.second_projector) and one.projectors == (one.projector,)
    assert two.by_projector() == (one, replace(one, projector=two.projectors[1])) and one.by_projector() == (one,)
    assert (one.projector_shape, two.projector_shape) == ((640, 329), (1280, 329))
    assert with_projector_scale(two, 2).projector_shape == (2560, 658)
    assert "second_projector" not in one.to_json() and two.to_json() != one.to_json()
    assert rig_from_json(json.loads(json.dumps(two.to_json()))) == two
    assert two.baseline_m == one.baseline_m


def test_what_manifests_hold_of_a_rig_with_one_projector_is_pinned() -> None:
    tree = json.dumps(load_rig().to_json(), sort_keys=True)
    assert hashlib.sha256(tree.encode()).hexdigest()[:16] == "d4c3d90ac43890b0"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("columns = 329", "columns = 300", "rig x: the images of two projectors must have equally many columns, found"),
        (
            "rows = 640",
            "rows = 7553",
            "rig x: the images of two projectors must have at most 8192 rows together, found 8193",
        ),
        ("rows = 640", "rows = 0", r"rig x, \[second_projector\]: Camera: rows must be from 1 to 8192, found 0"),
        ("[second_projector]", "[second_projector]\nfov = 3", r"rig x, \[second_projector\]: unknown 'fov'"),
        (SECOND[SECOND.index("position_m") :], "", r"rig x, \[second_projector\]: list 'position_m' is missing"),
        (
            SECOND[SECOND.index("aims_at_m") :],
            "aims_at_m = [0.5, 0.0, -2.5]",
            r"rig x: a projector must light .*: found one at \[0.5, 0.0, 0.0\] m that aims at \[0.5, 0.0, -2.5",
        ),
        ("[0.5, 0.0, 0.0]", "[0.5, 0.0, -70.0]", "0.5 m behind a body 2.5 m away, .*: found 1 mm, which reach 65.53 m"),
    ],
)
def test_a_broken_second_projector_is_refused_in_one_line(old: str, new: str, message: str) -> None:
    assert old in SECOND
    with pytest.raises(BadConfig, match=message) as caught:
        parse_sensor(PAPER + SECOND.replace(old, new, 1), "x")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("what", [None, 3, b"paper", load_rig()])
def test_a_rig_is_read_by_a_name_or_a_path(what: Any) -> None:
    with pytest.raises(BadConfig, match="^a rig is given by its name or a path, found "):
        load_rig(what)


def test_a_second_projector_alone_is_no_rig() -> None:
    with pytest.raises(BadConfig, match="rig x: table 'projector' is missing"):
        parse_sensor(PAPER.replace("[projector]", "[second_projector]"), "x")


CAMERA = """format = "bodyseg rig 1"
name = "d1"
[camera]
rows = 480
columns = 640
focal_px = 600.5
"""


def test_a_rig_file_may_hold_a_camera_alone() -> None:
    sensor = parse_sensor(CAMERA, "x")
    camera = sensor.camera
    assert (sensor.name, sensor.title, sensor.rig, sensor.assumed_for_size) == ("d1", "d1", None, False)
    assert (camera.focal_px, camera.centre_px, camera.position_m) == (600.5, (320.0, 240.0), (0.0, 0.0, 0.0))
    assert camera.axes == pytest.approx(np.eye(3))
    titled = parse_sensor(CAMERA.replace("[camera]", 'title = "D 1"\nassumed_for_size = true\n[camera]'), "x")
    assert (titled.title, titled.assumed_for_size) == ("D 1", True)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[camera]", "assumed_for_size = 1\n[camera]", "'assumed_for_size' must be true or false, found 1"),
        ("[camera]", "stand_off_m = 2.0\n[camera]", "table 'projector' is missing"),
        ("[camera]", "range_step_mm = 1.0\n[camera]", "number 'stand_off_m' is missing"),
        ("focal_px", "position_m = [0, 0, 0]\nfocal_px", "list 'aims_at_m' is missing"),
        ("focal_px", "focal_length_mm = 6.0\nfocal_px", "give either 'focal_px' or 'focal_length_mm'"),
        ("focal_px = 600.5", "focal_px = -1", "'focal_px' must be positive, found -1"),
        ('"d1"', '"d 1"', "rig x: a rig's name must be one plain word"),
    ],
)
def test_a_broken_camera_alone_is_refused_in_one_line(old: str, new: str, message: str) -> None:
    assert old in CAMERA
    with pytest.raises(BadConfig, match=message) as caught:
        parse_sensor(CAMERA.replace(old, new, 1), "x")
    assert str(caught.value).startswith("rig x") and str(caught.value).count("rig x") == 1


NAMES = (
    "azure_kinect",
    "kinect_v1",
    "kinect_v2",
    "orbbec_astra",
    "orbbec_femto",
    "paper",
    "realsense_d435",
    "realsense_d455",
)


def test_the_rigs_that_ship_are_listed_and_called_as_their_files() -> None:
    assert rig_names() == NAMES
    assert [load_sensor(name).name for name in rig_names()] == list(rig_names())
    assert load_sensor("paper").rig == load_sensor().rig == load_rig()


def test_a_camera_alone_is_no_rig(tmp_path: Path) -> None:
    file = tmp_path / "alone.toml"
    file.write_text('format = "bodyseg rig 1"\nname = "a"\n[camera]\nrows = 4\ncolumns = 3\nfocal_px = 5')
    with pytest.raises(BadConfig, match="^rig .*alone.toml is a camera alone: .* needs 'stand_off_m' and .projector.$"):
        load_rig(file)


def test_a_rig_of_whole_numbers_and_lists_is_written_as_it_is_read_again() -> None:
    """So that a joined set has the bytes of one that a single writer made."""
    camera = replace(load_rig().camera, centre_px=[160, 320], position_m=[0, 0, 0], aims_at_m=(0, 0, np.int64(1)))
    rig = replace(load_rig(), stand_off_m=2, camera=camera)
    assert json.dumps(rig.to_json()) == json.dumps(rig_from_json(json.loads(json.dumps(rig.to_json()))).to_json())
    assert hash(rig) == hash(rig_from_json(rig.to_json()))
