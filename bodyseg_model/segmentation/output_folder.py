"""Results of `bodyseg segment`: their folder, which replaces no file but those of an earlier call on the same frames,
and the writer of labels, overlays, preview and summary, beside the labelling of the next frames.
"""

import contextlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, Stopwatch, reported
from bodyseg_data.drawing import draw_legend, save_picture
from bodyseg_data.files import claimed, entries_of, parse_json, parts_left, read_bytes, sync, write_json, write_result
from bodyseg_data.labels import TEMPLATE, LabelMap
from bodyseg_data.machine import peak_mb
from bodyseg_model.recordings import Frame
from bodyseg_model.segmentation.frame_labeller import LabelledFrame
from bodyseg_model.segmentation.pictures import Preview, draw_overlay, encode_picture
from bodyseg_model.segmentation.sequence_summary import SequenceSummary

FORMAT: Final = "bodyseg segment 2"
"""Format of `SUMMARY`."""

SUMMARY: Final = "summary.json"
PREVIEW: Final = "preview.gif"
LEGEND: Final = "legend.png"
UNFINISHED: Final = "unfinished.json"
"""Frames of a call that has not ended yet, or was cut short; it goes when `SUMMARY` is written."""

_MOST_WAITING: Final = 4  # jobs of `WriteBehind` that are not done, so that slow disks bound memory
_LEGEND_WIDTH: Final = 900

Job = Callable[[], None]


class ImageKind(StrEnum):
    """What images show, one of each frame, in a folder of the kind's name."""

    LABELS = "labels"
    PERSONS = "persons"
    OVERLAY = "overlay"
    UNDISTORTED = "undistorted"
    TEMPLATE = TEMPLATE


_WRITE: Final = "write"


