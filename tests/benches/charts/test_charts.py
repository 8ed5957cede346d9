from __future__ import annotations

import io
import itertools
from typing import Any

import numpy as np
import pytest
from benches.charts.choices import Choice, Panel
from benches.charts.drawing import DPI, chart, draw
from benches.charts.fronts import Axis, Point, front, shortfalls, pareto_front
from benches.charts.labels import Label, Placed, place_labels
from benches.charts.scales import axis_title, scale_of, shown
from chart_figures import BY_NAME, SOURCE, figures_of, panels_of
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


def test_what_nothing_beats_comes_by_rising_costs_and_equals_stay_together() -> None:
    rows = [{"a": a, "b": b} for a, b in ((5, 1), (2, 2), (2, 3), (6, 1), (1, 5), (2, 2))]
    assert pareto_front(rows, lambda row: (row["a"], row["b"])) == [rows[4], rows[1], rows[5], rows[0]]
    assert pareto_front([3, 1, 2], lambda number: (number,)) == [1]


def test_of_points_in_one_place_none_is_lost() -> None:
    assert len(front(points((1, 1), (1, 1), (2, 2)), LESS, LESS)) == 2


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


def test_an_axis_is_logarithmic_from_a_factor_of_ten_on() -> None:
    assert not scale_of([1, 5, 10], LESS).log and scale_of([1, 5, 10.1], LESS).log
    straight = scale_of([20, 30], LESS)
    assert straight.low < 20 < 30 < straight.high and straight.high - straight.low < 12.1
    assert scale_of([0, 0.5, 2], LESS).low < 0 and not scale_of([0, 0.5, 2], LESS).log
    assert scale_of([7, 7], LESS).low < 7 < scale_of([7, 7], LESS).high
    assert scale_of([0, 0], LESS).low < 0 < scale_of([0, 0], LESS).high


def test_a_logarithmic_axis_has_a_place_for_zero() -> None:
    scale = scale_of([0, 0.01, 50], Axis("%", "error", factor=100))
    assert scale.log and scale.zero and scale.least == 1 and scale.low < 0 and scale.high > 5000
    assert scale.round_values() == [0, 1, 10, 100, 1000, 10_000]
    assert scale_of([0.3, 5], LESS).round_values() == [0.5, 1, 2, 5]
    assert [shown(value) for value in (0.05, 2.0, 12_500.0)] == ["0.05", "2", "12 500"]


def test_titles_say_where_it_is_better() -> None:
    assert axis_title(LESS) == "ms   (← less is better)" and axis_title(MORE, "\n") == "per second\n(more is better →)"


# Names beside points


def box(label: Label, placed: Placed) -> tuple[float, float, float, float]:
    return (*placed.corner, *(placed.corner + label.size))


