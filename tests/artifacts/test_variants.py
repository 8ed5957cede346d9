from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benches.data.occlusion.scaled_rig import with_projector_scale
from hypothesis import given
from hypothesis import strategies as st
from kernel_forms import by_both
from numpy.typing import NDArray
from samples import body_info
from strategies import keys

from bodyseg_data.artifacts import (
    PAIRS,
    VARIANTS,
    Augmentation,
    Losses,
    MissingData,
    Noise,
    Occlusion,
    RangeImage,
    ShadowTest,
    VariantName,
    check_variant,
    load_sensor_model,
    shown_with,
)
from bodyseg_data.core import BadConfig, BadSample
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.loading import RangeImages
from bodyseg_data.rigs import Camera, Rig
from bodyseg_data.samples import Sample, SampleInfo


@pytest.fixture(scope="module")
def clean(figures_set: Path) -> list[Sample]:
    images = RangeImages(figures_set)
    return [images.clean(index) for index in range(len(images))]


def made(figures_set: Path, sample: Sample, epoch: int = 0, **options: Any) -> dict[str, RangeImage]:
    rig = RangeImages(figures_set).manifest.rig
    return {name: Augmentation(rig, name, **options)(sample, epoch) for name in VARIANTS}


def test_table_1() -> None:
    kinds = "occlusion", "noise", "missing_data"
    assert {name: tuple(kind in has for kind in kinds) for name, has in VARIANTS.items()} == {
        "none": (False, False, False),
        "occ": (True, False, False),
        "noise": (False, True, False),
        "md": (False, False, True),
        "all": (True, True, True),
    }
    known = r"none, occ, noise, md, all, occ\+noise, occ\+md, noise\+md"
    with pytest.raises(BadConfig, match=f"the variant must be one of {known}, found 'full'"):
        check_variant("full")


def test_the_five_variants_share_their_draws(figures_set: Path, clean: list[Sample]) -> None:
    removed = {"occ": 0, "md": 0}
    for sample in clean:
        images = made(figures_set, sample)
        kept = {name: image.range > 0 for name, image in images.items()}
        assert np.array_equal(images["none"].range, sample.range)
        assert np.array_equal(images["none"].labels, sample.labels)
        assert np.array_equal(kept["noise"], kept["none"])
        assert np.array_equal(kept["all"], kept["occ"] & kept["md"])
        assert np.array_equal(images["all"].range[kept["all"]], images["noise"].range[kept["all"]])
        for name in ("occ", "md"):
            assert np.array_equal(images[name].range[kept[name]], sample.range[kept[name]])
            removed[name] += int((kept["none"] & ~kept[name]).sum())
        assert images["none"].drawn == images["occ"].drawn == {}
        assert images["all"].drawn == {**images["noise"].drawn, **images["md"].drawn}
        assert list(images["all"].drawn) == ["sigma_mm", "missing_rate"]
        for image in images.values():
            # A pixel the variant removed has nothing to classify; all others keep their label.
            assert np.array_equal(image.labels, np.where(image.range > 0, sample.labels, BACKGROUND))
    assert removed["occ"] > 0
    assert removed["md"] > 0


def test_the_occluded_variant_is_the_shadow_test(figures_set: Path, clean: list[Sample]) -> None:
    test = ShadowTest(RangeImages(figures_set).manifest.rig)
    for sample in clean[:4]:
        lit = test.lit(sample.range, sample.projector_range, sample.faces_projector)
        assert np.array_equal(made(figures_set, sample)["occ"].range > 0, lit)


def test_draws_differ_by_epoch_seed_and_sample(figures_set: Path, clean: list[Sample]) -> None:
    first = made(figures_set, clean[0])["noise"].range
    assert np.array_equal(first, made(figures_set, clean[0])["noise"].range)
    assert not np.array_equal(first, made(figures_set, clean[0], epoch=1)["noise"].range)
    assert not np.array_equal(first, made(figures_set, clean[0], seed=1)["noise"].range)
    assert len({made(figures_set, sample)["noise"].drawn["sigma_mm"] for sample in clean}) == len(clean)


def same_bits(a: RangeImage, b: RangeImage) -> bool:
    return (
        (a.key, a.drawn) == (b.key, b.drawn) and np.array_equal(a.range, b.range) and np.array_equal(a.labels, b.labels)
    )


def in_both_forms(augmentation: Augmentation, sample: Sample, epoch: int = 0) -> RangeImage:
    """What the plain form makes, after comparing with the compiled one."""

    def image() -> RangeImage:
        dirty = np.full(sample.range.shape, 12_345, np.uint16), np.full(sample.range.shape, 77, np.uint8)
        made = augmentation.into(sample, epoch, *dirty)
        assert made.range is dirty[0] and made.labels is dirty[1]
        assert same_bits(made, augmentation(sample, epoch))
        return made

    compiled, plain = by_both(image)
    assert same_bits(compiled, plain)
    return plain