class OutputFolder:
    """The folder of one call's results. Nothing is written before `begin`.

    inputs: the paths of the frames, as given. kinds: images that the call writes. Raises BadConfig for a
    folder that holds frames or lies among them, or that holds anything but an earlier call's results, or results of
    frames that are not among `frames`: these would be lost, or mixed with others.
    """

    def __init__(self, path: Path, inputs: Sequence[Path], frames: Sequence[Frame], kinds: Sequence[ImageKind]) -> None:
        self.path, self.kinds = path, tuple(kinds)
        self._frames: list[dict[str, Any]] = [
            {"name": frame.name, "file": frame.where, "path_id": frame.path_id}
            | ({} if frame.time_s is None else {"time_s": frame.time_s})
            for frame in frames
        ]
        self._earlier: list[dict[str, Any]] = []
        place = path.resolve()
        for each in inputs:
            full = each.resolve()
            if full.is_relative_to(place) or (full.is_dir() and place.is_relative_to(full)):
                raise BadConfig(
                    f"--out must lie outside the frames' folders and hold no frames, found {path} and {each}"
                )
        self._look()

    @contextlib.contextmanager
    def claimed(self) -> Iterator[None]:
        """Hold the folder against other calls while the context lasts. Raises BadConfig, also for one that is held."""
        with claimed(self.path, "segment"):
            self._look()  # another call may have ended meanwhile
            yield

    def _look(self) -> None:
        path, held = self.path, list[str]()
        with reported(f"cannot write {path}", BadConfig, OSError), contextlib.suppress(FileNotFoundError):
            held = [entry.name for entry in entries_of(path)]
        if held:
            self._earlier = _earlier_frames(path, held)
            same = {frame["path_id"] for frame in self._frames}
            for frame in self._earlier:
                if frame["path_id"] not in same and any(image.exists() for image in self._images(frame["name"])):
                    raise BadConfig(
                        f"--out must not hold results of other frames, found those of {frame['file']} in {path}: "
                        "give a new folder, or delete this one"
                    )

    def begin(self) -> None:
        """Make the folders. An earlier summary goes first, so that a summary is always of all results; then the earlier
        call's images that this one does not replace, folders left empty, its preview and legend. Raises BadConfig.
        """
        with reported(f"cannot write {self.path}", BadConfig, OSError):
            kept = {self.image(kind, frame["name"]) for kind in self.kinds for frame in self._frames}
            self.path.mkdir(parents=True, exist_ok=True)
            write_json(self.path / UNFINISHED, {"format": FORMAT, "each": self._frames})  # first: says whose all is
            stale = {image for frame in self._earlier for image in self._images(frame["name"])} - kept
            above = {folder for image in stale for folder in image.parents if folder.is_relative_to(self.path)}
            needed = {self.path, *(image.parent for image in kept)}
            for folder in needed:
                folder.mkdir(parents=True, exist_ok=True)
            for leftover in (*stale, *(part for folder in needed | above for part in parts_left(folder))):
                leftover.unlink(missing_ok=True)
            for name in (SUMMARY, PREVIEW, LEGEND):
                (self.path / name).unlink(missing_ok=True)
            for folder in sorted(above - needed, reverse=True):  # inner folders first
                with contextlib.suppress(OSError):  # it is not there, or holds something else
                    folder.rmdir()

    def _images(self, name: str) -> set[Path]:
        """Paths of all images that a call may have written of a frame."""
        return {self.image(kind, name) for kind in ImageKind}

    def image(self, kind: ImageKind, name: str) -> Path:
        """Path of a frame's image."""
        return self.path / kind / f"{name}.png"

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Write the summary once the disk holds all images: `each` in order, without `skipped`. Raises BadConfig."""
        skipped = {frame["name"] for frame in summary.get("skipped", ())}
        frames = [frame for frame in self._frames if frame["name"] not in skipped]
        each = [{**frame, **entry} for frame, entry in zip(frames, summary["each"], strict=True)]
        with reported(f"cannot write {self.path}", BadConfig, OSError):
            images = [self.image(kind, frame["name"]) for kind in self.kinds for frame in frames]
            for path in (*images, *dict.fromkeys(image.parent for image in images)):
                sync(path)
            write_json(self.path / SUMMARY, {"format": FORMAT, **summary, "each": each})
            (self.path / UNFINISHED).unlink(missing_ok=True)


def _earlier_frames(out: Path, held: Sequence[str]) -> list[dict[str, Any]]:
    """Name and file of every frame of an earlier call, from its summary or, if it was cut short, from `UNFINISHED`."""
    strange = [name for name in held if name not in (SUMMARY, UNFINISHED, PREVIEW, LEGEND, *ImageKind)]
    notes = [name for name in (UNFINISHED, SUMMARY) if name in held]
    if strange or not notes:
        raise BadConfig(
            f"--out must be a new folder, or one of earlier results of `bodyseg segment`: {out} holds "
            f"{(strange or held)[0]}"
        )
    frames: dict[str, dict[str, Any]] = {}
    for name in notes:
        tree = parse_json(read_bytes(out / name), str(out / name))  # a kilobyte a frame: more than `read_json` takes
        each = tree.get("each")
        if tree.get("format") != FORMAT or not isinstance(each, list) or not all(map(_is_frame, each)):
            raise BadConfig(
                f"--out must be a new folder, or one of earlier results of `bodyseg segment`: {out / name} is not of "
                f"format {FORMAT!r}"
            )
        frames |= {frame["name"]: frame for frame in each}
    return list(frames.values())


def _is_frame(entry: Any) -> bool:
    """True for an entry that names a frame's results within the folder, and the frame."""
    texts = [entry.get(key) for key in ("name", "file", "path_id")] if isinstance(entry, dict) else [None]
    return all(isinstance(text, str) for text in texts) and not {"", ".", ".."} & set(entry["name"].split("/"))


