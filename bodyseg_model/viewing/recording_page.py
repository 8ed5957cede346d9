"""The controls of a recording's page: play, pause, and the choice of a frame."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from typing import Any, Final

from bodyseg_model.viewing.page import Page
from bodyseg_model.viewing.recording_view import FRAME_COLOURINGS, FrameColouring, RecordingView, ShownFrame
from bodyseg_model.viewing.space import Drawing

_DRAWING_S: Final = 60.0


class RecordingPage:
    """Puts a recording on a page and keeps what its controls say. While it plays, no frame is left out: a frame that
    takes longer than its time delays the next one.
    """

    def __init__(self, page: Page, view: RecordingView) -> None:
        self.page, self.view, self.shown = page, view, ShownFrame()
        self._lock = threading.RLock()
        self._playing, self._closed = threading.Event(), threading.Event()
        gui = page.server.gui
        with gui.add_folder("Frames"):
            # A slider needs two ends.
            self._number: Any = gui.add_slider("frame", 0, max(1, len(view) - 1), 1, self.shown.number)
            self._play: Any = gui.add_checkbox("play", False)
            self._rate: Any = gui.add_slider("frames a second", 1, 30, 1, 10)
            step = gui.add_button_group("go to", ("previous", "next"))
        with gui.add_folder("Image"):
            colouring = gui.add_dropdown("colour by", FRAME_COLOURINGS, initial_value=self.shown.colouring)
            room = gui.add_checkbox("room", self.shown.room)
        page.add_view_controls()

        @self._number.on_update
        def _(_: object) -> None:
            self.change(number=min(int(self._number.value), len(view) - 1))

        @self._play.on_update
        def _(_: object) -> None:
            (self._playing.set if self._play.value else self._playing.clear)()

        @step.on_click
        def _(_: object) -> None:
            self.go_on(1 if step.value == "next" else -1)

        @colouring.on_update
        def _(_: object) -> None:
            chosen: FrameColouring = next(each for each in FRAME_COLOURINGS if each == colouring.value)
            self.change(colouring=chosen)

        @room.on_update
        def _(_: object) -> None:
            self.change(room=room.value)

        page.start(self.draw)
        self._player = threading.Thread(target=self._run, name="player", daemon=True)
        self._player.start()

    def __repr__(self) -> str:
        return f"RecordingPage({self.page!r}, {self.view!r})"

    def draw(self) -> Drawing:
        """Draw what the controls say. Raises as `RecordingView.draw`."""
        with self._lock:
            shown = self.shown
        return self.view.draw(shown)

    def change(self, **changes: Any) -> None:
        """Change what is shown, by the fields of `ShownFrame`, and draw it."""
        with self._lock:
            self.shown = replace(self.shown, **changes)
        self.page.request()

    def go_on(self, frames: int) -> None:
        """Show the frame so many after this one; the first one follows the last."""
        self._number.value = (self.shown.number + frames) % len(self.view)

    def play(self, on: bool = True) -> None:
        """Play or pause."""
        self._play.value = on

    def close(self) -> None:
        """Stop playing."""
        self._closed.set()
        self._playing.set()
        self._player.join()

    def _run(self) -> None:
        while True:
            self._playing.wait()
            if self._closed.is_set():
                return
            due = time.monotonic() + 1 / self._rate.value
            self.go_on(1)
            self.page.wait(_DRAWING_S)
            self._closed.wait(max(0.0, due - time.monotonic()))
