"""What a set's page draws: arrays after each control."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from label_networks import Places
from small_rig import SMALL

from bodyseg_data import LabelMap, RangeImages, ShardWriter, example_set
from bodyseg_data.artifacts import MissingData, Noise, load_sensor_model
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import PARTS33, load_label_map
from bodyseg_data.labels.label_map import COLOURS
from bodyseg_model.networks import Trained
from bodyseg_model.viewing import SetView, Shown
from bodyseg_model.viewing.pictures import CONFIDENCE_LEGEND, KIND_LEGEND, Layout, legible, rig_before
from bodyseg_model.viewing.set_view import COLOURINGS

KINDS = np.array([colour for _, colour in KIND_LEGEND], np.uint8)


@pytest.fixture(scope="module")
def view(small_set: Path) -> SetView:
    return SetView(small_set, Trained(Places(0, 5), {"rig": SMALL.to_json()}), split="train")


def test_points_are_those_that_the_variant_measured(view: SetView) -> None:
    for variant in ("none", "all"):
        image = RangeImages(view.path, variant, "train").image(3, epoch=2)
        drawing = view.draw(Shown(3, variant, epoch=2))
        seen = image.range > 0
        np.testing.assert_array_equal(drawing.points.colours, legible(COLOURS)[image.labels[seen]])
        camera, _ = rig_before(view.rig, view.images.clean(3).info.view)
        at, away = camera.project(drawing.points.xyz.astype(np.float64))
        np.testing.assert_allclose(away, image.range[seen] * view.rig.range_step_m, atol=1e-5)
        np.testing.assert_array_equal(np.floor(at).astype(int)[:, ::-1], np.argwhere(seen))
        assert drawing.bodies == np.count_nonzero(seen)
        assert list(drawing.devices) == ["camera", "projector"]


def test_strengths_change_their_variants_alone(view: SetView) -> None:
    weak = Shown(0, "noise", sensor=load_sensor_model().with_artifacts(Noise(1.0, 1.0), MissingData((0.0,))))
    strong = replace(weak, sensor=weak.sensor.with_artifacts(Noise(90.0, 90.0)))
    before, after = view.draw(weak), view.draw(strong)
    spread = [np.abs(each.points.xyz - view.draw(Shown(0, "none")).points.xyz).mean() for each in (before, after)]
    assert 10 * spread[0] < spread[1]
    assert any("noise 90 mm" in fact for fact in after.facts)
    # The first panels of the second line are of `none` and `occ`, which have no noise.
    width = before.picture.shape[1] // 5
    half = before.picture.shape[0] // 2
    changed = (before.picture != after.picture).any(-1)
    assert not changed[half + 40 :, : 2 * width].any() and changed[half + 40 :, 2 * width : 3 * width].any()


def test_each_colouring_shows_what_it_names(view: SetView) -> None:
    shown = Shown(1, "none")
    image = view.images.clean(1)
    seen = image.range > 0
    rows = np.broadcast_to(np.arange(160)[:, None], seen.shape)[seen]
    found = {colouring: view.draw(replace(shown, colouring=colouring)) for colouring in COLOURINGS}
    labels = np.clip((rows - rows.min()) // 5, 0, 32)
    answered = found["network"].points.colours
    # The network sees a crop whose first row is a margin above the body: its labels step down by rows.
    assert {tuple(each) for each in answered.tolist()} <= {tuple(each) for each in legible(COLOURS).tolist()}
    assert len(np.unique(answered, axis=0)) >= len(np.unique(labels)) - 1
    right = (answered == found["parts"].points.colours).all(-1)
    np.testing.assert_array_equal((found["mistakes"].points.colours == KINDS[0]).all(-1), right)
    share = f"{right.mean():.1%} of pixels right"
    assert any(share in fact for fact in found["parts"].facts)
    assert found["mistakes"].legend == KIND_LEGEND and len(found["parts"].legend) == 33
    assert found["confidence"].legend == CONFIDENCE_LEGEND
    assert len(np.unique(found["confidence"].points.colours, axis=0)) == 1
    assert len(np.unique(found["range"].points.colours, axis=0)) > 20


def test_without_a_network_nothing_is_answered(view: SetView, small_set: Path) -> None:
    alone = SetView(small_set, split="train")
    asked = view.draw(Shown(1))
    for drawing in (alone.draw(Shown(1, colouring="network")), view.draw(Shown(1, network=False, colouring="network"))):
        np.testing.assert_array_equal(drawing.points.colours, asked.points.colours)
        assert not any("network" in fact for fact in drawing.facts)
        assert drawing.picture.shape == asked.picture.shape and (drawing.picture != asked.picture).any()
    assert alone.warning is None and alone.index_of("nobody") is None


def test_panels_show_the_body_alone_where_it_is_small_in_the_image(view: SetView) -> None:
    sample = view.images.clean(0)
    sides = [(0, 0), (300, 500)]
    wide = replace(
        sample,
        range=np.pad(sample.range, sides),
        projector_range=np.pad(sample.projector_range, sides),
        labels=np.pad(sample.labels, sides, constant_values=255),
    )
    layout, (rows, columns) = view.layout_of(wide)
    assert np.count_nonzero(wide.range[rows, columns]) == np.count_nonzero(sample.range)
    assert layout.width / layout.rows == pytest.approx(
        wide.range[rows, columns].shape[1] / sample.range.shape[0], rel=0.05
    )
    assert (columns.start, columns.stop) != (None, None)
    assert (layout.reduced(wide.range[rows, columns]) > 0).mean() > 0.2


def test_samples_are_chosen_by_filters(view: SetView) -> None:
    key = view.images.keys[5]
    one = view.chosen("train", [key], [])
    assert len(one) == 1 and one.index_of(key) == 0 and one.trained is view.trained
    half = view.chosen(None, [], ["azimuth_deg=0"])
    assert 0 < len(half) < len(view.chosen(None, [], []))
    with pytest.raises(BadConfig, match="has no sample"):
        view.chosen("test", [key], [])


def test_a_network_of_another_rig_is_told(small_set: Path) -> None:
    view = SetView(small_set, Trained(Places(0, 5), {}))
    assert view.warning is not None and view.warning in view.draw(Shown()).facts


def test_an_image_without_points_is_drawn(view: SetView) -> None:
    gone: Any = load_sensor_model().with_artifacts(MissingData((1.0,)))
    for colouring in COLOURINGS:
        drawing = view.draw(Shown(0, "md", sensor=gone, colouring=colouring))
        assert drawing.points.xyz.shape == (0, 3) and drawing.bodies == 0


def test_the_page_opens_on_somebody_who_stands_and_looks_at_the_camera(small_set: Path) -> None:
    view = SetView(example_set())
    first = view.images.clean(view.first_index()).info.fields
    assert first["pose"] == "standing" and first["azimuth_deg"] == 0
    tested = SetView(example_set(), split="test")
    assert 0 <= tested.first_index() < len(tested)


def test_the_page_opens_on_a_set_whose_own_fields_are_called_as_those_of_bodies(tmp_path: Path) -> None:
    with ShardWriter(tmp_path / "set", rig=SMALL, classes=["box"], projector="none") as out:
        shape = SMALL.camera.rows, SMALL.camera.columns
        fields = {"azimuth_deg": "north", "pose": (1.0, 2.0)}
        out.write(key="scene", range_m=np.full(shape, 2.0), labels=np.zeros(shape, int), fields=fields)
    assert SetView(tmp_path / "set").first_index() == 0


def test_panels_of_an_empty_scene_without_a_projector(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with ShardWriter(tmp_path / "set", rig=SMALL, classes=["box"], projector="none") as out:
        shape = SMALL.camera.rows, SMALL.camera.columns
        out.write(key="scene", range_m=np.zeros(shape), labels=np.full(shape, 255))
    monkeypatch.setattr(Layout, "draw", lambda layout, lines: lines)
    drawing = SetView(tmp_path / "set").draw(Shown(variant="all"))
    assert drawing.facts[-1] == "all needs the projector's range, which the sample has not: none is shown"
    panels: Any = drawing.picture
    assert [(each.name, each.note) for each in panels[0]] == [
        ("stored range", "nothing in view"),
        ("labels, none", "0 pixels"),
    ]


def test_other_classes_can_be_shown(small_set: Path) -> None:
    trained = Trained(Places(0, 5), {"rig": SMALL.to_json()})
    view = SetView(small_set, trained, labels="limbs14")
    images = view.images_of(Shown(0, "none"))
    limbs = load_label_map("limbs14")
    np.testing.assert_array_equal(images.layers.labels, limbs.table[view.images.clean(0).labels])
    parts = SetView(small_set, trained).images_of(Shown(0, "none")).layers.answer
    assert parts is not None and images.layers.answer is not None
    np.testing.assert_array_equal(images.layers.answer, PARTS33.joined_to(limbs)[parts])
    assert [name for name, _ in view.draw(Shown(0, "none")).legend] == [
        f"{number} {name}" for number, name in enumerate(limbs.names)
    ]
    assert view.chosen("train", (), ()).label_map.names == limbs.names
    with pytest.raises(BadConfig, match="which splits the class"):
        SetView(small_set, Trained(Places(0, 5), {"rig": SMALL.to_json(), "labels": limbs.to_json()}), labels="parts33")


def test_a_set_shows_regions_of_the_template_without_a_network(
    pack_figures: Callable[..., Path], tmp_path: Path
) -> None:
    folder = pack_figures(tmp_path / "mapped", template=True)
    view = SetView(folder, labels="joints24").chosen("train", (), ())
    images, wanted = view.images_of(Shown(0, "none")), RangeImages(folder, "none", "train", labels="joints24")
    np.testing.assert_array_equal(images.layers.labels, wanted.image(0).labels)
    assert len(view.draw(Shown(0, "none")).legend) == 24


def test_surfaces_without_a_class_have_that_of_the_rest(tmp_path: Path) -> None:
    shape = SMALL.camera.rows, SMALL.camera.columns
    labels = np.full(shape, 254, np.uint8)
    labels[:40] = 0
    with ShardWriter(tmp_path / "set", rig=SMALL, classes=["arm", "wall"]) as out:
        out.write(key="one", range_m=np.full(shape, 2.0, np.float32), labels=labels, split="train")
    classes = RangeImages(tmp_path / "set", "none").manifest.classes
    rest = LabelMap("rest", (("arm", ("arm",)), ("none", ("*",))), of=classes)
    shown = SetView(tmp_path / "set", labels=rest).images_of(Shown(0, "none")).layers.labels
    np.testing.assert_array_equal(shown, RangeImages(tmp_path / "set", "none", labels=rest)[0]["labels"])
    assert (shown == np.where(labels == 254, 1, 0)).all()
