"""One interface to recordings: frames of a range sensor, read one at a time, with times, camera and unit."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_model.recordings.cameras import Intrinsics

MILLIMETRE: Final = 1e-3
"""Metres a step of whole numbers where neither recording nor caller says otherwise."""

FLOAT_STEP_M: Final = 2.5e-4
"""Step, metres, to which ranges in floating point are rounded: 65 534 of them reach 16.4 m."""

LARGEST_SIDE: Final = 4096
"""The most rows or columns of a frame."""

Pixels = NDArray[np.uint16]


@dataclass(frozen=True)
class Stamp:
    """Time of a message's header, nanoseconds, and the name of its coordinate frame."""

    time_ns: int
    frame_id: str


class Frame(Protocol):
    """One frame of a recording, which is read when `read` is called.

    name: of its result files, without suffix. where: its name in messages. path: the file or folder that holds it, and
    member: its name in there, None if it is a file of its own. sequence: number of the input that it is from. time_s:
    when it was recorded, seconds, None if that is not stored. step_m: metres a step. camera: stored with the recording,
    if any. path_id: short hash of its location.
    """

    @property
    def name(self) -> str: ...
    @property
    def where(self) -> str: ...
    @property
    def path(self) -> Path: ...
    @property
    def member(self) -> str | None: ...
    @property
    def sequence(self) -> int: ...
    @property
    def time_s(self) -> float | None: ...
    @property
    def step_m(self) -> float: ...
    @property
    def camera(self) -> Intrinsics | None: ...
    @property
    def path_id(self) -> str: ...

    def read(self) -> Pixels:
        """Read the frame's pixels, uint16 [H, W], in steps. Raises BadConfig, naming the frame."""

    def stamp(self) -> Stamp | None:
        """Read the header of the frame's message; None where frames are no messages. Raises BadConfig."""

    def placed(self, name: str, sequence: int) -> Frame:
        """Return the frame with another name, and as of another input."""


@dataclass(frozen=True)
class StoredRecording:
    """A recording on disk: the number of its frames is known, and any of them can be read first."""

    where: str
    frames: tuple[Frame, ...]
    camera: Intrinsics | None = None
    step_m: float = MILLIMETRE

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)

    def __len__(self) -> int:
        return len(self.frames)


class FrameSource(ABC):
    """Reader of the frames of one file by their numbers; a new one is a subclass."""

    @abstractmethod
    def read(self, index: int) -> NDArray[Any]:
        """Read the pixels of frame `index`, [H, W]: steps in uint16 or metres in floating point.

        Raises BadConfig without the frame's name.
        """

    def stamp(self, index: int) -> Stamp | None:
        """Read the header of frame `index`; by default frames have none. Raises BadConfig."""
        return None


@dataclass(frozen=True)
class StoredFrame:
    """Frame `index` of a file that holds many, which `source` reads; other fields as of `Frame`.

    member: None for the only frame of its file. part: the topic or array that frames are from. float_m: metres that
    1.0 is in floating point.
    """

    name: str
    where: str
    path: Path
    member: str | None
    source: FrameSource = field(repr=False)
    index: int
    time_s: float | None = None
    step_m: float = MILLIMETRE
    camera: Intrinsics | None = None
    float_m: float = 1.0
    part: str = ""
    sequence: int = 0

    @property
    def path_id(self) -> str:
        """Short hash of the frame's location on this machine: the same from any working directory."""
        return location_hash(self.path, self.part, self.index)

    def read(self) -> Pixels:
        """Read the frame's pixels, uint16 [H, W], in steps. Raises BadConfig, naming the frame."""
        try:
            return in_steps(self.source.read(self.index), self.float_m)
        except BadConfig as error:
            raise BadConfig(f"{self.where}: {error}") from error

    def stamp(self) -> Stamp | None:
        """Read the time and coordinate frame of its message; None where frames are no messages. Raises BadConfig."""
        try:
            return self.source.stamp(self.index)
        except BadConfig as error:
            raise BadConfig(f"{self.where}: {error}") from error

    def placed(self, name: str, sequence: int) -> StoredFrame:
        """Return the frame with another name, and as of another input."""
        return replace(self, name=name, sequence=sequence)


def location_hash(path: Path, *within: str | int) -> str:
    """Hash the location of a frame, 16 hexadecimal digits: its file from the root, and what says where it is in it."""
    location = "\0".join([str(path.resolve()), *map(str, within)])
    return hashlib.sha256(location.encode("utf-8", "surrogatepass")).hexdigest()[:16]


def evenly_apart(total: int, count: int) -> list[int]:
    """Return at most `count` of the numbers below `total`, ascending and evenly apart, 0 and the last among them."""
    chosen: list[int] = np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int)).tolist()
    return chosen


def in_steps(values: NDArray[Any], float_m: float = 1.0) -> Pixels:
    """Convert pixels to uint16 [H, W]: whole numbers as they are, floating point rounded to `FLOAT_STEP_M`.

    float_m: metres that 1.0 is. What is not finite, not above 0, or beyond the last step becomes 0, nothing measured.
    Raises BadConfig for another type or shape.
    """
    if values.ndim != 2 or not all(1 <= side <= LARGEST_SIDE for side in values.shape):
        shape = " x ".join(map(str, values.shape)) or "a single number"
        raise BadConfig(f"a frame must have rows and columns, 1 to {LARGEST_SIDE} of each, found {shape}")
    if values.dtype.kind == "f":
        metres = values.astype(np.float32) if values.dtype.itemsize < 4 else values
        with np.errstate(over="ignore", invalid="ignore"):
            steps = np.rint(metres * (float_m / FLOAT_STEP_M))
            return np.where((steps > 0) & (steps < 65535), steps, 0).astype(np.uint16)
    if values.dtype.kind == "u" and values.dtype.itemsize == 2:
        return values.astype(np.uint16)
    raise BadConfig(f"a frame must be of uint16, steps, or of floating point, metres, found {values.dtype}")


def stored_recording(
    path: Path,
    source: FrameSource,
    times_s: Sequence[float | None],
    floating: bool,
    given_step_m: float | None = None,
    own_step_m: float | None = None,
    camera: Intrinsics | None = None,
    part: str = "",
) -> StoredRecording:
    """List the frames of a file that holds many: one for each of `times_s`.

    floating: frames are of floating point. given_step_m: metres a step, or that 1.0 is, as the caller says; own_step_m:
    as the recording says. Raises BadConfig for no frame.
    """
    label = f"{path}: {part}" if part else str(path)
    if not times_s:
        raise BadConfig(f"a recording must hold frames, found none in {label}")
    step_m = FLOAT_STEP_M if floating else given_step_m or own_step_m or MILLIMETRE
    several = len(times_s) > 1
    digits = max(4, len(str(len(times_s) - 1)))
    frames = tuple(
        StoredFrame(
            f"{index:0{digits}d}" if several else path.stem,
            f"{label}, frame {index}" if several else label,
            path,
            f"{index:0{digits}d}" if several else None,
            source,
            index,
            time_s,
            step_m,
            camera,
            given_step_m or 1.0,
            part,
        )
        for index, time_s in enumerate(times_s)
    )
    return StoredRecording(label, frames, camera, step_m)
