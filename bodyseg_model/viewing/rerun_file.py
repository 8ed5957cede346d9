"""Files for the viewer Rerun with what the page shows: `bodyseg view --rrd`.

The package `rerun-sdk` is no dependency: it is imported when a file is written.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts.variants import VARIANTS
from bodyseg_data.core.errors import BadConfig, MissingLibrary
from bodyseg_data.core.files import sync
from bodyseg_data.core.parts import BACKGROUND
from bodyseg_data.core.system.progress import ProgressCallback
from bodyseg_data.drawing.contact_sheet import span_of
from bodyseg_model.recordings.recording import evenly_apart
from bodyseg_model.segmentation.flicker import flicker
from bodyseg_model.viewing.pictures import KIND_LEGEND, Legend, class_legend, label_image
from bodyseg_model.viewing.recording_view import FLICKER_LEGEND, Labelled, RecordingView, changes_of
from bodyseg_model.viewing.set_view import SetView, Shown
from bodyseg_model.viewing.space import Device, Points, camera_alone, device

_IMAGE_PLANE_M: Final = 0.4
_TIME: Final = "time"


class RerunFile:
    """A file that is written while the block runs, and is there when the block has ended without an error.

    path: the file, replaced if it is there. classes: of the labels. pages: names of the images on each page of the
    layout that the viewer opens with. curves: whether there are numbers to draw. Raises MissingLibrary, BadConfig if
    the file cannot be written.
    """

    def __init__(self, path: Path, classes: Legend, pages: Sequence[Sequence[str]], curves: bool = False) -> None:
        try:
            self._sdk: Any = import_module("rerun")
            self._layout: Any = import_module("rerun.blueprint")
        except ImportError as error:
            raise MissingLibrary(
                f"bodyseg view --rrd needs the package 'rerun-sdk': pip install rerun-sdk ({error})"
            ) from error
        self.path, self._classes, self._pages, self._curves = path, classes, pages, curves
        self._part = path.with_name(f".{path.name}.part")

    def __enter__(self) -> RerunFile:
        self._stream = self._sdk.RecordingStream("bodyseg view")
        with self._told():
            self._stream.save(self._part, default_blueprint=self._blueprint())
        self.log("world", self._sdk.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
        for entity in ("world", "images"):
            self.annotate(entity, self._classes)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._stream.disconnect()  # returns when all is written
            if kind is None:
                with self._told():
                    self._part.replace(self.path)
                    sync(self.path.parent)
        finally:
            self._part.unlink(missing_ok=True)

    def at(self, timeline: str, number: int, seconds: float | None = None) -> None:
        """Set the place on the timeline, and on that of seconds, of what is logged next; None: on no time."""
        self._stream.reset_time()
        self._stream.set_time(timeline, sequence=number)
        if seconds is not None:
            self._stream.set_time(_TIME, duration=seconds)

    def log(self, entity: str, *things: Any, static: bool = False) -> None:
        """Write what Rerun calls an entity. static: at all times."""
        self._stream.log(entity, *things, static=static, strict=True)

    def annotate(self, entity: str, legend: Legend) -> None:
        """Name and colour the classes of an entity's images, and of those below it; `BACKGROUND` is not drawn."""
        classes = [(number, name, colour) for number, (name, colour) in enumerate(legend)]
        self.log(entity, self._sdk.AnnotationContext([*classes, (BACKGROUND, "no label", (0, 0, 0, 0))]), static=True)

    def range_image(self, entity: str, image: NDArray[Any], step_m: float, span: tuple[float, float]) -> None:
        """Write a range image [H, W]. step_m: metres a step. span: nearest and farthest range of its colours, steps."""
        self.log(entity, self._sdk.DepthImage(image, meter=1 / step_m, depth_range=span))

    def classes(self, entity: str, image: NDArray[np.uint8]) -> None:
        """Write an image of classes, uint8 [H, W]."""
        self.log(entity, self._sdk.SegmentationImage(image))

    def shares(self, entity: str, image: NDArray[np.float32]) -> None:
        """Write an image of shares, float32 [H, W], 0 to 1, as 8 bits a pixel."""
        self.log(entity, self._sdk.Image(np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)))

    def points(self, entity: str, points: Points, classes: NDArray[np.uint8] | None = None) -> None:
        """Write points in space. classes: uint8 [N], of each, by which the viewer names them."""
        self.log(entity, self._sdk.Points3D(points.xyz, colors=points.colours, class_ids=classes))

    def device(self, device: Device, camera: Any) -> None:
        """Write a camera or projector as a pyramid. camera: its lens, a `Camera`."""
        w, x, y, z = device.wxyz
        lens = self._sdk.Pinhole(
            resolution=(camera.columns, camera.rows),
            focal_length=camera.focal_px,
            principal_point=camera.centre_px,
            image_plane_distance=_IMAGE_PLANE_M,
        )
        placed = self._sdk.Transform3D(translation=device.position_m, rotation=self._sdk.Quaternion(xyzw=(x, y, z, w)))
        self.log(f"world/{device.name.replace(' ', '_')}", placed, lens)

    def text(self, entity: str, lines: Sequence[str]) -> None:
        """Write lines of plain text."""
        self.log(entity, self._sdk.TextDocument("\n".join(lines)))

    def number(self, entity: str, value: float) -> None:
        """Write a number of a curve."""
        self.log(entity, self._sdk.Scalars(value))

    @contextlib.contextmanager
    def _told(self) -> Any:
        try:
            yield
        except (OSError, RuntimeError) as error:
            raise BadConfig(f"cannot write {self.path}: {error}") from error

    def _blueprint(self) -> Any:
        """The layout that the viewer opens with: points beside pages of images, facts below."""
        kit = self._layout
        pages = [
            kit.Grid(*(kit.Spatial2DView(origin=image, name=image.rpartition("/")[2]) for image in images))
            for images in self._pages
        ]
        below = [kit.TimeSeriesView(origin="curves", name="curves")] if self._curves else []
        below.append(kit.TextDocumentView(origin="facts", name="facts"))
        beside = kit.Vertical(*pages, *below, row_shares=[*([3] * len(pages)), *([1] * len(below))])
        points = kit.Spatial3DView(origin="world", name="points")
        return kit.Blueprint(kit.Horizontal(points, beside), collapse_panels=True)


