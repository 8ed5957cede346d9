"""Drawing in a thread: the newest request counts, and all are answered."""

from __future__ import annotations

import threading

from bodyseg_model.viewing.page import Redrawing


def test_requests_during_a_drawing_are_answered_by_one_more() -> None:
    begun, go_on, drawn = threading.Event(), threading.Event(), list[int]()

    def draw() -> None:
        drawn.append(len(drawn))
        begun.set()
        go_on.wait(10)

    redrawing = Redrawing(draw, 0.0)
    redrawing.request()
    assert begun.wait(10)
    for _ in range(20):
        redrawing.request()
    assert not redrawing.wait(0.01)
    go_on.set()
    assert redrawing.wait(10)
    redrawing.close()
    assert drawn == [0, 1]


def test_nothing_is_drawn_after_the_end() -> None:
    drawn = list[int]()
    redrawing = Redrawing(lambda: drawn.append(1), 0.0)
    redrawing.close()
    redrawing.request()
    assert not redrawing.wait(0.01) and not drawn


def test_drawings_keep_their_distance() -> None:
    """The second one waits for its time, which does not come within the test."""
    drawn = list[int]()
    redrawing = Redrawing(lambda: drawn.append(1), 600.0)
    redrawing.request()
    assert redrawing.wait(10)
    redrawing.request()
    assert not redrawing.wait(0.05)
    redrawing.close()
    assert drawn == [1]
