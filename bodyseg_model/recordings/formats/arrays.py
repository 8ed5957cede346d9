"""Recordings in NumPy's files: H x W or N x H x W in an NPY file, or arrays of an NPZ file."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_model.recordings.frames import natural_key
from bodyseg_model.recordings.recording import ArrayFrames, Frame, FrameSource, check_pixels, stored_recording

_LONGEST_HEADER: Final = 10_000
_TIMES: Final = ("times", "time", "timestamps")
_MOST_TIMES: Final = 1 << 24


def open_npy(path: Path, topic: str | None, step_m: float | None) -> tuple[Frame, ...]:
    """Open H x W or N x H x W of uint16, steps, or floating point, metres (step_m: metres that 1.0 is).

    The file is mapped into memory, and only the pages of a frame are read. Raises BadConfig.
    """
    if topic is not None:
        raise BadConfig(f"--topic is for recordings that hold several, found an NPY file: {path}")
    try:
        values = np.lib.format.open_memmap(path, mode="r", max_header_size=_LONGEST_HEADER)
    except Exception as error:  # a damaged header raises what the parser of Python likes
        raise BadConfig(f"{path} must be a whole NPY file of numbers: {error}") from error
    _check(values.shape, values.dtype, str(path))
    frames = values if values.ndim == 3 else values[np.newaxis]
    return stored_recording(path, ArrayFrames(frames), [None] * len(frames), values.dtype.kind == "f", step_m)


def open_npz(path: Path, topic: str | None, step_m: float | None) -> tuple[Frame, ...]:
    """Open an NPZ file whose frames are N x H x W of one array, or arrays of H x W in natural order of their names.

    An array `times`, `time` or `timestamps` holds N times in seconds. topic: the array, where there are several.
    Arrays are decompressed as far as the frame that is asked for. Raises BadConfig.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            arrays = [array for name in archive.namelist() if (array := _described(archive, name)) is not None]
            times = next((_times(archive, array) for array in arrays if array.title in _TIMES), None)
    except BadConfig:
        raise
    except Exception as error:  # a damaged zip raises what zipfile, zlib, lzma and NumPy like
        raise BadConfig(f"{path} must be a whole NPZ file: {error}") from error
    images = [array for array in arrays if array.shaped and array.title not in _TIMES]
    stacks = [array for array in images if len(array.shape) == 3]
    if topic is not None:
        chosen = [array for array in images if array.title == topic]
        if not chosen:
            found = ", ".join(array.title for array in images) or "none"
            raise BadConfig(f"--topic must be an array of images, one of {found}, found {topic!r}: {path}")
    elif len(stacks) > 1:
        names = ", ".join(array.title for array in stacks)
        raise BadConfig(f"several arrays hold frames, choose one by --topic: {names} ({path})")
    else:
        chosen = stacks or sorted(images, key=lambda array: natural_key(array.title))
    for array in chosen:
        _check(array.shape, array.kind, f"{path}, {array.title!r}")
    if len({array.kind.kind for array in chosen}) > 1:
        raise BadConfig(f"arrays of frames must all be whole numbers or all floating point, found both in {path}")
    locations = [(array, number) for array in chosen for number in range(array.count)]
    if times is not None and len(times) != len(locations):
        raise BadConfig(f"times must be as many as frames, found {len(times)} for {len(locations)} in {path}")
    floating = bool(chosen) and chosen[0].kind.kind == "f"
    part = topic or ""
    return stored_recording(
        path, _Zipped(path, locations), times or [None] * len(locations), floating, step_m, part=part
    )


@dataclass(frozen=True)
class _Array:
    """An array in a zip, by its header, which ends at byte `start`."""

    member: str
    shape: tuple[int, ...]
    kind: np.dtype[Any]
    start: int

    @property
    def title(self) -> str:
        return self.member.removesuffix(".npy")

    @property
    def shaped(self) -> bool:
        """True for the shape of a frame or of several: small matrices, as of a camera, are none."""
        return len(self.shape) in (2, 3) and min(self.shape[-2:]) > 4

    @property
    def count(self) -> int:
        return self.shape[0] if len(self.shape) == 3 else 1


class _Zipped(FrameSource):
    """Frames of arrays in a zip; the array that was read last stays open, so that neighbours are read in one pass."""

    def __init__(self, path: Path, locations: list[tuple[_Array, int]]) -> None:
        self._path, self._locations = path, locations
        self._member = ""
        self._file: IO[bytes] | None = None

    def __del__(self) -> None:
        self._close()

    def read(self, index: int) -> NDArray[Any]:
        array, number = self._locations[index]
        size = array.shape[-2] * array.shape[-1] * array.kind.itemsize
        try:
            if self._file is None or self._member != array.member:
                self._close()
                with zipfile.ZipFile(self._path) as archive:
                    self._member, self._file = array.member, archive.open(array.member)
            self._file.seek(array.start + number * size)
            data = self._file.read(size)
        except Exception as error:  # as above
            self._close()
            raise BadConfig(f"the array {array.title!r} must be whole: {error}") from error
        if len(data) != size:
            raise BadConfig(f"the array {array.title!r} must be whole, found {len(data)} of {size} bytes")
        return np.frombuffer(data, array.kind).reshape(array.shape[-2:])

    def _close(self) -> None:
        if self._file is not None:
            self._file.close()
        self._file = None


def _described(archive: zipfile.ZipFile, member: str) -> _Array | None:
    """Read the header of an array; None for another file. Raises ValueError."""
    if not member.endswith(".npy"):
        return None
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, columns_first, kind = read(file, max_header_size=_LONGEST_HEADER)
        start = file.tell()
    if columns_first and len(shape) > 1:
        raise BadConfig(f"arrays must have rows first (C order), found {member!r} in {archive.filename}")
    return _Array(member, shape, kind, start)


def _times(archive: zipfile.ZipFile, array: _Array) -> list[float]:
    if len(array.shape) != 1 or array.kind.kind not in "fiu" or array.shape[0] > _MOST_TIMES:
        raise BadConfig(f"{array.title!r} must hold one time a frame, seconds, in {archive.filename}")
    with archive.open(array.member) as file:
        file.seek(array.start)
        data = file.read(array.shape[0] * array.kind.itemsize)
    return [float(time) for time in np.frombuffer(data, array.kind, array.shape[0])]


def _check(shape: tuple[int, ...], kind: np.dtype[Any], where: str) -> None:
    """Raise BadConfig unless an array holds a frame or, along its first axis, several."""
    try:
        check_pixels(shape[1:] if len(shape) == 3 else shape, kind)
    except BadConfig as error:
        raise BadConfig(f"{where}: {error}") from error
