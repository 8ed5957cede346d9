"""The protocol of artifacts: what every registered one keeps, and a new one that is one class and one entry."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import FrozenInstanceError, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, get_args

import numpy as np
import pytest
from kernel_forms import by_both

from bodyseg_data import RangeImages, SensorModel, load_sensor_model, loader
from bodyseg_data.artifacts import (
    Artifact,
    Losses,
    MissingData,
    MixedPixels,
    Noise,
    Occlusion,
    RangeImage,
    Scene,
    sensor_model_names,
)
from bodyseg_data.artifacts.artifact import Kind
from bodyseg_data.artifacts.lost_pixels import PatchLoss, StripeLoss
from bodyseg_data.artifacts.registry import ARTIFACTS
from bodyseg_data.commands.inspect import summarise
from bodyseg_data.core import BadConfig, Draws
from bodyseg_data.core.randomness import Stream
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.samples import Sample
from bodyseg_model.commands import train
from bodyseg_model.evaluation import open_images

PAPER = load_sensor_model()


@dataclass(frozen=True)
class Dots(Artifact):
    """Pixels lost one by one, and all others moved away by a centimetre."""

    name = "dots"
    kind = "noise"
    purposes = ("share of dots", "dots")
    drawn: ClassVar[Mapping[str, str]] = {"dot_share": "{:.0%} dots"}

    most: float = 0.5

    def draw(self, draws: Draws) -> dict[str, float]:
        return {"dot_share": self.most * draws.chance("share of dots")}

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        image.range[image.range > 0] += round(0.01 / scene.step_m)
        lost = draws.pixels("dots", len(scene.pixels), np.uint16) < image.drawn["dot_share"] * 65536
        image.range.reshape(-1)[scene.pixels[lost]] = 0


@dataclass(frozen=True)
class Strays(Artifact):
    name = "strays"
    kind = "noise"
    purposes = ("strays",)

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        image.range[...] += draws.pixels("missing data", image.range.size, np.uint16).reshape(image.range.shape) // 99


@dataclass(frozen=True)
class Named(Strays):
    drawn: ClassVar[Any] = ("share",)


@pytest.fixture
def dots(monkeypatch: pytest.MonkeyPatch) -> SensorModel:
    """The paper's artifacts and one more, which the registry now has."""
    monkeypatch.setitem(ARTIFACTS, "dots", Dots)
    return PAPER.with_artifacts(Dots(0.8))


@pytest.mark.parametrize("workers", [0, 2])
def test_a_new_artifact_streams_in_every_variant_of_its_kind_and_changes_no_other_draw(
    figures_set: Path, dots: SensorModel, workers: int
) -> None:
    def streamed(variant: str, sensor: SensorModel | None = None) -> dict[str, tuple[Any, Any]]:
        images = RangeImages(figures_set, variant, sensor=sensor or PAPER)
        batches = loader(images, 5, workers, shuffle=False)
        return {
            key: (ranges.numpy()[0], labels.numpy())
            for batch in batches
            for key, ranges, labels in zip(batch["key"], batch["range"], batch["labels"], strict=True)
        }

    clean, noise, all_, dotted, all_dotted = (
        streamed(variant, sensor)
        for variant, sensor in (("none", None), ("noise", None), ("all", None), ("noise", dots), ("all", dots))
    )
    assert len(clean) == 24
    lost = 0
    for key, (ranges, labels) in clean.items():
        kept = dotted[key][0] > 0
        lost += np.count_nonzero((ranges > 0) & ~kept)
        np.testing.assert_allclose(dotted[key][0][kept], noise[key][0][kept] + 0.01, atol=2e-6)
        # Where `all` keeps a pixel it is lost by the dots of `noise` and by no others.
        np.testing.assert_array_equal(all_dotted[key][0] > 0, (all_[key][0] > 0) & kept)
        shown = all_dotted[key][0] > 0
        np.testing.assert_array_equal(all_dotted[key][0][shown], dotted[key][0][shown])
        for image in (dotted[key], all_dotted[key]):
            np.testing.assert_array_equal(image[1], np.where(image[0] > 0, labels, BACKGROUND))
    assert lost > 1000
    for variant in ("none", "occ", "md"):
        plain = streamed(variant)
        for key, pair in streamed(variant, dots).items():
            for ours, theirs in zip(pair, plain[key], strict=True):
                np.testing.assert_array_equal(ours, theirs)


def test_an_artifact_draws_for_its_own_purposes_alone(figures_set: Path) -> None:
    sensor = PAPER.with_artifacts(Strays())
    with pytest.raises(BadConfig, match=r"^random numbers .* that an artifact lists, 'strays': 'missing data'$"):
        RangeImages(figures_set, "noise", sensor=sensor).image(0)
    with pytest.raises(BadConfig, match="drawn a dict, name -> caption, in Named"):
        PAPER.with_artifacts(Named())


