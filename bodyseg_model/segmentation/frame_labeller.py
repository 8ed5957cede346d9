"""From frames to labels: recordings and streams of frames, labelled one after another."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Final, TypeVar, cast, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, Stopwatch, check_choice, check_class, check_int, reported
from bodyseg_data.labels import LabelMap, load_label_map
from bodyseg_data.rigs import Camera
from bodyseg_model.networks import CardWords, Trained, device_of, load_network
from bodyseg_model.recordings import Frame, FrameCamera, FrameCameras, Pixels, Skipping, Stamp, find_frames, to_metres
from bodyseg_model.runtimes import BackendName, Precision, backend_of, put_on_backend, to_device
from bodyseg_model.segmentation.carried_labels import CarriedLabels
from bodyseg_model.segmentation.finder import Background, shipped_finder
from bodyseg_model.segmentation.segmenter import LEAST_CONFIDENCE, Segmentation, Segmenter, least_confidence_of_people
from bodyseg_model.segmentation.views import Turned, Undistortion, metres_of

_READ: Final = "read"
_KEPT: Final = 16  # cameras whose segmenters are kept: an undistortion takes as much as several frames

_END: Final = object()

_JUDGED: Final = 4  # frames with people that tell how the camera is turned
_MOST_LOOKED_AT: Final = 32  # frames of a recording
_SURER: Final = 0.05
_PERSON: Final = 0.65  # least mean confidence in a person; the network that ships has less on furniture

Item = TypeVar("Item")


@dataclass(frozen=True, eq=False, kw_only=True)
class LabelledFrame(Segmentation):
    """A `Segmentation` of one frame of a recording or stream, with the facts of that frame.

    number: the frame's place, from 0, in its recording or stream. milliseconds: time of reading, "read", and of each of
    the segmenter's `STAGES`. frame: its name, time and file; of recordings alone, live or stored.
    Of stored recordings alone: stored, uint16 [H, W], the frame in its steps, without lens distortion; own_camera, if
    the frame has one of its own; stamp, of its message, if it was asked for.
    """

    number: int
    frame: Frame | None = None
    stored: Pixels | None = field(default=None, repr=False)
    own_camera: FrameCamera | None = None
    stamp: Stamp | None = None


Labelling = Callable[[], LabelledFrame]
"""Labels a frame that has been read."""


class FrameLabeller:
    """Labels body parts of people in frames of any range sensor: of one array (a call), a `stream`, or a `recording`.

    Lens distortion is removed from a frame and people are found in it; each is resampled for the network and labelled,
    and labels are mapped back (`Segmenter`, one for each camera). A person whom the networks doubt more than the card
    of the labelling one allows is a thing, which gets no labels (`least_confidence_of_people`).

    trained: network that labels, with its card; by default the one that ships.
    background: rule for removing the background; by default `Background()`, or `Background("frame")` for a network of
    other classes than body parts.
    mirrored: True if frames show left for right, as those of some drivers do.
    least_confidence: pixels of less confidence than this, 0 to 1, get no label. keep_things: label things, too.
    finder: network that finds people; by default the one that ships.
    video: frames are one camera's and follow each other in time; labels are steadied by those before (`CarriedLabels`).
    backend, precision: what computes the networks (`on_backend`); by default torch in float32.
    flip_average: label the mirror image, too, and average. dense: as of `Segmenter`.
    device: "cpu", "cuda", "cuda:1" ...; by default a GPU if there is one.
    turned: degrees by which the camera is mounted turned clockwise, as seen from behind it: 0; 90, heads point left in
    its frames; 180, down; 270, right; "auto", for recordings: the turn at which the network is surest of a person in
    four frames with people; by default the roll of the frames' camera. Frames are turned upright, and labels back.
    labels: coarser classes to give, of which the network's are parts: a label map, its name or file (`load_label_map`).

    Raises BadConfig for classes that the network's cannot be joined to, for another turn, for `finder` or `keep_things`
    with another background than "people", for a confidence outside 0 to 1 as soon as a camera is known, and as
    `on_backend` and `to_device`; MissingLibrary.
    """

    def __init__(
        self,
        trained: Trained | None = None,
        background: Background | None = None,
        *,
        mirrored: bool = False,
        least_confidence: float = 0.0,
        keep_things: bool = False,
        finder: Trained | None = None,
        video: bool = False,
        backend: BackendName | None = None,
        precision: Precision | None = None,
        flip_average: bool = False,
        device: str | None = None,
        turned: int | Turned | None = None,
        dense: bool = False,
        labels: str | Path | LabelMap | None = None,
    ) -> None:
        if turned is not None:
            check_choice("turned", str(turned), get_args(Turned))
        self.trained = put_on_backend(trained or load_network(dense=dense), backend, precision, flip_average)
        to_device(self.trained.network, device)
        own, self.rig = self.trained.label_map, self.trained.rig
        self.label_map = own if labels is None else load_label_map(labels, own.of)
        if labels is not None:
            own.joined_to(self.label_map)  # now, so that classes that cannot be given are refused
        self.background = background or Background.usual(own)
        check_class("background", self.background, Background)
        self.mirrored, self.least_confidence = mirrored, least_confidence
        self.video = CarriedLabels() if video else None
        self._finder: Trained | None = None
        if self.background.mode == "people":
            self._finder = put_on_backend(finder or shipped_finder(), backend, precision)
            to_device(self._finder.network, device)
        elif finder is not None or keep_things:
            raise BadConfig(f"finder and keep_things go with the background 'people', found {self.background.mode!r}")
        self._doubted_below = 0.0 if keep_things else least_confidence_of_people(self.trained.card)
        self._turned, self.tells_turn = turned, turned == "auto"
        self._segmenter = partial(
            Segmenter,
            self.trained,
            background=self.background,
            mirrored=mirrored,
            least_confidence=least_confidence,
            doubted_below=self._doubted_below,
            finder=None if self._finder is None else self._finder.network,
            dense=dense,
        )
        self._segmenters = _kept(self._segmenter, self.video)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_segmenters": None}  # a worker that is spawned makes its own

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._segmenters = _kept(self._segmenter, self.video)

    def __repr__(self) -> str:
        return f"FrameLabeller({self.trained!r}, {self.background}, for rig {self.rig.name})"

    def of(self, camera: Camera, auto: int | None = None) -> tuple[Undistortion | None, Segmenter]:
        """The undistortion of a camera's frames, if any, and a segmenter; auto: as of `quarters`. Raises BadConfig."""
        if not isinstance(camera, Camera):
            raise BadConfig(f"a frame needs its camera, like frame_camera((480, 640), 'mine').camera, found {camera!r}")
        return self._segmenters(camera, self.quarters(camera, auto))

    def quarters(self, camera: Camera, auto: int | None = None) -> int:
        """Number of right angles by which the camera's frames are turned clockwise before they are labelled.

        auto: that number with `turned` "auto", as a recording tells it. Raises BadConfig where it must be known.
        """
        if self.tells_turn:
            if auto is None:
                raise BadConfig("turned 'auto' is for recordings: other frames need their turn, like turned=90")
            return auto
        if self._turned is not None:
            return int(self._turned) // 90
        # As against the camera that the network was trained for, which may be turned itself.
        quarters = round((camera.roll_deg - self.rig.camera.roll_deg) / 90)
        return (-quarters if self.mirrored else quarters) % 4

    def surest(self, range_m: NDArray[np.float32], camera: Camera) -> NDArray[np.float64]:
        """How sure the network is of its surest person, for each way of turning a frame, float64 [4]; 0 for nobody."""
        bodies = (self._segmenter(camera, quarters=quarters, either_way=False)(range_m).bodies for quarters in range(4))
        return np.array([max((float(body.confidence.mean()) for body in each), default=0.0) for each in bodies])

    def __call__(self, range_m: NDArray[np.float32], camera: Camera) -> LabelledFrame:
        """Label one frame.

        range_m: array or tensor of floating point, [H, W], metres along the optical axis, 0 or beyond 16.4 = nothing
        measured. camera: the one that took it, with or without lens distortion.
        With `video`, frames must come in order; `restart` begins another recording. Raises BadConfig for a frame of
        another size than the camera's, of whole numbers or in millimetres, or, without a finder of people, with a body
        too large for a view.
        """
        return self._array(0, range_m, camera)()

    def prepare(self, camera: Camera) -> None:
        """Load the compiled loops and label usual views of a camera, so that its first frame takes no longer than
        others; `stream` does so itself. Raises BadConfig.
        """
        self.of(camera)[1].prepare()

    def restart(self, *, numbers: bool = True) -> None:
        """Begin another recording: no labels of `video` are carried over. numbers: people's begin at 1."""
        if self.video is not None:
            self.video.restart(numbers=numbers)

    def stream(
        self, frames: Iterable[NDArray[np.float32] | Frame], camera: Camera, at_once: int = 1
    ) -> Generator[LabelledFrame, None, None]:
        """Label frames as they come, as from a live sensor: yields the answer to each before it asks for the next.

        frames: float32 [H, W], metres, 0 = nothing measured; or those of a `LiveRecording`, whose times are then in
        `answer.frame.time_s`. They may never end. camera: the one that takes them, with or without lens distortion; its
        `prepare` comes first.
        at_once: frames that are labelled at the same time, each in a thread, which has as many of PyTorch's threads as
        the caller: the same answers in the same order, more of them a second, each a little later. Each frame must then
        be an array of its own, into which no driver writes again, and whoever leaves early waits for the next frame: no
        thread can be stopped in a driver. Frames of a `video` are labelled one after another.
        Raises BadConfig as a call, naming the frame by its number.
        """
        self.restart()
        self.prepare(camera)
        read = (self._array(number, each, camera, f"frame {number}") for number, each in enumerate(frames))
        with contextlib.closing(side_by_side(read, 1 if self.video else at_once)) as answers:
            yield from answers

    def _array(self, number: int, given: NDArray[np.float32] | Frame, camera: Any, where: str = "") -> Labelling:
        watch, frame = Stopwatch((_READ,)), given if isinstance(given, Frame) else None
        with reported(where, BadConfig), watch(_READ):
            range_m = given if not isinstance(given, Frame) else to_metres(given.read(), given.step_m)
            lens, segmenter = self.of(camera)
            ideal = range_m if lens is None else lens(metres_of(range_m, camera))
        read_ms = watch.milliseconds[_READ]
        return partial(_label, where, segmenter, self.label_map, ideal, read_ms, number=number, frame=frame)

    def recording(
        self,
        source: str | Path | Frame | Iterable[str | Path | Frame],
        *,
        topic: str | None = None,
        step_m: float | None = None,
        rig: str | None = None,
        focal_px: float | None = None,
        centre_px: tuple[float, ...] = (),
        skip_unreadable: int = 0,
    ) -> LabelledRecording:
        """Open stored recordings to label their frames: in order by iterating over the answer, any one by its `label`.

        source: a path, or several, of PNGs, folders or recordings, read with `topic` and `step_m` as by `find_frames`;
        or frames that it found. rig, focal_px, centre_px: the camera, as of `frame_camera`; by default the one that
        recordings or files beside them hold, or that the frames' size tells. skip_unreadable: skip up to this many
        frames or recordings that cannot be read. Raises BadConfig as `find_frames` and `FrameCameras`; MissingLibrary.
        """
        given = [source] if isinstance(source, (str, Path, Frame)) else list(source)
        paths = [Path(each) for each in given if isinstance(each, (str, Path))]
        frames = [each for each in given if not isinstance(each, (str, Path))]
        if paths:
            frames += find_frames(paths, topic, step_m, skip_unreadable)
        if not all(isinstance(frame, Frame) for frame in frames):
            raise BadConfig("arrays are labelled one by one or by `stream`; a recording has frames, as LiveRecording")
        if not frames:
            raise BadConfig("a recording must hold a frame, found none")
        skipping = Skipping(skip_unreadable)
        cameras = FrameCameras(frames, rig, focal_px, centre_px, self.rig, skipping)
        return LabelledRecording(self, frames, cameras, skipping)

    def to_json(self) -> dict[str, Any]:
        """Settings that labels depend on besides network and frames, as plain JSON."""
        return {
            "background": self.background.to_json(),
            "finder": self._finder
            and {
                CardWords.WEIGHTS_SHA256: self._finder.card.get(CardWords.WEIGHTS_SHA256),
                LEAST_CONFIDENCE: self._doubted_below,
            },
            "rig": self.rig.to_json(),
            "least_confidence": self.least_confidence,
            "video": None if self.video is None else asdict(self.video.carrying),
            "device": str(device_of(self.trained.network)),
            "runtime": backend_of(self.trained.network),
        }


