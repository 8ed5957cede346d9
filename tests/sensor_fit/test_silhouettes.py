"""Mixed pixels between a body and what is behind it."""

from __future__ import annotations

import pytest
from known_sensors import recorded

from bodyseg_data.artifacts import MissingData, MixedPixels, Noise
from bodyseg_model.sensor_fit.edges import measure_mixed_pixels
from bodyseg_model.sensor_fit.finding import NEEDED, NOT_SEEN, UNKNOWN


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("share", [0.2, 0.7])
def test_the_share_of_mixed_pixels(share: float, moving: bool) -> None:
    found = measure_mixed_pixels(recorded(Noise(1.0, 1.0), MixedPixels(share), frames=6, moving=moving, wall=True))
    assert found.verdict == NEEDED and found.strengths["share"] == pytest.approx(share, rel=0.1)
    assert found.strengths["background_m"] == pytest.approx(3.0, rel=0.02)


def test_lost_pixels_leave_the_share_of_mixed_ones_as_it_is() -> None:
    found = measure_mixed_pixels(recorded(MixedPixels(0.5), MissingData((0.3,)), wall=True))
    assert found.strengths["share"] == pytest.approx(0.5, rel=0.1)


def test_edges_without_mixed_pixels_and_no_edges() -> None:
    assert measure_mixed_pixels(recorded(wall=True)).verdict == NOT_SEEN
    assert measure_mixed_pixels(recorded(frames=1)).verdict == UNKNOWN
