"""Lost pixels, divided by how they are lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from known_sensors import recorded

from bodyseg_data.artifacts import MissingData, Noise
from bodyseg_data.artifacts.lost_pixels import PatchLoss, StripeLoss
from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, UNKNOWN, Finding
from bodyseg_model.sensor_fit.losses import measure_losses, outlines_of
from bodyseg_model.sensor_fit.recording import MarkedRecording, Mask, eroded, jumps


def losses_of(recording: MarkedRecording) -> dict[str, Finding]:
    return {finding.artifact: finding for finding in measure_losses(outlines_of(recording))}


def needed(found: dict[str, Finding]) -> list[str]:
    return [name for name, finding in found.items() if finding.verdict == NEEDED]


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("share", [0.03, 0.4])
def test_pixels_lost_at_random(share: float, moving: bool) -> None:
    found = losses_of(recorded(MissingData((share,)), frames=6, moving=moving))
    assert needed(found) == ["missing_data"]
    assert found["missing_data"].strengths["rates"] == (pytest.approx(share, rel=0.1),)


def test_pixels_lost_at_random_beside_noise_of_which_the_first_frame_has_least() -> None:
    recording = recorded(Noise(60.0, 60.0), MissingData((0.05,)))
    first = recorded(MissingData((0.05,)), frames=1).frames
    found = losses_of(replace(recording, frames=(*first, *recording.frames[1:])))["missing_data"]
    assert found.strengths["rates"] == (pytest.approx(0.05, rel=0.1),)


def test_rates_that_frames_change_between() -> None:
    found = losses_of(recorded(MissingData((0.0, 0.05, 0.5)), frames=12))
    assert found["missing_data"].strengths["rates"] == pytest.approx((0.0, 0.05, 0.5), abs=0.01)
    found = losses_of(recorded(MissingData(between=(0.0, 0.3)), frames=12))
    low, high = found["missing_data"].strengths["between"]
    assert low < 0.08 and 0.2 < high < 0.4
    assert found["missing_data"].estimates["share"].error == pytest.approx(0.3 / np.sqrt(12 * 12), rel=0.4)


@pytest.mark.parametrize("share", [0.05, 0.2, 0.3])
def test_patches_of_a_still_body(share: float) -> None:
    found = losses_of(recorded(PatchLoss(share, share), frames=8))
    assert needed(found) == ["patch_loss"]
    assert found["patch_loss"].estimates["share"].value == pytest.approx(share, rel=0.1)
    assert "at least" not in found["patch_loss"].reason


def test_patches_of_a_moving_body_are_a_lower_bound() -> None:
    found = losses_of(recorded(PatchLoss(0.1, 0.1), frames=12, moving=True))
    assert found["patch_loss"].verdict == NEEDED and "at least" in found["patch_loss"].reason
    assert found["patch_loss"].estimates["share"].value < 0.2


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


def without(recording: MarkedRecording, lost: Mask) -> MarkedRecording:
    """The recording without some pixels, bool [frames, H, W]."""
    frames = [
        replace(frame, stored=frame.stored * ~gone, range_m=frame.range_m * ~gone, body=frame.body & ~gone)
        for frame, gone in zip(recording.frames, lost, strict=True)
    ]
    return replace(recording, frames=tuple(frames))


@pytest.mark.parametrize("moving", [False, True])
def test_lost_edges_are_no_missing_data(moving: bool) -> None:
    recording = recorded(MissingData((0.05,)), frames=6, moving=moving)
    generator = np.random.default_rng(0)
    lost = np.stack(
        [
            (~eroded(frame.body, 2) | jumps(frame.range_m, frame.body, 0.03))
            & (generator.random(frame.body.shape) < 0.7)
            for frame in recorded(frames=6, moving=moving).frames
        ]
    )
    found = losses_of(without(recording, lost))
    assert found["missing_data"].strengths["rates"] == (pytest.approx(0.05, rel=0.1),)
    assert found["patch_loss"].verdict != NEEDED and found["stripe_loss"].verdict == NOT_SEEN


def test_a_gap_between_limbs_is_no_loss() -> None:
    recording = recorded(frames=1)
    found = losses_of(recording)
    assert found["patch_loss"].estimates["share"].value == 0 and needed(found) == []
    assert found["patch_loss"].verdict == UNKNOWN and "cut the outline" in found["patch_loss"].reason


@pytest.mark.parametrize(("thickness_px", "lost"), [(25, 0), (0, 3853)])
def test_a_hole_is_a_gap_where_its_rim_turns_away_and_a_patch_where_it_is_flat(thickness_px: int, lost: int) -> None:
    """As between arm and trunk: a ring of a thickness, seen from 2 m, or a flat one."""
    recording = recorded(frames=1)
    row, column = np.indices(recording.frames[0].body.shape)
    across = (np.hypot(row - 240, column - 112) - 60) / 25
    body = np.abs(across) < 1
    height_m = thickness_px / recording.camera.focal_px * 2 * np.sqrt(np.maximum(1 - across**2, 0))
    range_m = np.where(body, 2 - height_m, 0).astype(np.float32)
    frame = replace(recording.frames[0], stored=(10_000 * range_m).astype(np.uint16), range_m=range_m, body=body)
    (outline,) = outlines_of(replace(recording, frames=(frame,), pairs=()))
    assert outline.lost.sum() == lost
