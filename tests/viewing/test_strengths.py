"""Controls of artifacts' strengths: they end at the bounds of the field, for any artifact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import pytest

from bodyseg_data.artifacts import Artifact, MissingData, Noise, RangeImage, Scene
from bodyseg_data.artifacts.artifact import bounded
from bodyseg_data.artifacts.lost_pixels import PatchLoss, StripeLoss
from bodyseg_data.artifacts.mixed_pixels import MixedPixels
from bodyseg_data.artifacts.registry import ARTIFACTS
from bodyseg_data.core import BadConfig, Draws
from bodyseg_model.viewing.strengths import Choice, Control, Slider, TextEntry, controls_of, moved, value_of


@dataclass(frozen=True)
class Dropouts(Artifact):
    """Somebody's artifact, which checks nothing but one strength, and raises what Python raises."""

    name = "dropouts"
    kind = "missing_data"

    chance: float = bounded(0.02, 0, 0.4)
    rows: int = 3
    upwards: bool = False
    along: Literal["rows", "columns"] = "rows"

    def __post_init__(self) -> None:
        if not 0 <= self.chance <= 0.4:
            raise ValueError("chance")

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        image.range[: self.rows] = 0


def control(artifact: Artifact, strength: str, item: int | None = None) -> Any:
    (found,) = (
        each for each in controls_of(artifact) if each.strength == strength and getattr(each, "item", None) == item
    )
    return found


@pytest.mark.parametrize("kind", ARTIFACTS.values(), ids=ARTIFACTS)
def test_both_ends_of_every_slider_are_taken(kind: Callable[[], Artifact]) -> None:
    artifact = kind()
    for each in controls_of(artifact):
        assert moved(artifact, each, value_of(artifact, each)) == artifact
        if isinstance(each, Slider):
            assert each.low < each.high and each.low <= value_of(artifact, each) <= each.high
            for end in (each.low, each.high):
                assert value_of(moved(artifact, each, end), each) == end
        elif isinstance(each, Choice):
            for value in each.values:
                assert value_of(moved(artifact, each, value), each) == value


def test_sliders_reach_a_few_times_the_strength_within_the_limits_of_the_artifact() -> None:
    assert control(Noise(0.0, 1.2), "high_mm") == Slider("high_mm", None, 0.0, 500.0, 2.0, False)
    assert control(MixedPixels(), "share").high == 1
    assert control(MixedPixels(), "jump_mm").low > 0
    assert control(Noise(0.0, 100.0), "low_mm").high == control(Noise(0.0, 100.0), "high_mm").high == 500


def test_users_artifacts_have_controls_of_every_kind() -> None:
    mine = Dropouts()
    assert control(mine, "chance") == Slider("chance", None, 0.0, 0.1, 0.0005, False)
    assert control(Dropouts(0.2), "chance").high == 0.4
    assert control(mine, "rows") == Slider("rows", None, 0.0, 10.0, 1.0, True)
    assert moved(mine, control(mine, "rows"), 4.4) == Dropouts(rows=4)
    assert control(mine, "upwards") == Choice("upwards", (False, True))
    assert control(mine, "along") == Choice("along", ("rows", "columns"))
    with pytest.raises(BadConfig, match="dropouts refuses {'chance': 0.5}: chance"):
        moved(mine, control(mine, "chance"), 0.5)


def test_a_low_above_the_high_takes_the_high_with_it() -> None:
    noise = Noise(5.0, 20.0)
    assert moved(noise, control(noise, "low_mm"), 50.0) == Noise(50.0, 50.0)
    assert moved(noise, control(noise, "high_mm"), 2.0) == Noise(2.0, 2.0)
    with pytest.raises(BadConfig, match="Noise: low_mm must be from 0 to 1000, found -1.0"):
        moved(noise, control(noise, "low_mm"), -1.0)


def test_numbers_of_a_tuple_have_a_slider_each() -> None:
    missing = MissingData()
    second = control(missing, "rates", 1)
    assert second.label == "rates 2" and value_of(missing, second) == 0.05
    assert moved(missing, second, 0.25) == MissingData((0.0, 0.25, 0.5))


@pytest.mark.parametrize(
    ("artifact", "strength", "text", "changed"),
    [
        (MissingData(), "between", "0.1; 0.3", MissingData(between=(0.1, 0.3))),
        (MissingData(between=(0.1, 0.3)), "between", " ", MissingData()),
        (MixedPixels(), "background_m", "3.5", MixedPixels(background_m=3.5)),
        (MixedPixels(background_m=3.5), "background_m", "", MixedPixels()),
        (PatchLoss(), "parts", "Sellion; Rt. Axilla, Post.", PatchLoss(parts=("Sellion", "Rt. Axilla, Post."))),
        (PatchLoss(parts=("Sellion",)), "parts", "", PatchLoss()),
    ],
)
def test_texts_are_read_and_shown(artifact: Artifact, strength: str, text: str, changed: Artifact) -> None:
    entry: Control = control(artifact, strength)
    assert isinstance(entry, TextEntry)
    assert moved(artifact, entry, text) == changed
    assert value_of(changed, entry) == text.strip()


def test_choices_may_have_none() -> None:
    assert control(StripeLoss(), "along").values == ("rows", "columns", None)


def test_texts_that_are_no_numbers_are_refused() -> None:
    with pytest.raises(BadConfig, match="background, m of mixed_pixels must be a number, found 'near'"):
        moved(MixedPixels(), control(MixedPixels(), "background_m"), "near")


def test_units_are_set_apart() -> None:
    labels = [each.label for each in controls_of(MixedPixels())]
    assert labels == ["share", "background, m", "jump, mm", "least", "nearest, m"]
