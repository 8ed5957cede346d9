from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import product
from typing import Any

import pytest

from bodyseg_data.core import BadConfig
from bodyseg_data.samples import View, ViewGrid, parse_choice, split_key
from bodyseg_data.samples.views import Drawn


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


def test_names_have_no_dots_and_tell_pitch_roll_and_height_where_there_are_any() -> None:
    assert View(95, 5).name == "d095-a005"
    assert View(255, 90, -10, 5, 40).name == "d255-a090-p-10-r005-h040"
    assert View(255, 90, roll_deg=-120).name == "d255-a090-r-120"
    assert View(255, 90, height_cm=-7).name == "d255-a090-h-07"


def test_captions_tell_pitch_roll_and_height_where_there_are_any() -> None:
    assert View(95, 5).words == "0.95 m, 5°"
    assert View(255, 90, -10, 5, 40).words == "2.55 m, 90°, pitch -10°, roll 5°, height 40 cm"


@pytest.mark.parametrize("body", ["open-A-posture-04", "folder-x-d215-a000", "folder-x-d215-a000-p-10", "a-p-10-r005"])
@pytest.mark.parametrize("stance", [(0, 0, 0), (-30, 0, 0), (0, 7, 0), (0, 0, -12), (-90, -179, 300)])
def test_a_key_is_split_into_body_and_view(body: str, stance: tuple[int, int, int]) -> None:
    name = View(215, 10, *stance).name
    assert split_key(f"{body}-{name}") == (body, name)


def test_a_key_without_a_view_is_all_body() -> None:
    assert split_key("elsewhere-p-10") == ("elsewhere-p-10", "")


STANCES: dict[str, Any] = {"pitch_deg": (0, -15, -30), "roll_deg": (0, 90), "height_cm": (-20, 0, 20)}


def test_a_grid_combines_everything_with_everything() -> None:
    views = list(ViewGrid((215, 255), azimuths=4, **STANCES))
    found = {(v.distance_cm, v.azimuth_deg, v.pitch_deg, v.roll_deg, v.height_cm) for v in views}
    assert found == set(product((215, 255), (0, 45, 90, 135), *STANCES.values()))
    assert len(views) == len(found) == ViewGrid((215, 255), azimuths=4, **STANCES).full == 144


@pytest.mark.parametrize("count", [1, 2, 7, 18, 54, 100, 323])
def test_a_thinned_grid_has_each_value_about_equally_often(count: int) -> None:
    whole = ViewGrid((215, 255, 295), azimuths=6, **STANCES)
    views = list(replace(whole, count=count))
    assert len(set(views)) == count and set(views) <= set(whole)
    for field, values in STANCES.items():
        often = Counter(getattr(view, field) for view in views)
        assert max(often.values()) - min(often[value] for value in values) <= 1 + count // 18


def test_every_view_of_every_body_draws_its_own_from_a_range() -> None:
    grid = ViewGrid(span_deg=360, pitch_deg=Drawn(-30, 10), roll_deg=(0, 5), height_cm=Drawn(-3, 3))
    by_body = {body: list(grid.of(body)) for body in (f"open-A-{number}" for number in range(40))}
    assert all(len(set(views)) == len(views) == 108 for views in by_body.values())
    pitches = Counter(view.pitch_deg for views in by_body.values() for view in views)
    assert set(pitches) == set(range(-30, 11))
    # 4320 draws, uniform over 41: chi square with 40 degrees of freedom is beyond 73 once in a thousand.
    assert sum((count - 4320 / 41) ** 2 / (4320 / 41) for count in pitches.values()) < 73
    assert {view.height_cm for views in by_body.values() for view in views} == set(range(-3, 4))
    first, second = list(by_body.values())[:2]
    assert first == list(grid.of("open-A-0")) != second


def test_a_draw_depends_on_no_other_view_and_no_other_range() -> None:
    grid = ViewGrid(span_deg=360, pitch_deg=Drawn(-30, 10), roll_deg=Drawn(-5, 5))
    whole = set(grid.of("open-A-0"))
    assert set(replace(grid, count=7).of("open-A-0")) < whole
    level = list(replace(grid, roll_deg=(0,)).of("open-A-0"))
    assert [replace(view, roll_deg=0) for view in grid.of("open-A-0")] == level


def test_a_grid_says_all_that_makes_its_views() -> None:
    assert ViewGrid(count=2).described() == ["d215-a000", "d255-a090"]
    drawn = ViewGrid(count=2, pitch_deg=Drawn(-30, 10), roll_deg=(5,))
    assert drawn.described() == ["d215-a000-r005", "d255-a090-r005", "pitch_deg -30..10"]
    assert drawn.pitches_deg == (-30, -10, 10)
    assert ViewGrid(pitch_deg=(0, -15)).pitches_deg == (0, -15)


def test_words_give_values_or_a_range() -> None:
    assert parse_choice(["0", "-15", "+3"], "--pitch") == (0, -15, 3)
    assert parse_choice(["-30..10"], "--pitch") == Drawn(-30, 10)
    for words in (["1.5"], ["-30..10", "5"], ["x"], ["1_0"], ["5.."]):
        with pytest.raises(BadConfig, match="^--roll takes whole numbers, or one range like -30..10, found '"):
            parse_choice(words, "--roll")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"distances_cm": ()}, "between 50 and 600 cm, found \\[\\]"),
        ({"distances_cm": (700,)}, "found \\[700\\]"),
        ({"distances_cm": (215, 215)}, "each distance of views must be given once"),
        ({"azimuths": 7}, "found 7 in 180"),
        ({"span_deg": 361}, "found 18 in 361"),
        ({"count": 0}, "between 1 and 54, found 0"),
        ({"count": 55}, "between 1 and 54, found 55"),
        ({"count": 109, "pitch_deg": (0, 5)}, "between 1 and 108, found 109"),
        ({"pitch_deg": (0, -91)}, "^a view's pitch must be between -90 and 90 degrees, found \\[0, -91\\]$"),
        ({"roll_deg": (-180,)}, "^a view's roll must be between -179 and 180 degrees, found \\[-180\\]$"),
        ({"height_cm": Drawn(0, 301)}, "^a view's height must be between -300 and 300 cm, found \\[0, 301\\]$"),
        ({"height_cm": ()}, "found \\[\\]$"),
        ({"pitch_deg": Drawn(10, 10)}, "^a range of pitch must go up, found 10..10$"),
        ({"azimuths": -18}, "^azimuths must divide 1 to 360 degrees evenly, found -18 in 180$"),
        ({"roll_deg": (5, 5)}, "^each roll of views must be given once, found \\[5, 5\\]$"),
    ],
)
def test_a_grid_that_makes_no_sense_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        ViewGrid(**options)