@pytest.mark.parametrize("name", VARIANTS)
def test_both_forms_give_the_same_bits_of_rendered_samples(
    figures_set: Path, clean: list[Sample], name: VariantName
) -> None:
    augmentation = Augmentation(RangeImages(figures_set).manifest.rig, name)
    for epoch, sample in enumerate(clean):
        in_both_forms(augmentation, sample, epoch)


@st.composite
def scenes(draw: st.DrawFn) -> tuple[Rig, Sample]:
    """A rig of few pixels and a sample that fits it: whole, empty and sprinkled frames, surfaces, edges, extremes."""
    rows, columns = draw(st.integers(1, 20)), draw(st.integers(1, 20))
    camera = Camera(rows, columns, 30.0, (columns / 2, rows / 2), (0.0, 0.0, 0.0), (0.0, 0.0, 2.5))
    aim = (draw(st.floats(-1, 1)), 0.0, draw(st.sampled_from([2.5, 0.4, -2.5])))
    projector = replace(camera, focal_px=28.0, position_m=(draw(st.floats(-1, 1)), 0.03, 0.1), aims_at_m=aim)
    second = None
    if draw(st.booleans()):
        second = replace(projector, rows=draw(st.integers(1, 20)), position_m=(draw(st.floats(-1, 1)), 0.2, 0.0))
    rig = Rig("random", 2.5, camera, projector, second_projector=second)
    rig = with_projector_scale(rig, draw(st.integers(1, 3)))
    draws = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))

    def image(device: Camera) -> NDArray[np.uint16]:
        shape = device.rows, device.columns
        y, x = np.mgrid[: device.rows, : device.columns]
        surface = draws.uniform(2_000, 60_000) + draws.uniform(-60, 60) * y + draws.uniform(-60, 60) * x
        made = np.clip(surface + draws.choice([0, 100, 300, 5_000, -5_000], shape, p=[0.8, *[0.05] * 4]), 1, 65_535)
        made[draws.random(shape) < 0.02] = draws.choice([1, 65_535])
        made[draws.random(shape) < draws.choice([0.0, 0.1, 0.9, 1.0])] = 0
        return made.astype(np.uint16)

    seen, projected = image(rig.camera), np.concatenate([image(each) for each in rig.projectors])
    labels = np.where(seen > 0, draws.integers(0, 33, seen.shape), BACKGROUND).astype(np.uint8)
    facing, *others = ((seen > 0) & (draws.random(seen.shape) < draws.choice([0.0, 0.8, 1.0])) for _ in rig.projectors)
    return rig, Sample(draw(keys), seen, projected, labels, facing, _info(), faces_second=others[0] if others else None)


@given(
    scene=scenes(),
    noise=st.sampled_from([Noise(), Noise(0.0, 0.0), Noise(1000.0, 1000.0)]),
    rate=st.sampled_from([0.0, 2**-17, 0.05, 0.5, 1.0]),
    losses=st.sampled_from([None, Losses(0.6)]),
    seed=st.integers(0, 2**63 - 1),
    epoch=st.integers(0, 2**70),
)
def test_both_forms_give_the_same_bits_of_anything(
    scene: tuple[Rig, Sample], noise: Noise, rate: float, losses: Losses | None, seed: int, epoch: int
) -> None:
    rig, sample = scene
    sample.check()
    artifacts = load_sensor_model().with_artifacts(noise, MissingData(rates=(rate,)), *([losses] if losses else []))
    made = {name: in_both_forms(Augmentation(rig, name, seed, artifacts), sample, epoch) for name in VARIANTS}
    foreground = sample.range > 0
    # No pixel appears, vanishes by rounding, or wraps around: six sigma and a half, in steps, is the farthest.
    assert np.array_equal(made["noise"].range > 0, foreground)
    assert (np.abs(made["noise"].range.astype(int) - sample.range) <= noise.high_mm * 10 * 6.4 + 0.5).all()
    assert np.array_equal(made["none"].range, sample.range)
    kept = {name: image.range > 0 for name, image in made.items()}
    assert np.array_equal(kept["all"], kept["occ"] & kept["md"])
    assert np.array_equal(made["all"].range[kept["all"]], made["noise"].range[kept["all"]])
    if rate == 1 or (rate == 0 and losses is None):
        assert np.array_equal(kept["md"], foreground & (rate == 0))