def write_set(path: Path, view: SetView, shown: Shown, count: int, progress: ProgressCallback) -> int:
    """Write samples of a set, and return their number: at most `count`, evenly over those chosen.

    shown: the variant, epoch and sensor. Images are in steps of the set's rig. Raises as `RerunFile` and
    `SetView.images_of`.
    """
    numbers = evenly_apart(len(view), count)
    answered = ("answer", "mistakes", "confidence") if view.trained is not None and shown.network else ()
    names = [f"images/{name}" for name in ("range", "projector", "labels", *answered)]
    variants = [f"variants/{name}" for name in VARIANTS]
    with RerunFile(path, class_legend(view.label_map), (names, variants)) as file:
        file.annotate("images/mistakes", KIND_LEGEND)
        for done, number in enumerate(numbers, start=1):
            _write_sample(file, view, replace(shown, index=number))
            progress(done, len(numbers))
    return len(numbers)


def _write_sample(file: RerunFile, view: SetView, shown: Shown) -> None:
    found, step_m = view.images_of(shown), view.rig.range_step_m
    layers, stored, projector = found.layers, found.sample.range, found.sample.occluder_range()
    file.at("sample", shown.index)
    for one, placed in zip(found.devices, found.placed, strict=True):
        file.device(one, placed.camera)
    file.points("world/points", view.points_of(found, shown.colouring), layers.labels[layers.range > 0])
    file.range_image("images/range", stored, step_m, span_of(stored))
    file.range_image("images/projector", projector, step_m, span_of(projector))
    file.classes("images/labels", layers.labels)
    if layers.answer is not None and layers.kinds is not None and layers.confidence is not None:
        file.classes("images/answer", layers.answer)
        file.classes("images/mistakes", layers.kinds)
        file.shares("images/confidence", np.where(layers.range > 0, layers.confidence, np.float32(0)))
    for name in VARIANTS:
        file.range_image(f"variants/{name}", found.variants[name].range, step_m, span_of(stored))
    file.text("facts", view.facts_of(found, shown))


def write_recording(path: Path, view: RecordingView, count: int, progress: ProgressCallback) -> tuple[int, list[str]]:
    """Write frames of a recording, at most `count`, evenly over it; return their number, and a line for each frame that
    cannot be read, which is left out.

    Frames with a time stand on a timeline of the seconds since the first of them, too. Raises as `RerunFile`, and
    BadConfig if no frame can be read.
    """
    numbers = evenly_apart(len(view), count)
    start_s = min((frame.time_s for frame in view.frames if frame.time_s is not None), default=0.0)
    names = [f"images/{name}" for name in ("range", "labels", "confidence", "flicker")]
    faults: list[str] = []
    with RerunFile(path, class_legend(view.label_map), (names,), curves=True) as file:
        file.annotate("images/flicker", FLICKER_LEGEND)
        for done, number in enumerate(numbers, start=1):
            time_s = view.frames[number].time_s
            try:
                frame = view.labelled(number)
            except BadConfig as error:
                faults.append(str(error))
            else:
                file.at("frame", number, None if time_s is None else time_s - start_s)
                _write_frame(file, view, number, frame)
            progress(done, len(numbers))
        if len(faults) == len(numbers):
            raise BadConfig(f"no frame could be read; the first: {faults[0]}")
    return len(numbers) - len(faults), faults


def _write_frame(file: RerunFile, view: RecordingView, number: int, frame: Labelled) -> None:
    before = None
    with contextlib.suppress(BadConfig):  # a frame before that cannot be read is as none
        before = view.before(number)
    labels, seen = frame.segmentation.labels, frame.body_m > 0
    file.device(device("camera", camera_alone(frame.camera)), frame.camera)
    colours = label_image(labels, frame.range_m > 0, view.label_map)
    file.points("world/bodies", frame.body_points(colours), labels[seen])
    file.points("world/room", frame.room_points())
    file.range_image("images/range", frame.range_m, 1.0, span_of(frame.range_m))
    file.classes("images/labels", labels)
    file.shares("images/confidence", frame.confidence)
    file.classes("images/flicker", changes_of(frame, before))
    file.number("curves/milliseconds", frame.milliseconds)
    if frame.segmentation.mean_confidence is not None:
        file.number("curves/confidence", frame.segmentation.mean_confidence)
    if before is not None:
        shares = flicker(before.segmentation.labels, labels, before.range_m, frame.range_m).to_json()
        if shares["changed"] is not None:
            file.number("curves/flicker", shares["changed"])
    file.text("facts", view.facts(number, frame, before))
