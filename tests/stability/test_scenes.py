"""Scenes drawn anew, of plain figures: what is seen from where, and that the clean end is the stored image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fakes import Figures
from shapes import figure

from bodyseg_data import RangeImages, ShardWriter
from bodyseg_data.bodies import SOURCES
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.rendering import RasterRenderer
from bodyseg_data.rigs import axes_at, load_rig
from bodyseg_data.samples import ViewGrid
from bodyseg_model.evaluation import TrueSurface
from bodyseg_model.stability import SWEEPS, Scenes, evaluate_conditions, of_rig
from bodyseg_model.stability.scenes import (
    CLEAN,
    LabelledImage,
    SweepPoint,
    labelled_image,
    looking_down,
    sensor,
    with_baseline,
)

RIG = load_rig()


@pytest.fixture(scope="module")
def images(pack_figures: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> RangeImages:
    """Views from the stand-off, which is where scenes are drawn from."""
    grid = ViewGrid(distances_cm=(250,), azimuths=4, span_deg=360)
    packed = pack_figures(tmp_path_factory.mktemp("stand_off") / "shards", views=grid, rig=RIG)
    return RangeImages(packed, "none", "test")


@pytest.fixture
def scenes(images: RangeImages, monkeypatch: pytest.MonkeyPatch) -> Scenes:
    monkeypatch.setitem(SOURCES, "open", Figures)
    return Scenes(images, 2, images)


def shares(images: list[LabelledImage]) -> np.ndarray:
    return np.array([len(each.pixels) for each in images])


def test_clean_scenes_are_the_stored_images(scenes: Scenes, images: RangeImages) -> None:
    stored, drawn = (scenes.labelled_images(CLEAN[origin]) for origin in ("stored", "rendered"))
    assert len(scenes) == len(stored) == len(drawn) == 2
    for number, (a, b) in enumerate(zip(stored, drawn, strict=True)):
        np.testing.assert_array_equal(a.range_m, b.range_m)
        np.testing.assert_array_equal(a.pixels, b.pixels)
        np.testing.assert_array_equal(a.truth, b.truth)
        sample = images.clean(int(images.order(0)[number]))
        np.testing.assert_array_equal(a.range_m, sample.range * np.float32(images.step_m))
        np.testing.assert_array_equal(a.truth, sample.labels[sample.range > 0])


def test_before_a_camera_that_is_mounted_turned_every_scene_is_turned(
    pack_figures: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(SOURCES, "open", Figures)
    shape, grid = {"rows": RIG.camera.columns, "columns": RIG.camera.rows}, ViewGrid(distances_cm=(250,), azimuths=1)
    lying = replace(RIG, camera=replace(RIG.camera, roll_deg=90.0, centre_px=RIG.camera.centre_px[::-1], **shape))
    upright, turned = (
        Scenes(RangeImages(pack_figures(tmp_path / str(number), views=grid, rig=rig), "none", "test"), 1)
        for number, rig in enumerate((RIG, lying))
    )
    for condition in (*CLEAN.values(), SweepPoint("occlusion", 0.25), SweepPoint("rig", 525.0), SweepPoint("desk", 1)):
        (a,), (b,) = (scenes.labelled_images(condition) for scenes in (upright, turned))
        np.testing.assert_array_equal(np.sort(b.truth), np.sort(a.truth), err_msg=condition.name)
        if condition.sweep != "desk":  # which is resampled
            np.testing.assert_array_equal(np.rot90(b.range_m, -1), a.range_m, err_msg=condition.name)


def test_each_sample_is_seen_by_its_own_camera(tmp_path: Path) -> None:
    wide = replace(RIG, camera=replace(RIG.camera, focal_px=RIG.camera.focal_px / 2))
    shape = RIG.camera.rows, RIG.camera.columns
    with ShardWriter(tmp_path / "set", rig=[RIG, wide], classes=["wall"]) as out:
        for number in range(2):
            range_m, labels = np.full(shape, 2.0, np.float32), np.zeros(shape, np.uint8)
            out.write(key=f"view-{number}", range_m=range_m, labels=labels, split="test", rig=number)
    images = RangeImages(tmp_path / "set", "none", "test")
    for condition in (CLEAN["stored"], SweepPoint("hard", 1)):
        found = Scenes(images, 2, images).labelled_images(condition)
        keys = [images.keys[int(index)] for index in images.order(0)]
        focals = {key: each.surface.camera.focal_px for key, each in zip(keys, found, strict=True)}
        assert focals == {"view-0": RIG.camera.focal_px, "view-1": wide.camera.focal_px}


def test_no_more_images_than_there_are(images: RangeImages) -> None:
    scenes = Scenes(images, 1000)
    assert len(scenes) == len(images) == 8


def test_bodies_are_built_once_and_reported(images: RangeImages, monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[str] = []

    class Counting(Figures):
        def build(self, body):  # type: ignore[no-untyped-def]
            built.append(body.mesh)
            return super().build(body)

    monkeypatch.setitem(SOURCES, "open", Counting)
    seen: list[tuple[int, int]] = []
    scenes = Scenes(images, 8, progress=lambda *numbers: seen.append(numbers))
    scenes.labelled_images(SweepPoint("farther", 3.0))
    scenes.labelled_images(SweepPoint("farther", 4.0))
    assert sorted(built) == ["A-2", "people-2"] and seen == [(number, 8) for number in range(1, 9)]


@pytest.mark.parametrize("name", ["nearer", "farther", "tilt", "rig", "rig_resampled", "occlusion"])
def test_every_setting_of_a_drawn_sweep_can_be_shown(name: str, scenes: Scenes) -> None:
    clean = shares(scenes.labelled_images(CLEAN["rendered"]))
    for condition in SWEEPS[name].conditions(name)[1:]:
        images = scenes.labelled_images(condition)
        assert len(images) == 2
        for each in images:
            assert each.range_m.dtype == np.float32 and each.truth.max() < 33
            assert (each.range_m.ravel()[each.pixels] > 0).all() and len(each.pixels) == len(each.truth)
        if name == "nearer":
            assert (shares(images) > clean).all()
        elif name != "tilt":
            assert (shares(images) < clean).all()


def test_things_hide_the_share_that_a_setting_names(scenes: Scenes) -> None:
    clean = shares(scenes.labelled_images(CLEAN["rendered"]))
    for share in (0.1, 0.3):
        without, shown = (scenes.labelled_images(SweepPoint(sweep, share)) for sweep in ("hidden", "hidden_shown"))
        assert np.abs(1 - shares(without) / clean - share).max() <= 0.05 + 1e-9
        for alone, both in zip(without, shown, strict=True):
            on_thing = both.truth == BACKGROUND
            assert on_thing.any() and not (alone.truth == BACKGROUND).any()
            np.testing.assert_array_equal(both.pixels[~on_thing], alone.pixels)
            np.testing.assert_array_equal(both.truth[~on_thing], alone.truth)
            hidden = both.range_m.ravel()[both.pixels[on_thing]]
            assert hidden.max() < alone.range_m.max()


def test_shadows_grow_with_the_baseline(scenes: Scenes) -> None:
    seen = [shares(scenes.labelled_images(condition)) for condition in SWEEPS["occlusion"].conditions("occlusion")]
    assert (np.diff(seen, axis=0) < 0).all()


def test_a_body_gets_smaller_with_its_distance(scenes: Scenes) -> None:
    near, far = (scenes.labelled_images(condition) for condition in (CLEAN["rendered"], SweepPoint("farther", 4.0)))
    np.testing.assert_allclose(shares(far) / shares(near), (2.5 / 4) ** 2, rtol=0.08)
    for a, b in zip(near, far, strict=True):
        nearest = [each.range_m[each.range_m > 0].min() for each in (a, b)]
        assert nearest[1] - nearest[0] == pytest.approx(1.5, abs=0.01)


def test_the_projector_goes_out_sideways_and_aims_at_the_stand_off() -> None:
    rig = with_baseline(RIG, 1.25)
    assert rig.baseline_m == pytest.approx(1.25)
    assert rig.projector.aims_at_m == (0.0, 0.0, RIG.stand_off_m)
    assert with_baseline(RIG, RIG.baseline_m) == RIG, "the paper's own baseline gives the paper's rig"
    assert replace(rig.projector, position_m=RIG.projector.position_m) == RIG.projector
    as_robots = {"aims_at_m": (2.5, 0.0, 0.0), "up": (0.0, 0.0, 1.0)}  # axes: x ahead, z up
    turned = replace(RIG, camera=replace(RIG.camera, **as_robots), projector=replace(RIG.projector, **as_robots))
    assert with_baseline(turned, 1.25) == rig


@pytest.mark.parametrize("azimuth", [0, 70])
@pytest.mark.parametrize("tilt", [0, 20])
def test_a_camera_looks_down_at_the_middle(azimuth: int, tilt: int) -> None:
    mesh = figure()
    placed = looking_down(RIG.camera, mesh.centre, azimuth, 2.5, tilt)
    np.testing.assert_allclose(placed.axes @ placed.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(placed.axes) == pytest.approx(1)
    where, ahead = placed.project(mesh.centre[None])
    np.testing.assert_allclose(where[0], RIG.camera.centre_px)
    assert ahead[0] == pytest.approx(2.5)
    above = placed.position[1] - mesh.centre[1]
    assert above == pytest.approx(2.5 * np.sin(np.radians(tilt)))
    np.testing.assert_allclose(placed.axes[0], axes_at(azimuth)[0], err_msg="no roll")
    seen = RasterRenderer(mesh).render(placed).range
    if tilt:
        rows = np.flatnonzero(seen.any(axis=1))
        assert seen[rows[-1]].max() > seen[rows[0]].max() + 0.3, "feet are farther than the head"


def test_sensors_are_known_by_focal_length(scenes: Scenes) -> None:
    assert [(sensor(focal).rows, sensor(focal).columns) for focal in SWEEPS["rig"].strengths[1:]] == [
        (480, 640),
        (424, 512),
    ]
    for focal in SWEEPS["rig"].strengths[1:]:
        as_it_is, made = (scenes.labelled_images(SweepPoint(name, focal)) for name in ("rig", "rig_resampled"))
        for a, b in zip(as_it_is, made, strict=True):
            np.testing.assert_array_equal(a.truth, b.truth)
            assert b.range_m.shape == (RIG.camera.rows, RIG.camera.columns)
            tall = [np.count_nonzero(each.range_m.any(axis=1)) for each in (a, b)]
            # Pixels a metre at the body's middle become what the known camera has at its stand-off.
            middle = np.median(a.range_m.ravel()[a.pixels])
            assert tall[1] / tall[0] == pytest.approx(RIG.camera.focal_px / focal * middle / RIG.stand_off_m, rel=0.05)


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_a_turned_frame_shows_the_same_pixels_elsewhere(degrees: int, scenes: Scenes) -> None:
    made, clean = scenes.labelled_images(SweepPoint("turned", degrees)), scenes.labelled_images(CLEAN["stored"])
    for a, b in zip(made, clean, strict=True):
        np.testing.assert_array_equal(np.rot90(a.range_m, degrees // 90), b.range_m)
        np.testing.assert_array_equal(np.sort(a.places), b.pixels)
        labels = np.full(a.range_m.shape, BACKGROUND, np.uint8)
        labels.ravel()[a.pixels] = a.truth
        np.testing.assert_array_equal(np.rot90(labels, degrees // 90), b.surface.labels)
        assert a.surface.distances(a.places, a.truth).max() < 0.05


def test_people_in_a_pose_are_built_once_and_seen_from_the_front(
    images: RangeImages, monkeypatch: pytest.MonkeyPatch
) -> None:
    built: list[str] = []

    class Counting(Figures):
        def in_pose(self, body, pose):  # type: ignore[no-untyped-def]
            built.append(f"{body.subject} {pose}")
            return super().in_pose(body, pose)

    monkeypatch.setitem(SOURCES, "open", Counting)
    scenes = Scenes(images, 8)
    clean, fist = (scenes.labelled_images(each) for each in (CLEAN["rendered"], SweepPoint("fist", 1)))
    for a, b in zip(clean, fist, strict=True):
        assert np.count_nonzero(b.range_m.any(axis=1)) > np.count_nonzero(a.range_m.any(axis=1)), "a taller pose"
    assert len({len(each.pixels) for each in fist}) > 2, "from several sides"
    chest, shoulders = (scenes.labelled_images(SweepPoint("desk", cut)) for cut in (1, 2))
    assert sorted(built) == ["A desk", "A fist", "people desk", "people fist"]
    for each in (*chest, *shoulders):
        assert each.surface.camera == sensor(525.0) and each.range_m.shape == (RIG.camera.rows, RIG.camera.columns)
        assert each.surface.range_m[-1].any(), "the frame's border cuts the body"
        assert 0.6 < np.median(each.surface.range_m[each.surface.range_m > 0]) < 1.4
    assert (shares(chest) != shares(shoulders)).all()


def test_hard_poses_are_another_sets_images(scenes: Scenes) -> None:
    hard, clean = scenes.labelled_images(SweepPoint("hard", 1)), scenes.labelled_images(CLEAN["stored"])
    for a, b in zip(hard, clean, strict=True):
        np.testing.assert_array_equal(a.range_m, b.range_m)


def test_a_picture_counts_what_was_measured() -> None:
    image, labels = np.array([[0, 20_000], [30_000, 0]], np.uint16), np.array([[255, 7], [9, 4]], np.uint8)
    made = labelled_image(image, 1e-4, TrueSurface(image * np.float32(1e-4), labels, RIG.camera))
    np.testing.assert_array_equal(made.range_m, np.float32([[0, 2], [3, 0]]))
    assert made.pixels.tolist() == [1, 2] and made.truth.tolist() == [7, 9]


def test_bodies_of_files_cannot_be_drawn_anew(images: RangeImages, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(images, "manifest", replace(images.manifest, source="mit"))
    scenes = Scenes(images, 3)
    with pytest.raises(BadConfig, match="found a set of 'mit': choose others with --sweeps, of noise, missing"):
        scenes.labelled_images(SweepPoint("tilt", 5))
    assert len(scenes.labelled_images(SweepPoint("noise", 10))) == 3


def test_fringes_of_a_rig_without_a_baseline_are_refused_before_any_sweep(
    images: RangeImages, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes = Scenes(images, 1)
    scenes.check(SweepPoint("speed", 1.0))
    monkeypatch.setattr(images, "manifest", replace(images.manifest, rigs=(load_rig("kinect_v2"),)))
    scenes = Scenes(images, 1)
    scenes.check(SweepPoint("mixed", 0.5))
    for sweep in ("speed", "clothes", "ambient"):
        with pytest.raises(BadConfig, match=f"'{sweep}' is to be left out with --sweeps: rig .* no baseline"):
            evaluate_conditions([], [SweepPoint("noise", 10), *SWEEPS[sweep].conditions(sweep)], scenes)


def test_bodies_farther_than_a_rigs_steps_reach_are_refused_before_any_sweep(
    images: RangeImages, monkeypatch: pytest.MonkeyPatch
) -> None:
    far = replace(RIG, stand_off_m=4.2, range_step_mm=0.1)
    monkeypatch.setattr(images, "manifest", replace(images.manifest, rigs=(far,)))
    conditions = [each for name, sweep in of_rig(SWEEPS, far).items() for each in sweep.conditions(name)]
    with pytest.raises(BadConfig, match=r"'farther' is to be left out with --sweeps: 65535 steps .* 6\.72 m away"):
        evaluate_conditions([], conditions, Scenes(images, 1))


@pytest.mark.parametrize("stand_off_m", [0.4, 6.0])
def test_steps_of_depth_that_do_not_reach_a_rigs_bodies_are_refused(
    images: RangeImages, monkeypatch: pytest.MonkeyPatch, stand_off_m: float
) -> None:
    """Every body would be flat, at 0.5 or 4.5 m."""
    rig = replace(RIG, stand_off_m=stand_off_m)
    monkeypatch.setattr(images, "manifest", replace(images.manifest, rigs=(rig,)))
    wanted = f"'depth_steps' is to be left out with --sweeps: its depths of 0.5 to 4.5 m .* found {stand_off_m:g} m"
    with pytest.raises(BadConfig, match=wanted):
        evaluate_conditions([], SWEEPS["depth_steps"].conditions("depth_steps"), Scenes(images, 1))


def test_strengths_are_those_of_the_sets_rig() -> None:
    assert of_rig(SWEEPS, RIG) == SWEEPS
    close = of_rig(SWEEPS, replace(load_rig("kinect_v1"), stand_off_m=1.5))
    assert close["nearer"].strengths == (1.5, 1.35, 1.2, 1.05, 0.9)
    assert close["farther"].strengths == (1.5, 1.8, 2.1, 2.4)
    assert close["rig"].strengths == close["rig_resampled"].strengths == (525, 365), "no camera is another than itself"
    assert close["noise"] == SWEEPS["noise"]
    wide = replace(RIG, camera=replace(RIG.camera, focal_px=150.04))
    assert of_rig(SWEEPS, wide)["rig"].strengths == (150, *reversed(SWEEPS["rig"].strengths[1:])), "rising severity"
