"""Recordings in NumPy's files: H x W or N x H x W in an NPY file, or arrays of an NPZ file.

A last side of 1 may follow either, and N x 1 x H x W is read, too. One of 2 to 4 is colours, which are refused.
"""

from __future__ import annotations

import math
import os
import re
import zipfile
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, reported
from bodyseg_data.files import natural_key
from bodyseg_model.recordings.recording import ArrayFrames, Frame, FrameSource, check_pixels, stored_recording

_LONGEST_HEADER: Final = 10_000
_TIMES: Final = ("times", "time", "timestamps")
_MOST_TIMES: Final = 1 << 24
_LARGEST_STACK: Final = 1 << 30
_MOST_PACKED: Final = 1100  # bytes that deflate can unpack from one
_RANGES: Final = re.compile(r"depth|(?<![a-z])(z|range|ranges|distance)(?![a-z])")
_BESIDE: Final = re.compile(
    r"conf|mask|valid|std|sigma|noise|var|err|rgb|col|time|amp|ir(?![a-z])|infra|intens|label|vis"
)


def open_npy(path: Path, topic: str | None, step_m: float | None) -> tuple[Frame, ...]:
    """Open H x W or N x H x W of whole numbers, steps, or floating point, metres (step_m: metres that 1.0 is).

    The file is mapped into memory, and only the pages of a frame are read. Raises BadConfig.
    """
    if topic is not None:
        raise BadConfig(f"--topic is for recordings that hold several, found an NPY file: {path}")
    with reported(f"{path} must be a whole NPY file of numbers", BadConfig, Exception):  # whatever the parser raises
        values = np.lib.format.open_memmap(path, mode="r", max_header_size=_LONGEST_HEADER)
    shape = _check(values.shape, values.dtype, str(path), step_m)
    frames = values.reshape(shape) if len(shape) == 3 else values.reshape(1, *shape)
    return stored_recording(path, _Mapped(path, frames), len(frames), values.dtype.kind == "f", step_m)


class _Mapped(ArrayFrames):
    """Frames of a file that is mapped into memory: reading behind its end, if it shrinks, would end the process."""

    def __init__(self, path: Path, frames: NDArray[Any]) -> None:
        super().__init__(frames)
        self._path, self._size = path, path.stat().st_size

    def read(self, index: int) -> NDArray[Any]:
        with reported("the file cannot be read", BadConfig, OSError):
            size = self._path.stat().st_size
        if size < self._size:
            raise BadConfig(f"the file must still have the {self._size} bytes it had, found {size}")
        return super().read(index)


def open_npz(path: Path, topic: str | None, step_m: float | None) -> tuple[Frame, ...]:
    """Open an NPZ file whose frames are N x H x W of one array, or arrays of H x W in natural order of their names.

    An array `times`, `time` or `timestamps` holds N times in seconds. topic: the array, or the name of arrays that
    differ in their numbers alone, where there are several; None takes the only one that is called depth or the like.
    Arrays are decompressed as far as the frame that is asked for. Raises BadConfig.
    """
    # A damaged zip raises what zipfile, zlib, lzma and NumPy like.
    with reported(path, BadConfig), BadConfig.named("must be a whole NPZ file"), zipfile.ZipFile(path) as archive:
        found = (_described(archive, member, path) for member in archive.infolist())
        arrays = [array for array in found if array is not None]
        times = next((_times(archive, array) for array in arrays if array.title in _TIMES), None)
    images = [array for array in arrays if array.shaped and array.title not in _TIMES]
    families: dict[str, list[_Array]] = {}
    for array in sorted(images, key=lambda array: natural_key(array.title)):
        families.setdefault(array.title if len(array.sides) == 3 else array.family, []).append(array)
    chosen = _chosen(families, images, topic, path)
    for array in chosen:
        _check(array.shape, array.kind, f"{path}, {array.title!r}", step_m)
    if len({array.kind.kind for array in chosen}) > 1:
        raise BadConfig(f"arrays of frames must all be whole numbers or all floating point, found both in {path}")
    each = ((array, number) for array in chosen for number in range(array.count))
    locations = list(islice(each, 1 << 21))  # more than a recording may hold
    if times is not None and len(times) != len(locations):
        raise BadConfig(f"times must be as many as frames, found {len(times)} for {len(locations)} in {path}")
    floating = bool(chosen) and chosen[0].kind.kind == "f"
    frames = _Zipped(path, locations)
    return stored_recording(path, frames, times or len(locations), floating, step_m, part=topic or "")


