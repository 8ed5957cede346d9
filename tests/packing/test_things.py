"""Things around bodies: what camera and projector see of them, how much they hide, and what a set with them holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from shapes import evenly_drawn, figure, mean_by_place
from small_rig import SMALL

from bodyseg_data import RangeImages
from bodyseg_data.artifacts import VARIANTS, shadow_tests
from bodyseg_data.bodies import BodyRef
from bodyseg_data.core import BadConfig
from bodyseg_data.drawing import Row, draw_sheet
from bodyseg_data.labels import BACKGROUND, PART_COUNT, UNLABELLED
from bodyseg_data.meshes import Solid, cuboid, partition, together
from bodyseg_data.packing import Packing, Sampler, ThingsPlace, draw_things, in_front, plan
from bodyseg_data.packing.things import LEAST_HIDDEN, MOST_HIDDEN, Things, nearest
from bodyseg_data.rendering import RasterRenderer, Surface
from bodyseg_data.rigs import Rig
from bodyseg_data.samples import Sample, View
from bodyseg_data.shards import LocalFolder, encode_sample, find_faults, read_manifest
from bodyseg_data.shards.sample_codec import decode_sample
from bodyseg_model.networks import build
from bodyseg_model.training.loss import NetworkWithLoss

REF = BodyRef("people", "P1", "P1-0", "standing", "test")
MESH = figure()
PARTS = partition(MESH, evenly_drawn(MESH))
PLACES: tuple[ThingsPlace, ...] = ("before", "behind", "both")


def taken(place: ThingsPlace, view: View, rig: Rig = SMALL, name: str = "P1-0") -> Sample:
    ref = replace(REF, mesh=name)
    return Sampler(RasterRenderer(MESH), rig, MESH, PARTS, "open", ref, place).take(view)


def drawn(place: ThingsPlace, view: View, key: str, lit: bool = True) -> tuple[Things, Surface, Surface]:
    """The things, and what the camera sees of the body and of the things; lit: whether the projector counts."""
    camera, projector = SMALL.placed(MESH.centre, view)
    seen = RasterRenderer(MESH).render(camera)
    lights = [(projector, RasterRenderer(MESH).render(projector))] if lit else []
    things = draw_things(place, key, MESH, view, camera, seen, SMALL.range_step_m, projectors=lights)
    return things, seen, things.render(camera)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("view", [View(215, 0), View(255, 130, -20, 10)])
def test_a_sample_shows_the_nearer_of_body_and_things(place: ThingsPlace, view: View) -> None:
    plain, sample = taken("none", view), taken(place, view)
    sample.check()
    assert (sample.key, sample.info.things) == (plain.key, place) and not plain.info.things
    things, _, alone = drawn(place, view, sample.key)
    thing = sample.labels == UNLABELLED
    body = sample.labels < UNLABELLED
    assert thing.any() and body.any()
    for image in ("range", "labels"):
        assert np.array_equal(getattr(sample, image)[body], getattr(plain, image)[body])
    expected = np.rint(alone.range[thing].astype(np.float64) / SMALL.range_step_m)
    assert np.array_equal(sample.range[thing], expected)
    hidden = (plain.range > 0) & thing
    assert (sample.range[hidden] <= plain.range[hidden]).all()
    assert sample.info.hidden_pct == round(100 * hidden.sum() / (plain.range > 0).sum()) == round(100 * things.hidden)


def test_part_of_the_body_stays_lit() -> None:
    view = View(215, 40)
    _, projector = SMALL.placed(MESH.centre, view)
    lit_body = RasterRenderer(MESH).render(projector)

    def shaded(key: str, lit: bool) -> float:
        things, _, _ = drawn("before", view, key, lit)
        body = lit_body.face >= 0
        return float((in_front(things.render(projector), lit_body) & body).sum() / body.sum())

    keys = [f"k{number}" for number in range(12)]
    assert max(shaded(key, True) for key in keys) <= MOST_HIDDEN < max(shaded(key, False) for key in keys)


def test_body_and_things_are_rendered_as_one_mesh_would_be() -> None:
    view = View(215, 40)
    things, seen, alone = drawn("both", view, "a")
    joined = RasterRenderer(together([Solid(MESH.vertices, MESH.faces), things.solid]))
    camera, _ = SMALL.placed(MESH.centre, view)
    whole, merged = joined.render(camera), nearest(seen, alone, len(MESH.faces))
    assert np.array_equal(whole.range, merged.range)
    assert np.array_equal(whole.face, merged.face)


def test_things_cast_shadows_and_receive_them() -> None:
    view = View(215, 0)
    with_things = [
        (taken("none", view, name=f"P{number}"), taken("before", view, name=f"P{number}")) for number in range(8)
    ]
    shadow = lit_thing = dark_thing = 0
    for plain, sample in with_things:
        test = shadow_tests(SMALL)[0]
        lit = test.lit(sample.range, sample.occluder_range(), sample.faces_projector)
        before = test.lit(plain.range, plain.occluder_range(), plain.faces_projector)
        body = sample.labels < UNLABELLED
        shadow += int((before & ~lit & body).sum())
        assert not (lit & ~before & body).any(), "a thing takes light from the body and adds none"
        thing = sample.labels == UNLABELLED
        lit_thing, dark_thing = lit_thing + int((lit & thing).sum()), dark_thing + int((~lit & thing).sum())
    assert shadow > 100 and lit_thing > 1000 and dark_thing > 100


@pytest.mark.parametrize(("place", "expected"), [*zip(PLACES, (0.6850431, -0.0692224, 0.1966444), strict=True)])
def test_things_stay_where_they_were_drawn(place: ThingsPlace, expected: float) -> None:
    """Elsewhere they are other bytes of sets with things, and need a new `PACKING_VERSION`."""
    solids = [drawn(place, View(215, 40), f"key {number}")[0].solid for number in range(3)]
    assert mean_by_place(np.concatenate([solid.vertices for solid in solids])) == pytest.approx(expected, abs=1e-6)


def test_facing_is_that_of_outward_normals() -> None:
    things = Things(cuboid((1.0, 1.0, 1.0), (0.0, 0.0, 0.0)), 0.001)
    towards = things.facing(np.arange(12, dtype=np.int32), np.array([0.0, 0.0, 9.0]))
    assert np.array_equal(towards, things.solid.normals[:, 2] > 0) and towards.sum() == 2


def test_how_much_is_hidden_is_bounded_and_follows_from_the_key() -> None:
    shares = []
    for number in range(40):
        things, _, _ = drawn("before", View(255, 9 * number), f"key {number}")
        again, _, _ = drawn("before", View(255, 9 * number), f"key {number}")
        assert np.array_equal(things.solid.vertices, again.solid.vertices)
        shares.append(things.hidden)
    assert min(shares) >= LEAST_HIDDEN and max(shares) <= MOST_HIDDEN
    assert len(set(shares)) == 40 and np.mean(shares) > 0.15
    behind = [drawn("behind", View(255, 0), f"key {number}")[0] for number in range(10)]
    assert all(things.hidden <= MOST_HIDDEN and len(things.solid.faces) for things in behind)


def test_a_view_from_above_needs_no_thing_before_the_body() -> None:
    sample = taken("both", View(215, 0, -90))
    sample.check()
    assert (sample.labels < UNLABELLED).any()


def test_what_is_farther_than_16_bits_hold_is_not_measured() -> None:
    fine = replace(SMALL, range_step_mm=0.05)  # reaches 3.28 m
    for number in range(6):
        sample = taken("behind", View(255, 0), fine, f"P{number}")
        assert sample.range.max() * fine.range_step_m < 3.28
        sample.check()


def test_stored_samples_are_the_same_after_reading() -> None:
    sample = taken("both", View(215, 0))
    for codec in ("bsi", "png"):
        read = decode_sample(sample.key, encode_sample(sample, codec))
        read.check()
        assert np.array_equal(read.labels, sample.labels) and np.array_equal(read.range, sample.range)
        assert np.array_equal(read.faces_projector, sample.faces_projector) and read.info == sample.info


@pytest.fixture(scope="module")
def among_things(pack_figures: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return pack_figures(tmp_path_factory.mktemp("things") / "shards", things="both")


def test_a_set_with_things_is_streamed_in_every_variant(among_things: Path) -> None:
    manifest = read_manifest(among_things)
    assert not [fault for shard in manifest.shards for fault in find_faults(LocalFolder(among_things), manifest, shard)]
    clean = RangeImages(among_things, "none")
    for variant in VARIANTS:
        images = RangeImages(among_things, variant)
        for index in (0, 5):
            sample, image = clean.clean(index), images.image(index)
            assert (image.labels[image.range == 0] == BACKGROUND).all()
            kept = image.range > 0
            assert np.array_equal(image.labels[kept], sample.labels[kept])
            assert (kept & (sample.labels == BACKGROUND)).any(), "things are measured like bodies"


def test_the_loss_ignores_things(among_things: Path) -> None:
    images = RangeImages(among_things, "none", "train")
    batch = [images[index] for index in range(2)]
    ranges, labels = (torch.stack([one[name] for one in batch]) for name in ("range", "labels"))
    assert ((labels == BACKGROUND) & (ranges[:, 0] > 0)).any()
    network = build("compact", {"patch": 16, "widths": (8,), "blocks": (0,)})
    loss = NetworkWithLoss(network, torch.ones(PART_COUNT))
    found = loss(ranges, labels, torch.zeros(2, dtype=torch.long))
    named = torch.where((labels == BACKGROUND) & (ranges[:, 0] > 0), 0, labels)
    counted, more = found.counts.sum(), loss(ranges, named, torch.zeros(2, dtype=torch.long)).counts.sum()
    assert torch.isfinite(found.loss) and 0 < counted < more
    assert int(counted) == pytest.approx(int((labels != BACKGROUND).sum()) / 4**2, rel=0.1), "of every fourth pixel"


def test_a_contact_sheet_shows_things_in_grey(among_things: Path) -> None:
    images = RangeImages(among_things, "all")
    sample = images.clean(0)
    row = Row(sample, images.step_m, {name: RangeImages(among_things, name).image(0) for name in VARIANTS})
    sheet = np.asarray(draw_sheet([row], "none", "title", images.augmentation.sensor))
    assert (sheet == (112, 116, 124)).all(axis=-1).sum() > 100


def test_a_plan_with_things_is_another_one(
    among_things: Path, pack_figures: Callable[..., Path], tmp_path: Path
) -> None:
    plain = read_manifest(pack_figures(tmp_path / "plain"))
    assert plain.plan != read_manifest(among_things).plan
    assert plan(Packing("open", meshes=1, things="both")) == plan(Packing("open", meshes=1))
    with pytest.raises(BadConfig, match="things must be 'none' or 'before' or 'behind' or 'both', found 'above'$"):
        Packing("open", things="above")  # type: ignore[arg-type]