def test_a_new_artifact_is_found_by_name_everywhere(figures_set: Path, dots: SensorModel) -> None:
    images = RangeImages(figures_set, "noise", sensor=dots)
    assert images.identity()["artifacts"][-1] == {"artifact": "dots", "version": 1, "most": 0.8}
    assert [each["artifact"] for each in images.identity()["artifacts"]] == [each.name for each in dots]
    image = images.image(0)
    assert list(image.drawn) == ["sigma_mm", "dot_share"]
    assert dots.caption({"sigma_mm": 22.6, "dot_share": 0.5}) == "noise 23 mm, 50% dots"
    assert summarise(images)["mean_dot_share"] == pytest.approx(0.4, abs=0.2)
    given = '{"dots": {"most": 0.3}, "noise": {"high_mm": 7}}'
    options = train.Options(("data",), Path("run"), artifacts=given, losses=0.2)
    assert train._sensor(options, "all", "paper") == PAPER.with_artifacts(Dots(0.3), Noise(high_mm=7), Losses(0.2))
    evaluated = open_images(str(figures_set), "noise", noise_mm=4, artifacts=(Dots(0.1),))
    assert evaluated.augmentation.sensor == PAPER.with_artifacts(Noise(4, 4), Dots(0.1))


def test_the_artifact_of_the_documentation_works(figures_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (Path(__file__).parents[2] / "docs" / "how-to" / "add_your_own.md").read_text()
    block = text[text.index("@dataclass(frozen=True)") : text.index("\nsensor = SensorModel(")]
    names: dict[str, Any] = dict(globals())
    exec(block, names)
    monkeypatch.setitem(ARTIFACTS, "dead_rows", names["DeadRows"])
    usual = RangeImages(figures_set, "md")
    images = RangeImages(figures_set, "md", sensor=PAPER.with_artifacts(names["DeadRows"](0.3)))
    lost = 0
    for index in range(4):
        image, before = images.image(index), usual.image(index)
        kept = (image.range > 0).any(axis=1)
        np.testing.assert_array_equal(image.range[kept], before.range[kept])
        lost += int(((before.range > 0).any(axis=1) & ~kept).sum())
    assert lost > 50


def in_both_forms(images: RangeImages, count: int) -> list[tuple[RangeImage, RangeImage]]:
    """The first images, each with compiled loops and in NumPy."""
    return [by_both(partial(images.image, index)) for index in range(count)]


def test_without_compiled_loops_a_new_artifact_gives_the_same_bits(
    figures_set: Path, dots: SensorModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = RangeImages(figures_set, "all", sensor=PAPER.with_artifacts(*dots, Losses(0.3)))
    for ours, theirs in in_both_forms(images, 6):
        assert ours.drawn == theirs.drawn
        np.testing.assert_array_equal(ours.range, theirs.range)
        np.testing.assert_array_equal(ours.labels, theirs.labels)


@pytest.mark.parametrize("name", [*ARTIFACTS, *sensor_model_names()])
def test_both_forms_of_every_artifact_and_sensor_give_the_same_bits(
    name: str, figures_set: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name in ARTIFACTS:
        mixed = {"share": 0.9, "background_m": 5.0, "least": 0.1, "nearest_m": 2.0}
        strengths = {"losses": {"most": 0.5}, "mixed_pixels": mixed}.get(name, {})
        sensor = SensorModel("one", (ARTIFACTS[name](**strengths),))
    else:
        sensor = load_sensor_model(name)
    images = RangeImages(figures_set, "all", sensor=sensor, seed=3)
    for ours, theirs in in_both_forms(images, 8):
        np.testing.assert_array_equal(ours.range, theirs.range)
        np.testing.assert_array_equal(ours.labels, theirs.labels)


def test_the_compiled_call_takes_what_it_covers_from_the_first_artifact_on() -> None:
    from bodyseg_data.artifacts.fused_loops import covered

    class OtherNoise(Noise):
        pass

    occlusion, noise, missing = Occlusion(), Noise(), MissingData()
    for count, artifacts in (
        (3, (occlusion, noise, missing)),
        (3, (occlusion, noise, missing, Losses(0.1))),
        (2, (noise, missing, occlusion)),
        (1, (occlusion, Losses(0.1), noise, missing)),
        (1, (missing, noise)),
        (1, (noise, noise)),
        (0, (Losses(0.1), occlusion, noise, missing)),
        (0, (OtherNoise(), missing)),
        (0, ()),
    ):
        assert covered(artifacts) == count, artifacts


def test_in_another_order_the_rest_follows_in_numpy(figures_set: Path) -> None:
    expected = RangeImages(figures_set, "all", sensor=PAPER.with_artifacts(Losses(0.4)))
    order = ("noise", "losses", "occlusion", "missing_data")
    artifacts = {each.name: each for each in expected.augmentation.sensor}
    images = RangeImages(figures_set, "all", sensor=SensorModel("other", tuple(artifacts[name] for name in order)))
    assert [artifact.name for artifact in images.augmentation.applied] == list(order)
    image, labels = np.empty_like(images.clean(0).range), np.empty_like(images.clean(0).labels)
    for index in range(6):
        # None of these depends on the others, so the order changes no bit.
        np.testing.assert_array_equal(images.image(index).range, expected.image(index).range)
        images.write(index, 0, image, labels)
        np.testing.assert_array_equal(image, expected.image(index).range)
        np.testing.assert_array_equal(labels, expected.image(index).labels)


class Noted(Draws):
    """Draws that note their purposes."""

    def __init__(self, key: str, purposes: set[str]) -> None:
        super().__init__(0, 0, key)
        object.__setattr__(self, "purposes", purposes)

    def _note(self, purpose: str) -> str:
        self.__dict__["purposes"].add(purpose)
        return purpose

    def chance(self, purpose: str) -> float:
        return super().chance(self._note(purpose))

    def stream(self, purpose: str) -> Stream:
        return super().stream(self._note(purpose))

    def generator(self, purpose: str) -> np.random.Generator:
        return super().generator(self._note(purpose))


@pytest.mark.parametrize("name", ARTIFACTS)
def test_every_artifact_keeps_the_rules_of_the_protocol(name: str, figures_set: Path) -> None:
    kind = ARTIFACTS[name]
    artifact = {
        "losses": Losses(0.5),
        "mixed_pixels": MixedPixels(1.0, 5.0, least=0.2, nearest_m=4.0),
        "patch_loss": PatchLoss(0.2, 0.5),
        "stripe_loss": StripeLoss(0.2, 0.5),
    }.get(name, kind())
    assert kind.name == name and kind.kind in get_args(Kind)
    assert hash(artifact) == hash(replace(artifact))
    assert all(hasattr(artifact, field.name) for field in fields(artifact))
    with pytest.raises(FrozenInstanceError):
        artifact.name = "other"  # type: ignore[misc]
    images = RangeImages(figures_set)
    purposes: set[str] = set()
    changed = 0
    for index in range(12):
        sample = images.clean(index)
        if not kind.needs_projector:
            sample = replace(sample, projector_range=None)
        before = sample.range.copy(), sample.labels.copy()
        draws = Noted(sample.key, purposes)
        drawn = artifact.draw(draws)
        assert drawn.keys() == kind.drawn.keys()
        image = RangeImage(sample.key, sample.range.copy(), sample.labels.copy(), drawn)
        artifact.apply(image, Scene(sample, images.manifest.rig), draws)
        np.testing.assert_array_equal(sample.range, before[0])
        np.testing.assert_array_equal(sample.labels, before[1])
        assert not image.range[sample.range == 0].any()
        assert kind.name not in ("noise", "mixed_pixels") or ((image.range == 0) == (sample.range == 0)).all()
        changed += not np.array_equal(image.range, sample.range)
    assert changed > 3
    assert purposes == set(kind.purposes)


def test_purposes_and_quantities_are_of_one_artifact_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    class Twin(Dots):
        name = "twin"

    class Sigma(Twin):
        purposes = ("sigma",)

    with pytest.raises(BadConfig, match="purposes of artifacts must differ, found 'share of dots' of dots and twin"):
        PAPER.with_artifacts(Dots(), Twin())
    with pytest.raises(BadConfig, match="purposes of artifacts must differ, found 'sigma' of noise and twin"):
        PAPER.with_artifacts(Sigma())
    monkeypatch.setattr(Sigma, "purposes", ())
    with pytest.raises(BadConfig, match="drawn quantities .* found 'dot_share' of dots and twin"):
        PAPER.with_artifacts(Dots(), Sigma())


def test_images_samples_and_augmentations_are_shown_in_a_line(figures_set: Path) -> None:
    images = RangeImages(figures_set, "noise", sensor=PAPER.with_artifacts(Noise(5.0, 5.0)))
    sample, image = images.clean(0), images.image(0)
    rows, columns = sample.range.shape
    body = np.count_nonzero(sample.range)
    size = f"{rows} x {columns}"
    assert repr(image) == f"RangeImage({sample.key!r}, {size}, {body} pixels measured, sigma_mm 5)"
    assert repr(sample).startswith(f"Sample({sample.key!r}, camera {size}, projector {size}, SampleInfo(split=")
    assert "projector no," in repr(replace(sample, projector_range=None))
    assert repr(images.augmentation) == f"Augmentation(rig 'small', 'noise', seed=0, {images.augmentation.sensor})"
    assert isinstance(sample, Sample) and json.dumps(images.identity())
