"""The page of a recording: a frame with the labels that the network gives its people, and its controls."""

import threading
import time
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_data.drawing import EMPTY, THING, window_of
from bodyseg_data.labels import BACKGROUND, colour_labels
from bodyseg_model.segmentation import STILL_M, LabelledFrame, LabelledRecording, Segmentation, draw_overlay, flicker
from bodyseg_model.viewing.page import Controls, Page
from bodyseg_model.viewing.pictures import (
    CONFIDENCE_LEGEND,
    Drawing,
    Layout,
    Legend,
    Panel,
    Points,
    camera_alone,
    class_image,
    class_legend,
    point_gap_m,
    points_at,
    share_image,
)

FrameColouring = Literal["parts", "confidence", "flicker"]
FRAME_COLOURINGS: Final[tuple[FrameColouring, ...]] = get_args(FrameColouring)
"""What the points of bodies are coloured by."""

FLICKER_LEGEND: Final[Legend] = (
    ("same label as in the frame before", (196, 200, 206)),
    ("another label, the surface moved", (224, 161, 60)),
    (f"another label, moved by less than {1000 * STILL_M:g} mm", (214, 60, 52)),
    ("no label in the frame before", (112, 116, 124)),
)
"""Name and sRGB of each kind of change from the frame before."""

_CHANGE_COLOURS: Final = np.array([colour for _, colour in FLICKER_LEGEND], np.uint8)
_NOTHING: Final = Points(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
_KEPT: Final = 32
_ROOM_STEP: Final = 3

_DRAWING_S: Final = 60.0


@dataclass(frozen=True)
class ShownFrame:
    """Choice of what is drawn. number: of the frame. room: whether points beside bodies are shown, one of nine."""

    number: int = 0
    colouring: FrameColouring = "parts"
    room: bool = True


class RecordingView:
    """Labels the frames of a recording when they are first drawn, and keeps the last ones."""

    def __init__(self, recording: LabelledRecording) -> None:
        self.recording, self.label_map = recording, recording.labeller.label_map
        self.labelled = lru_cache(maxsize=_KEPT)(recording.label)

    def __len__(self) -> int:
        return len(self.recording)

    def draw(self, shown: ShownFrame) -> Drawing:
        """Draw a frame. Raises BadConfig for one that cannot be read or does not fit its camera."""
        frame, before = self.labelled(shown.number), self.before(shown.number)
        changes = changes_of(frame, before)
        colours, legend = self._colours(shown.colouring, frame, changes)
        body_m = body_range(frame)
        bodies = Points(points_at(body_m, camera_alone(frame.camera)), colours[body_m > 0])
        room = _room_points(frame, body_m) if shown.room else _NOTHING
        world = np.array([-1 if frame.mirrored else 1, 1, 1], np.float32)  # as the camera itself sees
        return Drawing(
            Points(world * np.concatenate([bodies.xyz, room.xyz]), np.concatenate([bodies.colours, room.colours])),
            {"camera": camera_alone(frame.camera)},
            self._picture(frame, changes),
            self.facts(shown.number, frame, before),
            point_gap_m(body_m if len(bodies.xyz) else frame.range_m, frame.camera),
            len(bodies.xyz),
            legend,
        )

    def before(self, number: int) -> LabelledFrame | None:
        """The frame before, if it can be read and is of the same recording and size. Raises as `draw`, of this one."""
        frames = self.recording.frames
        if number == 0 or frames[number - 1].sequence != frames[number].sequence:
            return None
        try:
            before = self.labelled(number - 1)
        except BadConfig:
            return None
        return before if before.range_m.shape == self.labelled(number).range_m.shape else None

    def _colours(
        self, colouring: FrameColouring, frame: LabelledFrame, changes: NDArray[np.uint8]
    ) -> tuple[NDArray[np.uint8], Legend]:
        """Colours of all pixels, sRGB uint8 [H, W, 3], and their legend."""
        seen = frame.range_m > 0
        if colouring == "confidence":
            return share_image(frame.confidence, seen), CONFIDENCE_LEGEND
        if colouring == "flicker":
            return colour_labels(changes, EMPTY, _CHANGE_COLOURS), FLICKER_LEGEND
        return class_image(frame.labels, seen, self.label_map.colours), class_legend(self.label_map)

    def _picture(self, frame: LabelledFrame, changes: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The whole frame with its labels; below it confidence and flicker, of bodies alone where they are small."""
        bodies = [body.pixels for body in frame.bodies]
        overlay = draw_overlay(frame.range_m, frame.labels, bodies, self.label_map)
        whole = Layout.of(1, (overlay.shape[0], overlay.shape[1]))
        measured = body_range(frame) > 0
        window = window_of([measured])
        rows, columns = measured[window].shape
        near = Layout.of(2, (rows, columns))
        confidences = share_image(near.reduced(frame.confidence[window]), near.reduced(measured[window]))
        changed = colour_labels(near.reduced(changes[window]), EMPTY, _CHANGE_COLOURS)
        note = "nobody" if frame.mean_confidence is None else f"mean {frame.mean_confidence:.0%}"
        flickering = Panel("flicker", changed, "labels beside those of the frame before")
        above = [Panel("labels on the range image", whole.reduced(overlay), self._counted(frame))]
        return np.concatenate([whole.draw([above]), near.draw([[Panel("confidence", confidences, note), flickering]])])

    def facts(self, number: int, frame: LabelledFrame, before: LabelledFrame | None) -> tuple[str, ...]:
        """Lines of text on a frame: its name, people and things, times, confidence and flicker."""
        stages = ", ".join(f"{stage} {time:.0f}" for stage, time in frame.milliseconds.items())
        facts = [
            self.recording.frames[number].name,
            f"frame {number}, {len(self)} in all: {self._counted(frame)}",
            f"{sum(frame.milliseconds.values()):.0f} ms when it was labelled: {stages}",
        ]
        if frame.mean_confidence is not None:
            facts.append(f"mean confidence {frame.mean_confidence:.1%}")
        if before is not None:
            change = flicker(before, frame)
            if change["shared"]:
                still = change["still"] and f", where nothing moves {change['still_changed'] / change['still']:.1%}"
                facts.append(f"flicker {change['changed'] / change['shared']:.1%}{still or ''}")
        return tuple(facts)

    def _counted(self, found: Segmentation) -> str:
        if self.recording.labeller.background.mode == "frame":
            return "labelled whole"
        people, things = len(found.bodies), len(found.things)
        return f"{people} {'person' if people == 1 else 'people'}, {things} thing{'' if things == 1 else 's'}"


def changes_of(frame: LabelledFrame, before: LabelledFrame | None) -> NDArray[np.uint8]:
    """Change of each pixel's label from the frame before, uint8 [H, W]: number in `FLICKER_LEGEND`, 255 without one."""
    found = np.where(frame.labels != BACKGROUND, np.uint8(3), np.uint8(BACKGROUND))
    if before is not None:
        shared = (found == 3) & (before.labels != BACKGROUND)
        changed = np.uint8(1) + (np.abs(frame.range_m - before.range_m) < STILL_M)
        found = np.where(shared, changed * (before.labels != frame.labels), found)
    return found


def body_range(frame: LabelledFrame) -> NDArray[np.float32]:
    """Range of the bodies alone, metres, float32 [H, W], 0 elsewhere."""
    return np.where(frame.persons > 0, frame.range_m, np.float32(0))


def _room_points(frame: LabelledFrame, body_m: NDArray[np.float32]) -> Points:
    """Points beside bodies, one of nine, grey."""
    thinned = np.zeros_like(frame.range_m)
    thinned[::_ROOM_STEP, ::_ROOM_STEP] = np.where(body_m > 0, np.float32(0), frame.range_m)[::_ROOM_STEP, ::_ROOM_STEP]
    xyz = points_at(thinned, camera_alone(frame.camera))
    return Points(xyz, np.broadcast_to(np.array(THING, np.uint8), xyz.shape))


class RecordingPage(Controls):
    """Puts a recording on a page and keeps what its controls say. A slow frame delays the next; none is left out."""

    def __init__(self, page: Page, view: RecordingView) -> None:
        super().__init__(page, view, ShownFrame())
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

        colouring.on_update(lambda _: self.change(colouring=colouring.value))
        room.on_update(lambda _: self.change(room=room.value))
        page.start(self.draw)
        self._player = threading.Thread(target=self._run, name="player", daemon=True)
        self._player.start()

    def go_on(self, frames: int) -> None:
        """Show the frame so many after this one; the first one follows the last."""
        self._number.value = (self.shown.number + frames) % len(self.view)

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
