from __future__ import annotations

import io
import itertools
from typing import Any

import pytest
from benches.charts.choice import Panel
from benches.charts.drawing import chart, draw
from benches.charts.fronts import Axis, Point, front, shortfalls
from chart_figures import BY_NAME, SOURCE, panels_of
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

LESS, MORE = Axis("ms", "time"), Axis("per second", "speed", more_is_better=True)


def points(*places: tuple[float, float]) -> list[Point]:
    return [Point(f"p{number}", x, y, f"point {number}") for number, (x, y) in enumerate(places)]


# Fronts


def test_a_front_by_hand() -> None:
    found = points((1, 9), (2, 5), (2, 6), (4, 5), (5, 1), (9, 0.5), (9, 9))
    assert [point.name for point in front(found, LESS, LESS)] == ["p0", "p1", "p4", "p5"]
    assert [point.name for point in front(found, MORE, LESS)] == ["p5"]
    assert [point.name for point in front(found, MORE, MORE)] == ["p6"]
    assert [point.name for point in front(found, LESS, MORE)] == ["p0"]


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), min_size=1, max_size=12), st.booleans(), st.booleans())
def test_whatever_is_off_the_front_is_beaten_by_it_and_nothing_on_it_is(
    places: list[tuple[int, int]], x_more: bool, y_more: bool
) -> None:
    x, y = (MORE if more else LESS for more in (x_more, y_more))
    found = points(*places)
    best = front(found, x, y)
    # The slow way: signs turned so that less is better, then the definition, pair by pair.
    turned = {point.name: (-point.x if x_more else point.x, -point.y if y_more else point.y) for point in found}
    for point in found:
        worse_than = [
            other for other in found if turned[other.name] != turned[point.name]
            and all(a <= b for a, b in zip(turned[other.name], turned[point.name], strict=True))
        ]  # fmt: skip
        assert (point in best) == (not worse_than)
        assert {fall.better.name for fall in shortfalls(point, found, x, y)} == {
            one.name for one in worse_than if one in best
        }


def test_by_how_much_a_point_is_beaten() -> None:
    slow, fast, small = points((10, 4), (8, 4), (9, 1))
    (first, second) = shortfalls(slow, [slow, fast, small], LESS, LESS)
    assert (first.better, first.x_share, first.y_share) == (small, 0.1, 0.75)
    assert (second.better, second.x_share, second.y_share) == (fast, 0.2, 0.0)
    (only,) = shortfalls(fast, [slow, fast], MORE, LESS)
    assert (only.better, only.x_share, only.y_share) == (slow, 0.25, 0.0)
    assert shortfalls(slow, [slow, slow], LESS, LESS) == ()


# Scales


# Names beside points


def overlap(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


# Pictures


@pytest.fixture(scope="module")
def matplotlib() -> Any:
    return pytest.importorskip("matplotlib")


def test_the_same_figures_give_the_same_bytes(matplotlib: Any) -> None:
    one, other = (draw(BY_NAME["codec"], panels_of("codec"), [SOURCE]) for _ in range(2))
    assert one == other and b"<dc:date>" not in one.svg and one.svg.startswith(b"<?xml")
    assert Image.open(io.BytesIO(one.png)).format == "PNG"


@pytest.mark.parametrize(("y_sd", "says"), [(None, False), (0.3, False), (0.8, True)])
def test_a_gain_within_the_spread_of_both_is_called_so(y_sd: float | None, says: bool, matplotlib: Any) -> None:
    default, better = (Point(name, x, y, name, y_sd=y_sd) for name, x, y in (("all", 2.0, 71.0), ("none", 1.0, 72.0)))
    panel = Panel("a panel", (default, better), "all")
    (axis,) = chart(BY_NAME["artifacts"], [panel], [SOURCE]).axes
    title = axis.get_title(loc="left").replace("\n", " ")
    assert "beaten by 'none'" in title and title.endswith("within the spread") == says


@pytest.mark.parametrize("name", BY_NAME)
def test_a_chart_says_all_and_covers_nothing(name: str, matplotlib: Any) -> None:
    choice, panels = BY_NAME[name], panels_of(name)
    figure = chart(choice, panels, [SOURCE])
    (small,) = [text for text in figure.texts if SOURCE["commit"] in text.get_text()]
    assert SOURCE["command"] in small.get_text() and SOURCE["hardware"] in small.get_text().replace("\n", " ")
    assert figure.texts[0].get_text() == choice.title
    renderer = figure.canvas.get_renderer()
    for axis, panel in zip(figure.axes, panels, strict=False):
        assert axis.get_title(loc="left").startswith(panel.name)
        names = {text.get_text() for text in axis.texts}
        best = front(panel.points, choice.x, choice.y)
        assert names >= {point.label for point in best} | {limit.label for limit in panel.limits}
        boxes = [text.get_window_extent(renderer).extents for text in axis.texts]
        assert not any(overlap(one, other) for one, other in itertools.combinations(boxes, 2))
        corner = axis.get_position().p0.tolist()
        assert corner == [round(side, 9) for side in corner], "further digits differ from run to run"
        edge = axis.get_window_extent(renderer).extents
        assert all((box[:2] >= edge[:2]).all() and (box[2:] <= edge[2:]).all() for box in boxes)