def test_arrays_that_nothing_may_write_to_or_that_are_parts_of_others_are_read() -> None:
    rig, sample = _synthetic()
    wide = np.zeros((24, 40), np.uint16)
    wide[:, ::2] = sample.range
    constant = sample.labels.copy()
    constant.flags.writeable = False
    odd = np.zeros(sample.projector_range.nbytes + 1, np.uint8)[1:].view(np.uint16).reshape(24, 20)
    odd[:] = sample.projector_range
    assert not odd.flags.aligned
    other = replace(sample, range=wide[:, ::2], labels=constant, projector_range=odd)
    for name in VARIANTS:
        assert same_bits(in_both_forms(Augmentation(rig, name), other), Augmentation(rig, name)(sample))
    assert not constant.flags.writeable and sample.range.flags.writeable and sample.labels.flags.writeable


@pytest.mark.usefixtures("either_form")
@pytest.mark.parametrize("name", VARIANTS)
def test_a_sample_may_be_altered_in_place(name: VariantName, clean: list[Sample], figures_set: Path) -> None:
    images = RangeImages(figures_set, name)
    image, labels = np.empty_like(clean[0].range), np.empty_like(clean[0].labels)
    for index, sample in enumerate(clean):
        expected = images.augmentation(sample, 3)
        copy = replace(sample, range=sample.range.copy(), labels=sample.labels.copy())
        assert same_bits(images.augmentation.into(copy, 3, copy.range, copy.labels), expected)
        images.write(index, 3, image, labels)  # which decodes in place and knows where the images hold anything
        assert same_bits(replace(expected, range=image, labels=labels), expected)


@pytest.mark.usefixtures("either_form")
@pytest.mark.parametrize("name", VARIANTS)
def test_arrays_that_do_not_fit_the_sample_are_refused(name: VariantName) -> None:
    rig, sample = _synthetic()
    augmentation = Augmentation(rig, name)
    image, labels = np.zeros((24, 20), np.uint16), np.zeros((24, 20), np.uint8)
    constant = image.copy()
    constant.flags.writeable = False
    unfit, apart = r"the image must be uint16 \(24, 20\)", "images must be contiguous arrays that can be written to"
    gaps = np.zeros((24, 40), np.uint16)[:, ::2]
    for wrong, said in ((image[1:], unfit), (image.astype(np.int32), unfit), (gaps, apart), (constant, apart)):
        with pytest.raises(BadSample, match=f"^pinned: {said}"):
            augmentation.into(sample, 0, wrong, labels)
    with pytest.raises(BadSample, match=r"^pinned: the image of labels must be uint8 \(24, 20\) .*, found bool"):
        augmentation.into(sample, 0, image, labels > 0)  # type: ignore[arg-type]
    with pytest.raises(
        BadSample, match=r"^pinned: range must be uint16 \(24, 20\) as in the rig, found uint16 \(23, 20\)$"
    ):
        augmentation(replace(sample, range=sample.range[1:], labels=sample.labels[1:]))
    if "occlusion" in VARIANTS[name]:
        with pytest.raises(BadSample, match="the projector's range is needed"):
            augmentation.into(replace(sample, projector_range=None), 0, image, labels)
        with pytest.raises(BadSample, match="the projector range must be uint16"):
            augmentation.into(replace(sample, projector_range=image[1:]), 0, image, labels)
    else:
        assert same_bits(augmentation(replace(sample, projector_range=None)), augmentation(sample))


@pytest.mark.usefixtures("either_form")
@pytest.mark.parametrize("name", VARIANTS)
def test_a_sample_without_a_label_for_every_range_is_refused(name: VariantName) -> None:
    rig, sample = _synthetic()
    augmentation = Augmentation(rig, name)
    for wrong in (sample.labels[:1, :1], sample.labels[1:], sample.labels.astype(np.uint16)):
        with pytest.raises(BadSample, match=r"^pinned: labels must be uint8 \(24, 20\) as in the rig, found"):
            augmentation(replace(sample, labels=wrong))
    with pytest.raises(BadSample, match="range must be .*, found int64"):
        augmentation(replace(sample, range=sample.range.astype(np.int64)))


