"""One interface to recordings: frames of a range sensor, read one at a time, with times, camera and unit."""

import hashlib
import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import RLock
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, Checked, bounded, reported
from bodyseg_model.recordings.cameras import Intrinsics

MILLIMETRE: Final = 1e-3
"""Metres a step of whole numbers where neither recording nor caller says otherwise."""

FLOAT_STEP_M: Final = 2.5e-4
"""Step, metres, to which ranges in floating point are rounded: 65 534 of them reach 16.4 m."""

LARGEST_SIDE: Final = 4096
"""The most rows or columns of a frame."""

MOST_FRAMES: Final = 1 << 20  # of one file: ten hours at 30 a second

_MOST_STEPS: Final = 65535
_AS_METRES: Final = "a sensor's whole numbers times its unit, 0.001 m for most, are metres"
_FARTHEST_M: Final = 100.0  # no range camera sees its nearest surface there

Pixels = NDArray[np.uint16]

Timed = NDArray[Any] | tuple[float | None, NDArray[Any]]
"""Pixels of a frame [H, W], or its time in seconds and its pixels."""


@dataclass(frozen=True)
class Stamp:
    """Time of a message's header, nanoseconds, and the name of its coordinate frame."""

    time_ns: int
    frame_id: str


class FrameSource(ABC):
    """Reader of the frames of one file by their numbers; a new one is a subclass.

    one_at_a_time: held by readers that keep files open, or pieces of them, from frame to frame: threads share a reader.
    """

    opened: ClassVar = True
    one_at_a_time: ClassVar = RLock()

    @abstractmethod
    def read(self, index: int) -> NDArray[Any]:
        """Read frame `index`, [H, W]: steps in uint16 or metres in floating point. Raises BadConfig without a name."""

    def stamp(self, index: int) -> Stamp | None:
        """Read the header of frame `index`; by default frames have none. Raises BadConfig."""
        return None


# No process is forked while a thread reads: the lock would never be free in the child.
_free = FrameSource.one_at_a_time.release
os.register_at_fork(before=FrameSource.one_at_a_time.acquire, after_in_parent=_free, after_in_child=_free)


@dataclass(frozen=True)
class Unopened(FrameSource):
    """Stands for a recording that cannot be opened. why: what was wrong with it."""

    why: str
    opened = False

    def read(self, index: int) -> NDArray[Any]:
        raise BadConfig(self.why)


class ArrayFrames(FrameSource):
    """Frames [N, H, W] in memory, or of a file that is mapped into it."""

    def __init__(self, frames: NDArray[Any]) -> None:
        self._frames = frames

    def read(self, index: int) -> NDArray[Any]:
        return np.array(self._frames[index])


@dataclass(frozen=True)
class Frame:
    """One frame of a recording: frame `index` of what `source` reads; it is read when `read` is called.

    name: of its result files, without suffix; it may name a folder for them ("left/1"). where: its name in messages.
    path: the file or folder that holds it, and member: its name in there, None if it is a file of its own. within: what
    says where it is in the file, for `path_id`.
    time_s: when it was recorded, seconds, None if that is not stored. camera: stored with the recording, if any.
    step_m: metres a step. float_m: metres that 1.0 is in floating point.
    sequence: number of the input that it is from, or of the part of a folder of recordings; single files are input 0.
    Frames of other sequences were not taken directly before or after it. no_camera: why a stored camera is of no use.
    """

    name: str
    where: str
    path: Path
    member: str | None
    source: FrameSource = field(repr=False)
    within: tuple[str | int, ...]
    index: int = 0
    time_s: float | None = None
    step_m: float = MILLIMETRE
    camera: Intrinsics | None = None
    float_m: float = 1.0
    sequence: int = 0
    no_camera: str = ""

    @property
    def path_id(self) -> str:
        """Short hash of the frame's location on this machine, 16 hexadecimal digits: the same from any folder."""
        location = "\0".join([str(self.path.resolve()), *map(str, self.within)])
        return hashlib.sha256(location.encode("utf-8", "surrogatepass")).hexdigest()[:16]

    def read(self) -> Pixels:
        """Read the frame's pixels, uint16 [H, W], in steps. Raises BadConfig, naming the frame."""
        with reported(self.where, BadConfig):
            return in_steps(self.source.read(self.index), self.float_m)

    def stamp(self) -> Stamp | None:
        """Read the time and coordinate frame of its message; None where frames are no messages. Raises BadConfig."""
        with reported(self.where, BadConfig):
            return self.source.stamp(self.index)