def _chosen(families: dict[str, list[_Array]], images: list[_Array], topic: str | None, path: Path) -> list[_Array]:
    """The arrays that hold the frames: those of one name. Raises BadConfig, listing names, for several or none."""
    if topic is not None:
        chosen = [array for array in images if array.title == topic] or families.get(topic, [])
        if not chosen:
            found = ", ".join(dict.fromkeys([array.title for array in images] + [*families])) or "none"
            raise BadConfig(f"--topic must be an array of images, one of {found}, found {topic!r}: {path}")
        return chosen
    names = [name for name, arrays in families.items() if len(arrays[0].sides) == 3] or [*families]
    likely = [name for name in names if _RANGES.search(name.lower()) and not _BESIDE.search(name.lower())]
    names = likely if len(likely) == 1 else names
    if len(names) > 1:
        raise BadConfig(f"several arrays hold frames, choose one by --topic: {', '.join(names)} ({path})")
    return families[names[0]] if names else []


@dataclass(frozen=True)
class _Array:
    """An array in a zip: its numbers begin at byte `start` of its file. columns_first: True for Fortran's order."""

    member: zipfile.ZipInfo
    shape: tuple[int, ...]
    kind: np.dtype[Any]
    start: int
    columns_first: bool = False

    @property
    def title(self) -> str:
        return self.member.filename.removesuffix(".npy")

    @property
    def family(self) -> str:
        """The name without its numbers, which count frames."""
        return re.sub(r"[\W_]*[0-9]+", "", self.title) or "frames"

    @property
    def sides(self) -> tuple[int, ...]:
        """The shape without a channel of 1."""
        return without_channel(self.shape)

    @property
    def shaped(self) -> bool:
        """True for the shape of one frame or several; False for masks, and for small matrices, as of a camera."""
        return len(self.sides) in (2, 3) and min(self.sides[-2:]) > 4 and self.kind.kind != "b"

    @property
    def count(self) -> int:
        return self.sides[0] if len(self.sides) == 3 else 1


class _Zipped(FrameSource):
    """Frames of arrays in a zip. The array that was read last stays open, so that neighbours are read in one pass."""

    def __init__(self, path: Path, locations: list[tuple[_Array, int]]) -> None:
        self._path, self._locations, self._process = path, locations, os.getpid()
        self._archive: zipfile.ZipFile | None = None
        self._held: tuple[_Array, IO[bytes]] | None = None
        self._whole: tuple[_Array, NDArray[Any]] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_archive": None, "_held": None, "_whole": None}  # another process opens it itself

    def __del__(self) -> None:
        self._close()

    def _close(self) -> None:
        """Close what is open; it is opened again where it is needed."""
        if self._held is not None:
            self._held[1].close()
        if self._archive is not None:
            self._archive.close()
        self._held = self._archive = None

    def read(self, index: int) -> NDArray[Any]:
        array, number = self._locations[index]
        size = array.sides[-2] * array.sides[-1] * array.kind.itemsize
        with self.one_at_a_time:
            if self._process != os.getpid():  # a fork's file would move on with its parent's
                self._close()
                self._process = os.getpid()
            try:
                if array.columns_first:
                    found: NDArray[Any] = self._stack(array)[number]
                    return found
                data = self._opened(array, array.start + number * size).read(size)
            except Exception as error:  # as above
                self._close()
                raise BadConfig(f"the array {array.title!r} must be whole: {error}") from error
        if len(data) != size:
            raise BadConfig(f"the array {array.title!r} must be whole, found {len(data)} of {size} bytes")
        return np.frombuffer(data, array.kind).reshape(array.sides[-2:])

    def _opened(self, array: _Array, offset: int) -> IO[bytes]:
        """The file of an array, at byte `offset`; the zip's list of files is read once."""
        if self._archive is None:
            self._archive = zipfile.ZipFile(self._path)
        if self._held is None or self._held[0] is not array:
            if self._held is not None:
                self._held[1].close()
            self._held = array, self._archive.open(array.member)
        self._held[1].seek(offset)
        return self._held[1]

    def _stack(self, array: _Array) -> NDArray[Any]:
        """All frames [N, H, W] of an array in Fortran's order, where frames alternate; the last array is kept."""
        if self._whole is None or self._whole[0] is not array:
            self._whole = None
            values = np.lib.format.read_array(self._opened(array, 0), max_header_size=_LONGEST_HEADER)
            self._whole = array, values.reshape(array.count, *array.sides[-2:])
        return self._whole[1]