def _synthetic() -> tuple[Rig, Sample]:
    """A slope and a plate before it, by formula: nothing here depends on a renderer."""
    camera = Camera(24, 20, 40.0, (10.0, 12.0), (0.0, 0.0, 0.0), (0.0, 0.0, 2.0))
    projector = replace(camera, position_m=(-0.6, 0.0, 0.0))
    rows, columns = np.mgrid[:24, :20]
    plate = (rows >= 6) & (rows < 16) & (columns >= 4) & (columns < 10)
    ranges = np.where(plate, 14_000, 20_000 + 10 * rows).astype(np.uint16)
    ranges[:2] = 0
    seen = np.where((rows >= 6) & (rows < 16) & (columns >= 12) & (columns < 19), 15_000, 21_000).astype(np.uint16)
    labels = np.where(ranges == 0, BACKGROUND, (rows + columns) % 33).astype(np.uint8)
    facing = (ranges > 0) & (columns < 18)
    return Rig("small", 2.0, camera, projector), Sample("pinned", ranges, seen, labels, facing, _info())


def _info() -> SampleInfo:
    return body_info()


PINNED = {
    "none": "61bf1849b19ef709",
    "occ": "e729783d4a545aca",
    "noise": "0b1738ef81f2a3e1",
    "md": "536a530a38235606",
    "all": "29eeb1281b14b13c",
}


@pytest.mark.parametrize("name", VARIANTS)
def test_the_bits_of_every_variant_are_pinned(name: VariantName) -> None:
    """A set described by (shards, variant, seed, epoch) must stay what it was."""
    rig, sample = _synthetic()
    sample.check()
    augmentation = Augmentation(rig, name, seed=5)
    images = [in_both_forms(augmentation, replace(sample, key=f"pinned-{n}"), 2) for n in range(4)]
    data = b"".join(image.range.astype("<u2").tobytes() + image.labels.tobytes() for image in images)
    assert hashlib.sha256(data).hexdigest()[:16] == PINNED[name]


def test_settings_reach_the_images(figures_set: Path, clean: list[Sample]) -> None:
    artifacts = load_sensor_model().with_artifacts(Noise(10.0, 10.0), MissingData(rates=(1.0,)))
    images = made(figures_set, clean[0], sensor=artifacts)
    assert images["noise"].drawn["sigma_mm"] == 10
    assert not images["md"].range.any()
    assert (images["md"].labels == BACKGROUND).all()


def test_one_artifact_alone_is_its_variant(figures_set: Path, clean: list[Sample]) -> None:
    rig = RangeImages(figures_set).manifest.rig
    for sample in clean[:4]:
        before = sample.range.copy()
        for name, artifact in (("occ", Occlusion()), ("noise", Noise(5.0, 20.0)), ("md", MissingData((0.3,)))):
            augmentation = Augmentation(rig, name, 7, load_sensor_model().with_artifacts(artifact))
            assert same_bits(shown_with(artifact, sample, rig, 7, epoch=2), augmentation(sample, 2))
        assert np.array_equal(sample.range, before)


def test_a_pair_is_all_but_one(figures_set: Path, clean: list[Sample]) -> None:
    rig = RangeImages(figures_set).manifest.rig
    sample = clean[0]
    images = {name: Augmentation(rig, name)(sample) for name in ("all", "occ", "noise", "md", *PAIRS)}
    kept = {name: image.range > 0 for name, image in images.items()}
    assert np.array_equal(kept["occ+noise"], kept["occ"])
    assert np.array_equal(kept["noise+md"], kept["md"])
    assert np.array_equal(images["occ+md"].range, np.where(kept["all"], sample.range, 0))
    for name in ("occ+noise", "noise+md"):
        assert np.array_equal(images[name].range[kept[name]], images["noise"].range[kept[name]])


def test_losses_take_more_where_there_is_missing_data(figures_set: Path, clean: list[Sample]) -> None:
    rig = RangeImages(figures_set).manifest.rig
    strong = load_sensor_model().with_artifacts(Losses(0.5))
    lost = 0
    for sample in clean:
        usual, more = Augmentation(rig, "all")(sample), Augmentation(rig, "all", sensor=strong)(sample)
        gone = (usual.range > 0) & (more.range == 0)
        assert np.array_equal(more.range, np.where(gone, 0, usual.range))
        assert np.array_equal(more.labels, np.where(gone, BACKGROUND, usual.labels))
        lost += int(gone.sum())
        plain = Augmentation(rig, "noise", sensor=strong)(sample)
        assert np.array_equal(plain.range, Augmentation(rig, "noise")(sample).range)
    assert lost > 0


def test_losses_are_those_of_the_clean_image_even_in_its_own_arrays(figures_set: Path, clean: list[Sample]) -> None:
    augmentation = Augmentation(
        RangeImages(figures_set).manifest.rig, "all", sensor=load_sensor_model().with_artifacts(Losses(0.5))
    )
    for sample in clean[:4]:
        expected = augmentation(sample)
        own = replace(sample, range=sample.range.copy(), labels=sample.labels.copy())
        assert same_bits(augmentation.into(own, 0, own.range, own.labels), expected)
