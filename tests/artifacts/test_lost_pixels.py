"""Lost pixels: exact shares, the parts and directions named."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from planes import PROJECTOR, RIG, plane, sample_of, shown

from bodyseg_data.artifacts import Artifact, Augmentation, SensorModel, shown_with
from bodyseg_data.artifacts.lost_pixels import PatchLoss, StripeLoss, code_lines
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import PARTS, classes_of


def test_patches_lose_the_share_that_is_drawn() -> None:
    sample = plane(2.0)
    shares = []
    for seed in range(40):
        made = shown(PatchLoss(0.1, 0.5), sample, seed)
        shares.append(made.drawn["patch_share"])
        lost = np.count_nonzero(sample.range) - np.count_nonzero(made.range)
        assert lost == pytest.approx(shares[-1] * np.count_nonzero(sample.range), abs=1)
    assert 0.1 <= min(shares) < 0.2 and 0.4 < max(shares) <= 0.5


def test_patches_of_parts_lie_on_these_parts() -> None:
    sample = plane(2.0)
    part = PARTS[7]
    made = shown(PatchLoss(0.5, 0.5, (part.landmark,)), sample)
    lost = (sample.range > 0) & (made.range == 0)
    assert (sample.labels[lost] == part.label).all()
    assert lost.sum() == pytest.approx((sample.labels == part.label).sum() / 2, abs=1)


def test_patches_of_parts_are_for_sets_of_the_parts() -> None:
    made = Augmentation(
        RIG, "md", 0, SensorModel("mine", (PatchLoss(0.5, 0.5, ("Nuchale",)),)), classes_of(["floor", "arm"])
    )
    with pytest.raises(BadConfig, match="patch_loss with 'parts' needs the 33 parts, found classes 'classes'"):
        made(plane(2.0))


@pytest.mark.parametrize("along", ["rows", "columns"])
def test_stripes_run_along_their_direction(along: Any) -> None:
    sample = plane(2.0)
    made = shown(StripeLoss(0.3, 0.3, along), sample)
    lost = ((sample.range > 0) & (made.range == 0))[20:-20]
    whole = lost.all(axis=1 if along == "rows" else 0)
    assert np.count_nonzero(whole) == pytest.approx(0.3 * len(whole), abs=1.5)
    assert lost.sum() == pytest.approx(0.3 * lost.size, abs=1)


def test_lines_of_one_code_are_at_right_angles_to_the_baseline() -> None:
    assert code_lines(RIG) == "columns"
    above = replace(RIG, projector=replace(PROJECTOR, position_m=(0.01, -0.2, 0.0)))
    assert code_lines(above) == "rows"
    for rig, along in ((RIG, "columns"), (above, "rows")):
        ours, named = (shown_with(StripeLoss(0.2, 0.2, each), plane(2.0), rig, 0) for each in (None, along))
        np.testing.assert_array_equal(ours.range, named.range)


@pytest.mark.parametrize("artifact", [PatchLoss(0.5, 0.5), StripeLoss(0.5, 0.5)])
def test_an_empty_image_stays_empty(artifact: Artifact) -> None:
    assert not shown(artifact, sample_of(np.zeros((200, 160)))).range.any()


@pytest.mark.parametrize(
    ("kind", "strengths", "message"),
    [
        (PatchLoss, {"low": 0.5, "high": 0.2}, "low must be at most high, found 0.5 and 0.2"),
        (PatchLoss, {"parts": ("Nose",)}, "parts must be names of the 33 parts, found 'Nose'"),
        (StripeLoss, {"high": 1.2}, "StripeLoss: high must be from 0 to 1, found 1.2"),
        (StripeLoss, {"along": "lines"}, "StripeLoss: along must be 'rows' or 'columns' or None, found 'lines'"),
    ],
)
def test_strengths_out_of_range_are_one_line(kind: Any, strengths: dict[str, Any], message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        kind(**strengths)
