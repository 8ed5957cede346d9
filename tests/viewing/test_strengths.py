"""Sliders of artifacts' strengths: they end at the bounds of the field, for any artifact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import pytest

from bodyseg_data.artifacts import Artifact, MissingData, Noise, RangeImage, Scene
from bodyseg_data.artifacts.mixed_pixels import MixedPixels
from bodyseg_data.artifacts.registry import ARTIFACTS
from bodyseg_data.core import BadConfig, Draws, bounded
from bodyseg_model.viewing.strengths import Slider, moved, sliders_of, value_of


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


def slider(artifact: Artifact, strength: str, item: int | None = None) -> Slider:
    (found,) = (each for each in sliders_of(artifact) if (each.strength, each.item) == (strength, item))
    return found


@pytest.mark.parametrize("kind", ARTIFACTS.values(), ids=ARTIFACTS)
def test_both_ends_of_every_slider_are_taken(kind: Callable[[], Artifact]) -> None:
    artifact = kind()
    for each in sliders_of(artifact):
        assert moved(artifact, each, value_of(artifact, each)) == artifact
        assert each.low < each.high and each.low <= value_of(artifact, each) <= each.high
        for end in (each.low, each.high):
            assert value_of(moved(artifact, each, end), each) == end


def test_sliders_reach_a_few_times_the_strength_within_the_limits_of_the_artifact() -> None:
    assert slider(Noise(0.0, 1.2), "high_mm") == Slider("high_mm", None, 0.0, 500.0, 2.0, False)
    assert slider(MixedPixels(), "share").high == 1
    assert slider(MixedPixels(), "jump_mm").low > 0
    assert slider(Noise(0.0, 100.0), "low_mm").high == slider(Noise(0.0, 100.0), "high_mm").high == 500


def test_numbers_of_users_artifacts_have_sliders() -> None:
    mine = Dropouts()
    assert slider(mine, "chance") == Slider("chance", None, 0.0, 0.1, 0.0005, False)
    assert slider(Dropouts(0.2), "chance").high == 0.4
    assert slider(mine, "rows") == Slider("rows", None, 0.0, 10.0, 1.0, True)
    assert moved(mine, slider(mine, "rows"), 4.4) == Dropouts(rows=4)
    assert [each.strength for each in sliders_of(mine)] == ["chance", "rows"]  # no words, nothing that is on or off
    with pytest.raises(BadConfig, match="dropouts refuses {'chance': 0.5}: chance"):
        moved(mine, slider(mine, "chance"), 0.5)


def test_a_low_above_the_high_takes_the_high_with_it() -> None:
    noise = Noise(5.0, 20.0)
    assert moved(noise, slider(noise, "low_mm"), 50.0) == Noise(50.0, 50.0)
    assert moved(noise, slider(noise, "high_mm"), 2.0) == Noise(2.0, 2.0)
    with pytest.raises(BadConfig, match="Noise: low_mm must be from 0 to 1000, found -1.0"):
        moved(noise, slider(noise, "low_mm"), -1.0)


def test_numbers_of_a_tuple_have_a_slider_each() -> None:
    missing = MissingData()
    second = slider(missing, "rates", 1)
    assert second.label == "rates 2" and value_of(missing, second) == 0.05
    assert moved(missing, second, 0.25) == MissingData((0.0, 0.25, 0.5))


def test_units_are_set_apart() -> None:
    labels = [each.label for each in sliders_of(MixedPixels(background_m=3.5))]
    assert labels[:3] == ["share", "background, m", "jump, mm"]
