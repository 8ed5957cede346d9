from __future__ import annotations

from typing import Any

import pytest

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.views import View, ViewGrid


def test_the_default_grid_is_the_papers_54_views() -> None:
    views = list(ViewGrid())
    assert len(views) == len(set(views)) == len(ViewGrid()) == 54
    assert {view.distance_cm for view in views} == {215, 255, 295}
    assert {view.azimuth_deg for view in views} == set(range(0, 180, 10))


@pytest.mark.parametrize("count", range(1, 55))
def test_a_thinned_grid_has_different_views_spread_over_all_azimuths(count: int) -> None:
    views = list(ViewGrid(count=count))
    assert len(set(views)) == count
    assert set(views) <= set(ViewGrid())
    azimuths = sorted({view.azimuth_deg for view in views})
    largest_gap = max(b - a for a, b in zip(azimuths, [*azimuths[1:], 180], strict=True))
    assert largest_gap <= -(-18 // count) * 10


def test_names_have_fixed_width_and_no_dots() -> None:
    assert View(95, 5).name == "d095-a005"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"distances_cm": ()}, "between 50 and 600 cm, found \\[\\]"),
        ({"distances_cm": (700,)}, "found \\[700\\]"),
        ({"distances_cm": (215, 215)}, "distances must differ"),
        ({"azimuths": 7}, "span 180 and 7 azimuths"),
        ({"span_deg": 361}, "span 361"),
        ({"count": 0}, "between 1 and 54, found 0"),
        ({"count": 55}, "between 1 and 54, found 55"),
    ],
)
def test_a_grid_that_makes_no_sense_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        ViewGrid(**options)
