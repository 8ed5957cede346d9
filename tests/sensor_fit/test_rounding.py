"""Steps of range and of disparity."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from known_sensors import recorded

from bodyseg_data.artifacts import Noise
from bodyseg_data.artifacts.range_errors import DisparityRounding, RangeRounding
from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, UNKNOWN
from bodyseg_model.sensor_fit.residuals import measure_steps


@pytest.mark.parametrize("step_mm", [0.7, 1.0, 5.0])
def test_steps_in_range(step_mm: float) -> None:
    steps, (in_range, in_disparity) = measure_steps(recorded(Noise(2, 2), RangeRounding(step_mm)), 0.075)
    assert (in_range.artifact, in_range.verdict, in_disparity.verdict) == ("range_rounding", NEEDED, NOT_SEEN)
    assert in_range.strengths["step_mm"] == pytest.approx(step_mm, rel=0.001)
    assert steps.at(np.array([1.0, 3.0])).tolist() == pytest.approx([step_mm / 1000] * 2, rel=0.001)


@pytest.mark.parametrize("baseline_m", [0.075, None])
def test_steps_in_disparity(baseline_m: float | None) -> None:
    steps, (in_range, found) = measure_steps(recorded(Noise(2, 2), DisparityRounding(0.2)), baseline_m)
    assert (found.artifact, found.verdict, in_range.verdict) == ("disparity_rounding", NEEDED, NOT_SEEN)
    assert found.strengths["step_px"] / found.strengths["baseline_m"] == pytest.approx(0.2 / 0.075, rel=0.002)
    assert found.strengths["step_px"] == (pytest.approx(0.2, rel=0.002) if baseline_m else 0.125)
    assert steps.at(np.array([2.0]))[0] == pytest.approx(0.2 / 525 / 0.075 * 4, rel=0.002)


def test_the_unit_of_files_is_a_step() -> None:
    fine = recorded(Noise(2, 2))
    frames = tuple(replace(frame, stored=frame.stored // 10) for frame in fine.frames)
    _, (found, _) = measure_steps(replace(fine, frames=frames, step_m=0.001), None)
    assert found.verdict == NEEDED and found.strengths == {"step_mm": 1.0} and "files" in found.reason
    _, findings = measure_steps(fine, None)
    assert [finding.verdict for finding in findings] == [NOT_SEEN, NOT_SEEN]


def test_few_values_show_no_step() -> None:
    recording = recorded(frames=1)
    (frame,) = recording.frames
    flat = np.where(frame.body, np.uint16(20000), np.uint16(0))
    _, findings = measure_steps(replace(recording, frames=(replace(frame, stored=flat),)), None)
    assert [finding.verdict for finding in findings] == [UNKNOWN, UNKNOWN]