def _kept(
    segmenter: Any, video: CarriedLabels | None
) -> Callable[[Camera, int], tuple[Undistortion | None, Segmenter]]:
    """Undistortion and segmenter of each camera and turn, kept; by no method, so that a labeller nobody holds goes."""
    return lru_cache(maxsize=_KEPT)(partial(_with_lens, partial(segmenter, video=video)))


def _with_lens(segmenter: Any, camera: Camera, quarters: int) -> tuple[Undistortion | None, Segmenter]:
    lens = None if camera.distortion is None else Undistortion(camera)
    return lens, segmenter(camera if lens is None else lens.camera, quarters=quarters)


class LabelledRecording:
    """Recordings whose frames are read and labelled when asked for: all in order by iteration, any one by `label`.

    Made by `FrameLabeller.recording`. frames: all of them, at least one. cameras: of each.
    """

    def __init__(
        self, labeller: FrameLabeller, frames: Sequence[Frame], cameras: FrameCameras, skipping: Skipping
    ) -> None:
        self.labeller, self.frames, self.cameras, self._skipping = labeller, frames, cameras, skipping
        self._auto = 0
        labeller.of(self.cameras.first.camera, self._auto)  # now, so that options that cannot be are refused
        if labeller.tells_turn:
            self._auto = int(self._sure_by_turn().argmax())

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[LabelledFrame]:
        return self.labelled()

    @property
    def skipped(self) -> list[dict[str, str]]:
        """Name, file and error of each frame that could not be read so far, in the order of reading."""
        return self._skipping.skipped

    def surer_turn_deg(self) -> int | None:
        """Turn of the frames, degrees, at which the network is surer by `_SURER` than as they are labelled; or None."""
        sure, used = self._sure_by_turn(), self.turned_deg // 90
        best = int(sure.argmax())
        return 90 * best if sure[best] > sure[used] + _SURER else None

    @property
    def turned_deg(self) -> int:
        """Degrees by which the first frame's camera was mounted turned clockwise, as `FrameLabeller` takes them."""
        return 90 * self.labeller.quarters(self.cameras.first.camera, self._auto)

    def _sure_by_turn(self) -> NDArray[np.float64]:
        """Mean of `FrameLabeller.surest` over some frames from all over the recording, float64 [4]; 0 for none.

        A frame in which the network is sure of nobody does not count: things look alike at every turn.
        """
        judged = list[NDArray[np.float64]]()
        for frame in self.frames[:: -(-len(self) // _MOST_LOOKED_AT)]:
            if len(judged) == _JUDGED:
                break
            with contextlib.suppress(BadConfig):  # a frame that cannot be read is reported when it is labelled
                pixels, segmenter, _ = self.undistorted(frame, frame.read())
                surest = self.labeller.surest(to_metres(pixels, frame.step_m), segmenter.camera)
                judged += [surest] if surest.max() >= _PERSON else []
        return np.mean(judged, axis=0) if judged else np.zeros(4)

    def prepare(self) -> None:
        """Load the compiled loops and label usual views, so that the first frame takes no longer than others."""
        self.labeller.of(self.cameras.first.camera, self._auto)[1].prepare()

    def labelled(self, at_once: int = 1, stamps: bool = False) -> Generator[LabelledFrame, None, None]:
        """Label the frames in order, without those that are skipped, as the numbers of the answers tell.

        at_once: as of `FrameLabeller.stream`; another thread then reads recordings. stamps: read the headers of frames'
        messages, too. Video is carried along within each input. Raises BadConfig, naming the frame.
        """
        at_once = 1 if self.labeller.video else at_once
        if at_once != 1:  # threads that load a loop together take PyTorch's form of it at first, with other last bits
            self.prepare()
        with contextlib.closing(side_by_side(self._jobs(stamps), at_once)) as answers:
            yield from (answer for answer in answers if answer is not None)

    def _jobs(self, stamps: bool) -> Iterator[Callable[[], LabelledFrame | None]]:
        for number, frame in enumerate(self.frames):
            if number == 0 or frame.sequence != self.frames[number - 1].sequence:
                self.labeller.restart(numbers=number == 0)  # no person gets the number of one in another input
            yield self._read(number, self._skipping.read, stamps=stamps) or (lambda: None)

    def label(self, number: int) -> LabelledFrame:
        """Label one frame, as the first of a video; a negative number counts from the end. Raises BadConfig, naming the
        frame, also if it cannot be read; IndexError beyond the frames.

        A camera's first frame is labelled after its segmenter is prepared, so that its times are as others'.
        """
        number = range(len(self))[number]
        label = cast(Labelling, self._read(number, Frame.read, prepare=True))  # `Frame.read` skips none
        self.labeller.restart()
        return label()

    def undistorted(self, frame: Frame, pixels: Pixels) -> tuple[Pixels, Segmenter, FrameCamera]:
        """A frame's pixels without distortion, the segmenter for them, and the camera. Raises BadConfig, naming it."""
        camera = self.cameras.of(frame, (pixels.shape[0], pixels.shape[1]))
        with reported(frame.where, BadConfig):
            lens, segmenter = self.labeller.of(camera.camera, self._auto)
            return pixels if lens is None else lens(pixels), segmenter, camera

    def _read(
        self, number: int, read: Callable[[Frame], Pixels | None], prepare: bool = False, stamps: bool = False
    ) -> Labelling | None:
        """Read a frame; None for one that cannot be read and is skipped."""
        watch, frame = Stopwatch((_READ,)), self.frames[number]
        with watch(_READ):
            pixels = read(frame)
            if pixels is None:
                return None
            pixels, segmenter, camera = self.undistorted(frame, pixels)
            range_m = to_metres(pixels, frame.step_m)
        if prepare:
            segmenter.prepare()
        return partial(
            _label,
            frame.where,
            segmenter,
            self.labeller.label_map,
            range_m,
            watch.milliseconds[_READ],
            number=number,
            frame=frame,
            stored=pixels,
            own_camera=None if camera is self.cameras.common else camera,
            stamp=frame.stamp() if stamps else None,
        )

    def to_json(self) -> dict[str, Any]:
        """The frames' camera and unit, and those that were skipped, as plain JSON."""
        steps_m = {str(frame.path): frame.step_m for frame in self.frames}
        one = len(set(steps_m.values())) == 1
        return {
            "camera": {
                **self.cameras.to_json(),
                "mirrored": self.labeller.mirrored,
                **({"turned_deg": self.turned_deg} if self.turned_deg else {}),
            },
            "unit_m": self.frames[0].step_m if one else steps_m,
            "skipped": self.skipped,
        }


def _label(
    where: str, segmenter: Segmenter, label_map: LabelMap, range_m: NDArray[np.float32], read_ms: float, **of_frame: Any
) -> LabelledFrame:
    """Label a frame. of_frame: other fields of the answer. Raises BadConfig, naming the frame."""
    with reported(where, BadConfig):
        answer = segmenter(range_m)
    if segmenter.label_map is not label_map:
        answer = answer.joined(label_map)
    fields = {**vars(answer), **of_frame, "milliseconds": {_READ: read_ms, **answer.milliseconds}}
    return LabelledFrame(**fields)


def side_by_side(jobs: Iterable[Callable[[], Item]], at_once: int) -> Generator[Item, None, None]:
    """Yield what jobs give, in their order. at_once: number of jobs that are done at a time, each in a thread, while
    another thread asks for the next; 1: each is done before the next is asked for.

    An error of a job is raised in its place, after the answers of all before it. Whoever leaves early waits for the
    jobs that are being done. Raises BadConfig for `at_once` below 1.
    """
    if check_int("at_once", at_once, 1) == 1:
        yield from (job() for job in jobs)
        return
    remaining, own = iter(jobs), (torch.get_num_threads(),)
    with (
        ThreadPoolExecutor(1, "reading") as reading,
        ThreadPoolExecutor(at_once, "labelling", torch.set_num_threads, own) as pool,
    ):

        def begun() -> Future[Any]:
            coming: Future[Any] = reading.submit(next, remaining, _END)
            return pool.submit(lambda: _END if (job := coming.result()) is _END else job())

        waiting = deque(begun() for _ in range(at_once))
        while (item := waiting.popleft().result()) is not _END:
            waiting.append(begun())
            yield item