class WriteBehind:
    """Does jobs one after another in a thread, in the order of `then`, as a context manager.

    At the end of the context every job is done, also where it ends by an error or Ctrl-C. After a job fails, later
    jobs are dropped; the error is raised by a later `then`, or at the end of the context.
    """

    def __init__(self) -> None:
        self._thread, self._waiting = ThreadPoolExecutor(1, "writing"), deque[Future[None]]()

    def __enter__(self) -> Self:
        return self

    def then(self, job: Job) -> None:
        """Have a job done after all others. Raises the error of an earlier one."""
        before = self._waiting[-1] if self._waiting else None
        if len(self._waiting) == _MOST_WAITING:
            self._waiting.popleft().result()
        self._waiting.append(self._thread.submit(self._after, before, job))

    def _after(self, before: Future[None] | None, job: Job) -> None:
        if before is not None:
            before.result()  # raises its error, which so goes on to the last job
        job()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, *_: object) -> None:
        self._thread.shutdown()
        failed = self._waiting[-1].exception() if self._waiting else None
        # A job's error goes before an error of later frames, but not before Ctrl-C.
        if failed is not None and failed is not error and (error is None or isinstance(error, Exception)):
            raise failed


class FrameResults(WriteBehind):
    """Writes the results of labelled frames into a folder, in their order, by another thread: a context manager.

    label_map: the network's classes. preview: None if no overlays are drawn. shape: rows and columns of the preview's
    frames; others are left out of it. `summary` has all frames when the context has ended.
    """

    def __init__(self, out: OutputFolder, label_map: LabelMap, preview: Preview | None, shape: tuple[int, int]) -> None:
        super().__init__()
        self.summary = SequenceSummary()
        self._out, self._label_map, self._preview, self._shape = out, label_map, preview, shape

    def begin(self) -> None:
        """Make the folders, and load the compiled loops, so that the first frame takes no longer than others."""
        self._out.begin()
        if self._preview is not None:
            nothing = np.zeros((1, 1), np.float32)
            draw_overlay(nothing, nothing.astype(np.uint8), [np.zeros(1, np.intp)], self._label_map)

    def add(self, labelled: LabelledFrame, frame: Frame, done: Job) -> None:
        """Write and count the labels of a recording's frame after all before it, then call `done`.

        Raises BadConfig for an earlier frame whose files could not be written, naming the file.
        """
        self.then(partial(self._write, labelled, frame, done))

    def _write(self, labelled: LabelledFrame, frame: Frame, done: Job) -> None:
        watch = Stopwatch((_WRITE,))
        with watch(_WRITE):
            images: dict[ImageKind, NDArray[Any]] = {ImageKind.LABELS: labelled.labels}
            if ImageKind.PERSONS in self._out.kinds:
                images[ImageKind.PERSONS] = labelled.persons
            if self._preview is not None:
                bodies = [body.pixels for body in labelled.bodies]
                overlay = draw_overlay(labelled.range_m, labelled.labels, bodies, self._label_map)
                images[ImageKind.OVERLAY] = overlay
                if overlay.shape[:2] == self._shape:
                    self._preview.add(overlay)  # all frames of an animation have one size
            if ImageKind.UNDISTORTED in self._out.kinds and labelled.stored is not None:
                images[ImageKind.UNDISTORTED] = labelled.stored
            if ImageKind.TEMPLATE in self._out.kinds:
                images[ImageKind.TEMPLATE] = labelled.template
            # Flushed at the end: to wait for a slow disk four times a frame would take more than real time.
            for kind, image in images.items():
                write_result(self._out.image(kind, frame.name), encode_picture(image), flushed=False)
        times = {**labelled.milliseconds, **watch.milliseconds}
        camera = None if labelled.own_camera is None else labelled.own_camera.to_json()
        self.summary.add(labelled, times, frame.sequence, camera)
        done()

    def finish(self, facts: Mapping[str, Any]) -> None:
        """Write preview, legend and summary, with `facts` of the call. Raises BadConfig."""
        if self._preview is not None:
            save_picture(draw_legend(_LEGEND_WIDTH, self._label_map), self._out.path / LEGEND)
            write_result(self._out.path / PREVIEW, self._preview.to_gif())
        self._out.finish({**facts, "peak_mb": peak_mb(), **self.summary.to_json()})
