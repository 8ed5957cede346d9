"""A recording's page: playing, and the choice of a frame."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from bodyseg_model.viewing import LOOPBACK, Page, RecordingPage
from bodyseg_model.viewing.pictures import Drawing, Points
from bodyseg_model.viewing.recording_view import ShownFrame

WAIT_S = 60.0


class Numbers:
    """Stands for the view of a recording of three frames; drawings are of as many points as the frame's number."""

    def __init__(self) -> None:
        self.drawn: list[ShownFrame] = []
        self.round = threading.Event()

    def __len__(self) -> int:
        return 3

    def draw(self, shown: ShownFrame) -> Drawing:
        self.drawn.append(shown)
        if [each.number for each in self.drawn[-4:]] == [1, 2, 0, 1]:
            self.round.set()
        points = Points(np.zeros((shown.number, 3), np.float32), np.zeros((shown.number, 3), np.uint8))
        return Drawing(points, {}, np.zeros((2, 2, 3), np.uint8), (f"frame {shown.number}",), 0.01, 0, ())


@pytest.fixture
def shown() -> Iterator[tuple[RecordingPage, Numbers]]:
    page, view = Page(LOOPBACK, 0, "bodyseg view"), Numbers()
    stands_for: Any = view
    recording = RecordingPage(page, stands_for)
    yield recording, view
    recording.close()
    page.close()


def test_playing_draws_every_frame_in_turn(shown: tuple[RecordingPage, Numbers]) -> None:
    recording, view = shown
    recording._rate.value = 30
    recording._play.value = True
    assert view.round.wait(WAIT_S)
    recording._play.value = False
    numbers = [each.number for each in view.drawn]
    assert all((after - before) % 3 <= 1 for before, after in itertools.pairwise(numbers))


def test_frames_are_chosen(shown: tuple[RecordingPage, Numbers]) -> None:
    recording, view = shown
    recording.go_on(-1)
    assert recording.page.wait(WAIT_S) and view.drawn[-1].number == 2 == recording._number.value
    recording.go_on(1)
    assert recording.page.wait(WAIT_S) and view.drawn[-1].number == 0
    recording.change(colouring="flicker", room=False)
    assert recording.page.wait(WAIT_S) and view.drawn[-1] == ShownFrame(0, "flicker", False)