def overlap(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


@pytest.mark.parametrize("seed", range(2))
def test_names_cover_neither_each_other_nor_the_edge(seed: int) -> None:
    generator = np.random.default_rng(seed)
    places = generator.uniform([10, 10], [590, 390], (14, 2)) if seed else np.full((14, 2), 300.0)
    labels = [Label(np.array([70.0, 12.0]), place[None], 5.0) for place in places]
    dots = np.column_stack([places, np.full(len(places), 5.0)])
    placed = place_labels(labels, dots, np.empty((0, 2)), np.array([0.0, 0.0, 600.0, 400.0]))
    boxes = [box(*pair) for pair in zip(labels, placed, strict=True)]
    assert not any(overlap(one, other) for one, other in itertools.combinations(boxes, 2))
    for left, bottom, right, top in boxes:
        assert left >= 0 and bottom >= 0 and right <= 600 and top <= 400


def test_a_name_stands_beside_its_point_off_lines_and_off_other_points() -> None:
    line = np.column_stack([np.linspace(100, 300, 80), np.full(80, 200.0)])  # to the right
    dots = np.array([[100.0, 200.0, 6.0], [60.0, 200.0, 6.0]])  # and to the left
    label = Label(np.array([60.0, 12.0]), np.array([[100.0, 200.0]]), 6.0)
    (found,) = place_labels([label], dots, line, np.array([0.0, 0.0, 400.0, 400.0]))
    left, bottom, right, top = box(label, found)
    assert top < 200 or bottom > 200
    assert np.hypot(*(found.nearest - found.anchor)) < 25
    assert not (left < 66 and bottom < 206 and right > 54 and top > 194)


def test_a_line_s_name_goes_where_there_is_room() -> None:
    label = Label(np.array([60.0, 12.0]), np.array([[100.0, 390.0], [100.0, 40.0]]), 1.0)
    crowd = np.array([[x, y, 6.0] for x in range(0, 260, 12) for y in range(300, 400, 12)], float)
    (found,) = place_labels([label], crowd, np.empty((0, 2)), np.array([0.0, 0.0, 400.0, 400.0]))
    assert found.anchor.tolist() == [100.0, 40.0] and found.corner[1] < 100
    assert place_labels([], crowd, np.empty((0, 2)), np.array([0.0, 0.0, 400.0, 400.0])) == []


# Pictures


@pytest.fixture(scope="module")
def matplotlib() -> Any:
    return pytest.importorskip("matplotlib")


def test_the_same_figures_give_the_same_bytes(matplotlib: Any) -> None:
    one, other = (draw(BY_NAME["codec"], panels_of("codec"), SOURCE) for _ in range(2))
    assert one == other and b"<dc:date>" not in one.svg and one.svg.startswith(b"<?xml")
    assert Image.open(io.BytesIO(one.png)).format == "PNG"


@pytest.mark.parametrize("name", BY_NAME)
def test_a_chart_says_all_and_covers_nothing(name: str, matplotlib: Any) -> None:
    choice, panels = BY_NAME[name], panels_of(name)
    figure = chart(choice, panels, SOURCE)
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
        edge = axis.get_window_extent(renderer).extents
        assert all((box[:2] >= edge[:2]).all() and (box[2:] <= edge[2:]).all() for box in boxes)


def test_the_headline_says_what_beats_the_default(matplotlib: Any) -> None:
    figure = chart(BY_NAME["mesh_resolution"], panels_of("mesh_resolution"), SOURCE)
    whole, scan = (axis.get_title(loc="left").replace("\n", " ") for axis in figure.axes)
    assert whole.endswith("the default is on the front")
    assert scan.endswith("the default is beaten by '25 %': time 20 % better, error 50 % better")


def test_the_front_s_line_runs_along_what_can_be_had(matplotlib: Any) -> None:
    ways = points((2, 8), (4, 4), (8, 2), (8, 8))
    for x, y, expected in (
        (LESS, LESS, [(2, 9), (2, 8), (4, 8), (4, 4), (8, 4), (8, 2), (9, 2)]),
        (MORE, LESS, [(8, 9), (8, 2), (0, 2)]),
        (LESS, MORE, [(2, 0), (2, 8), (9, 8)]),
        (MORE, MORE, [(8, 0), (8, 8), (0, 8)]),
    ):
        choice = Choice("it", "it", "?", "", x, y, lambda _: ())
        figure = chart(choice, [Panel("one", tuple(ways), None)], SOURCE)
        line = figure.axes[0].lines[0].get_xydata()
        corners = [tuple(corner) for corner, before in zip(line[1:], line, strict=False) if (corner != before).any()]
        low, high = figure.axes[0].get_xlim()
        bottom, top = figure.axes[0].get_ylim()
        ends = {0: (low, bottom), 9: (high, top)}
        wanted = [(ends.get(a, (a, a))[0], ends.get(b, (b, b))[1]) for a, b in expected]
        assert [tuple(line[0]), *corners] == wanted


def test_markers_are_told_apart_in_grey(matplotlib: Any) -> None:
    """By how dark their middle is, and by how much of a square around them is not paper."""
    ways = (Point("d", 2, 5, ""), Point("f", 5, 2, ""), Point("b", 6, 6, ""))
    choice = Choice("it", "it", "?", "", LESS, LESS, lambda _: ())
    panels = [Panel("one", ways, "d")]
    grey = np.asarray(Image.open(io.BytesIO(draw(choice, panels, SOURCE).png)).convert("L")).astype(int)
    axis = chart(choice, panels, SOURCE).axes[0]
    middle, ink = {}, {}
    for point in ways:
        column, height = np.round(axis.transData.transform((point.x, point.y)) * DPI / 100).astype(int)
        row = len(grey) - height
        middle[point.name] = grey[row - 1 : row + 2, column - 1 : column + 2].mean()
        ink[point.name] = (grey[row - 14 : row + 15, column - 14 : column + 15] < 200).sum()
    assert middle["f"] + 50 < middle["d"] and middle["d"] + 50 < middle["b"]
    assert ink["d"] > 1.5 * ink["f"] > 3 * ink["b"] / 2


def test_a_dollar_in_a_name_is_a_dollar(matplotlib: Any) -> None:
    choice = BY_NAME["codec"]
    codecs = figures_of("codec")["codecs"] | {"$\\nonsense{$": {"bytes": 10, "decode_ms": 0.01}}
    figure = chart(choice, panels_of("codec", codecs=codecs), SOURCE)
    assert "$\\nonsense{$" in [text.get_text() for text in figure.axes[0].texts]
    figure.canvas.draw()