def _described(archive: zipfile.ZipFile, member: zipfile.ZipInfo, path: Path) -> _Array | None:
    """Read the header of an array in the zip at `path`; None for another file. Raises ValueError, BadConfig."""
    if not member.filename.endswith(".npy"):
        return None
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, columns_first, kind = read(file, max_header_size=_LONGEST_HEADER)
        start = file.tell()
    declared = kind.itemsize * math.prod(shape)
    if min(shape, default=0) < 0 or start + declared > min(member.file_size, _MOST_PACKED * path.stat().st_size):
        found = f"{' x '.join(map(str, shape))} of {kind}, in {member.compress_size} bytes"
        raise BadConfig(f"an array must have the bytes that it declares, found {found}: {member.filename!r}")
    if columns_first and declared > _LARGEST_STACK:
        raise BadConfig(f"an array this large must have rows first (C order), found {member.filename!r}")
    return _Array(member, shape, kind, start, columns_first and len(shape) > 1)


def _times(archive: zipfile.ZipFile, array: _Array) -> list[float]:
    if len(array.shape) != 1 or array.kind.kind not in "fiu" or array.shape[0] > _MOST_TIMES:
        raise BadConfig(f"{array.title!r} must hold one time a frame, seconds")
    with archive.open(array.member) as file:
        file.seek(array.start)
        data = file.read(array.shape[0] * array.kind.itemsize)
    times = [float(time) for time in np.frombuffer(data, array.kind, array.shape[0])]
    for time in times:
        if not abs(time) < 1 << 31:  # as the time of a message
            raise BadConfig(f"{array.title!r} must hold seconds, found {time:g}: are they milli- or nanoseconds?")
    return times


def without_channel(shape: tuple[int, ...]) -> tuple[int, ...]:
    """A shape without a side of 1 that is the channel: behind rows and columns, or before them in N x 1 x H x W."""
    if len(shape) == 4 and shape[1] == 1:
        return shape[0], *shape[2:]
    return shape[:-1] if len(shape) in (3, 4) and shape[-1] == 1 else shape


def _check(shape: tuple[int, ...], kind: np.dtype[Any], where: str, step_m: float | None) -> tuple[int, ...]:
    """Return the shape of a frame or, along the first axis, several. Raises BadConfig for another shape or type."""
    sides = without_channel(shape)
    if kind == np.uint8 and step_m is None:
        raise BadConfig(f"{where}: of 8 bits, most images are pictures: say by --units what a step is, found {kind}")
    if len(sides) == 3 and 1 < sides[-1] <= 4 < sides[1]:
        raise BadConfig(
            f"{where}: frames must be H x W or N x H x W, found {' x '.join(map(str, shape))}: is the last side "
            "colours?"
        )
    with reported(where, BadConfig):
        check_pixels(sides[1:] if len(sides) == 3 else sides, kind)
    return sides