@dataclass(frozen=True, eq=False)
class LiveRecording(Checked):
    """Frames of a live sensor, of arrays as they come; for `FrameLabeller`. A frame lives while a caller holds it.

    arrays: pixels [H, W], or (time in seconds or None, pixels): uint16 in steps of `step_m` metres, or floating point
    in metres; masked pixels are 0. camera: that of the frames, if known. where: name in messages and of frames. Raises
    BadConfig for a step that is not above 0, and on the way for an array of 8 bits, in millimetres.
    """

    arrays: Iterable[Timed]
    camera: Intrinsics | None = None
    step_m: float = bounded(MILLIMETRE, 0, above=True)
    where: str = "live"

    def __iter__(self) -> Iterator[Frame]:
        for index, item in enumerate(self.arrays):
            name = f"{self.where}-{index:06d}"
            with reported(f"{name} must be an array or a tuple (seconds, array)", BadConfig, ValueError, TypeError):
                time_s, pixels = item if isinstance(item, tuple) else (None, item)
                time_s = None if time_s is None else float(time_s)  # no image, as of a pair of range and infrared
                # A copy: drivers write the next frame into the same array.
                pixels = np.array(np.ma.filled(np.asanyarray(pixels), 0))
            step_m = FLOAT_STEP_M if pixels.dtype.kind == "f" else self.step_m
            if pixels.dtype.itemsize == 1 and step_m == MILLIMETRE:
                raise BadConfig(f"{name}: of 8 bits, most images are pictures: step_m must say what a step is")
            held, within = ArrayFrames(pixels[np.newaxis]), ("", index)
            yield Frame(name, name, Path(self.where), str(index), held, within, 0, time_s, step_m, self.camera)


def evenly_apart(total: int, count: int) -> list[int]:
    """Return at most `count` of the numbers below `total`, ascending and evenly apart, 0 and the last among them."""
    chosen: list[int] = np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int)).tolist()
    return chosen


def check_pixels(shape: tuple[int, ...], kind: np.dtype[Any]) -> None:
    """Raise BadConfig unless an array of a frame has rows and columns, and holds steps or metres."""
    if len(shape) != 2 or not all(1 <= side <= LARGEST_SIDE for side in shape):
        found = " x ".join(map(str, shape)) or "one number"
        raise BadConfig(f"a frame must have rows and columns, 1 to {LARGEST_SIDE} of each, found {found}")
    if kind.kind not in "fui":
        raise BadConfig(f"a frame must be of whole numbers, steps, or of floating point, metres, found {kind}")


def in_steps(values: NDArray[Any], float_m: float = 1.0) -> Pixels:
    """Convert pixels to uint16 [H, W]: whole numbers as they are, floating point rounded to `FLOAT_STEP_M`.

    float_m: metres that 1.0 is. Floating point not finite or beyond the last step, and what is not above 0, becomes 0,
    nothing measured. Raises BadConfig for another type or shape, whole numbers beyond 16 bits, and as `check_metres`.
    """
    check_pixels(values.shape, values.dtype)
    if values.dtype.kind == "f":
        metres = values.astype(np.float32) if values.dtype.itemsize < 4 else values
        with np.errstate(over="ignore", invalid="ignore"):
            check_metres(metres, float_m)
            steps = np.rint(metres * (float_m / FLOAT_STEP_M))
            return np.where((steps > 0) & (steps < _MOST_STEPS), steps, 0).astype(np.uint16, "C")
    if values.dtype.itemsize > 2 and values.size and values.max() > _MOST_STEPS:
        raise BadConfig(f"steps must be at most {_MOST_STEPS}, found {values.max()} in an array of {values.dtype}")
    if values.dtype.kind == "i":
        values = np.maximum(values, 0)
    return values.astype(np.uint16, "C")


def check_metres(values: NDArray[Any], float_m: float = 1.0) -> None:
    """Raise BadConfig for whole numbers [H, W], which are a sensor's steps, and where nothing measured is nearer than
    `_FARTHEST_M`, as in millimetres, but for one value, as of a sky. float_m: metres that 1.0 is.
    """
    if values.dtype.kind != "f":
        raise BadConfig(f"a frame must be of floating point, metres, found {values.dtype}: {_AS_METRES}")
    few = values[:: len(values) // 64 + 1] * float_m
    nearest_m = np.min(few, initial=np.inf, where=few > 0)
    if _FARTHEST_M <= nearest_m < np.max(few, initial=0.0, where=few < np.inf):
        found = f"nothing nearer than {nearest_m:.0f}: a file may have other --units, and {_AS_METRES}"
        raise BadConfig(f"a frame must be in metres, found {found}")


def stored_recording(
    path: Path,
    source: FrameSource,
    times_s: Sequence[float | None] | int,
    floating: bool,
    given_step_m: float | None = None,
    own_step_m: float | None = None,
    camera: Intrinsics | None = None,
    part: str = "",
    no_camera: str = "",
) -> tuple[Frame, ...]:
    """List the frames of a file that holds many: one for each of `times_s`, or so many without times.

    floating: frames are of floating point. given_step_m: metres a step, or that 1.0 is, as the caller says; own_step_m:
    as the recording says. Raises BadConfig for no frame, or more than `MOST_FRAMES`.
    """
    label = f"{path}: {part}" if part else str(path)
    count = times_s if isinstance(times_s, int) else len(times_s)
    if not 0 < count <= MOST_FRAMES:
        raise BadConfig(f"a recording must hold 1 to {MOST_FRAMES} frames, found {count or 'none'} in {label}")
    times_s = [None] * count if isinstance(times_s, int) else times_s
    step_m = FLOAT_STEP_M if floating else given_step_m or own_step_m or MILLIMETRE
    several = count > 1
    digits = max(4, len(str(count - 1)))
    return tuple(
        Frame(
            f"{index:0{digits}d}" if several else path.stem,
            f"{label}, frame {index}" if several else label,
            path,
            f"{index:0{digits}d}" if several else None,
            source,
            (part, index),
            index,
            time_s,
            step_m,
            camera,
            given_step_m or 1.0,
            no_camera=no_camera,
        )
        for index, time_s in enumerate(times_s)
    )
