"""Lost pixels, divided by how they are lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from known_sensors import recorded

from bodyseg_data.artifacts import MissingData, Noise
from bodyseg_data.artifacts.lost_pixels import EdgeLoss, GrazingLoss, PatchLoss, StripeLoss
from bodyseg_model.sensor_fit.finding import NEEDED, UNKNOWN, Finding
from bodyseg_model.sensor_fit.losses import measure_losses
from bodyseg_model.sensor_fit.outlines import outlines_of
from bodyseg_model.sensor_fit.recording import MarkedRecording


def losses_of(recording: MarkedRecording) -> dict[str, Finding]:
    return {finding.artifact: finding for finding in measure_losses(outlines_of(recording, 0.075))}


def needed(found: dict[str, Finding]) -> list[str]:
    return [name for name, finding in found.items() if finding.verdict == NEEDED]


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("share", [0.03, 0.4])
def test_pixels_lost_at_random(share: float, moving: bool) -> None:
    found = losses_of(recorded(MissingData((share,)), frames=6, moving=moving))
    assert needed(found) == ["missing_data"]
    assert found["missing_data"].strengths["rates"] == (pytest.approx(share, rel=0.1),)


def test_rates_that_frames_change_between() -> None:
    found = losses_of(recorded(MissingData((0.0, 0.05, 0.5)), frames=12))
    assert found["missing_data"].strengths["rates"] == pytest.approx((0.0, 0.05, 0.5), abs=0.01)
    found = losses_of(recorded(MissingData(between=(0.0, 0.3)), frames=12))
    low, high = found["missing_data"].strengths["between"]
    assert low < 0.08 and 0.2 < high < 0.4


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_patches_of_a_still_body(share: float) -> None:
    found = losses_of(recorded(PatchLoss(share, share), frames=8))
    assert needed(found) == ["patch_loss"]
    assert found["patch_loss"].estimates["share"].value == pytest.approx(share, rel=0.1)
    assert "at least" not in found["patch_loss"].reason


def test_patches_of_a_moving_body_are_a_lower_bound() -> None:
    found = losses_of(recorded(PatchLoss(0.1, 0.1), frames=12, moving=True))
    assert found["patch_loss"].estimates["share"].value < 0.2 and "at least" in found["patch_loss"].reason


@pytest.mark.parametrize("along", ["rows", "columns"])
def test_stripes_and_their_direction(along: str) -> None:
    found = losses_of(recorded(StripeLoss(0.12, 0.12, along), frames=8))  # type: ignore[arg-type]
    assert "stripe_loss" in needed(found) and found["stripe_loss"].strengths["along"] == along
    assert found["stripe_loss"].estimates["share"].value == pytest.approx(0.12, rel=0.15)


def test_stripes_of_a_moving_body_are_filled_before_they_are_counted() -> None:
    found = losses_of(recorded(StripeLoss(0.1, 0.1, "rows"), frames=8, moving=True))
    assert found["stripe_loss"].strengths["along"] == "rows"
    assert found["stripe_loss"].estimates["share"].value == pytest.approx(0.1, rel=0.1)


def test_stripes_may_be_cut_by_the_ends_of_a_body() -> None:
    recording = recorded(frames=2)
    shape = recording.frames[0].body.shape
    board, lost = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    board[40:440, 60:160] = True
    lost[40:46] = lost[230:250] = lost[431:440] = True
    frames = []
    for frame, body in zip(recording.frames, (board, board & ~lost), strict=True):
        range_m = np.where(body, np.float32(2), np.float32(0))
        frames.append(replace(frame, stored=(20_000 * body).astype(np.uint16), range_m=range_m, body=body))
    found = losses_of(replace(recording, frames=tuple(frames)))["stripe_loss"]
    assert found.estimates["share"].value == pytest.approx(35 / 400 / 2, rel=0.05)


@pytest.mark.parametrize(("width", "share"), [(1, 0.5), (2, 0.3)])
def test_edges_of_a_still_body(width: int, share: float) -> None:
    found = losses_of(recorded(EdgeLoss(width, share), frames=8))
    assert needed(found) == ["edge_loss"] and found["edge_loss"].strengths["width_px"] == width
    assert found["edge_loss"].strengths["share"] == pytest.approx(share, rel=0.1)


def test_grazing_surfaces_of_a_still_body() -> None:
    found = losses_of(recorded(GrazingLoss(70.0, 0.5), frames=12))
    assert found["grazing_loss"].verdict == NEEDED
    assert found["grazing_loss"].strengths["from_deg"] == pytest.approx(70, abs=1.5)
    assert found["grazing_loss"].strengths["share"] == pytest.approx(0.5, rel=0.1)
    bare = losses_of(recorded(GrazingLoss(70.0, 1.0), frames=4))["grazing_loss"]
    assert bare.strengths == {"from_deg": pytest.approx(70, abs=2), "share": 1.0} and "hardly one beyond" in bare.reason


def test_noise_hides_which_surfaces_are_lost() -> None:
    found = losses_of(recorded(Noise(15.0, 15.0), GrazingLoss(70.0, 0.2), frames=4))
    assert found["grazing_loss"].verdict == UNKNOWN and "hides" in found["grazing_loss"].reason


def test_a_gap_between_limbs_is_no_loss() -> None:
    recording = recorded(frames=1)
    found = losses_of(recording)
    assert found["patch_loss"].estimates["share"].value == 0 and needed(found) == []
    assert found["patch_loss"].verdict == UNKNOWN and "cut the outline" in found["patch_loss"].reason
