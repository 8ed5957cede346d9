"""Frames of a range sensor: 16-bit grey PNGs in files, folders or tars; tars are read in place."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.files import refuse_special
from bodyseg_model.recordings.frame_names import result_names
from bodyseg_model.recordings.frame_png import parse_frame
from bodyseg_model.recordings.frame_tars import Member, list_tar

_LARGEST_FILE: Final = 1 << 28
_UNIT: Final = re.compile(r"([0-9]+(?:\.[0-9]+)?|\.[0-9]+)? ?(mm|cm|m)")
_METRES: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_STEPS_M: Final = (1e-6, 0.1)
_SATURATED: Final = 65535


@dataclass(frozen=True)
class FrameFile:
    """Location of one frame: `size` bytes from `offset` of the file at `path`, which is a PNG or a tar.

    name: of its result files, without suffix; it may name a folder for them ("left/1"). where: its name in messages.
    member: its name in the tar, None for a PNG. sequence: number of the input that it is from; single files are
    input 0. Frames of other inputs were not taken directly before or after it.
    """

    name: str
    where: str
    path: Path
    offset: int
    size: int
    member: str | None = None
    sequence: int = 0

    @property
    def path_id(self) -> str:
        """Short hash of the frame's place on this machine: the same from any working directory."""
        return hashlib.sha256(f"{self.path.resolve()}\0{self.member or ''}".encode()).hexdigest()[:16]

    def read(self) -> NDArray[np.uint16]:
        """Read the frame's pixels, uint16 [H, W], in the sensor's steps. Raises BadConfig, naming the frame."""
        return parse_frame(self.read_bytes(), self.where)

    def read_bytes(self) -> bytes:
        """Read the frame's bytes. Raises BadConfig, naming the frame."""
        try:
            with self.path.open("rb") as file:
                file.seek(self.offset)
                data = file.read(self.size)
        except OSError as error:
            raise BadConfig(f"cannot read {self.where}: {error.strerror or error}") from error
        if len(data) != self.size:
            raise BadConfig(f"{self.where} must still have the {self.size} bytes it had, found {len(data)}")
        return data


def find_frames(paths: Sequence[Path]) -> list[FrameFile]:
    """List the frames at `paths`: PNG files, folders of PNGs and tars (.tar) of PNGs.

    Single files come first, then folders and tars one after another; each is in natural order (2 before 10). In folders
    and tars, hidden files and names that do not end in .png are skipped. A frame is named after its file; where two
    frames would have one name, all are named with their folders or tars (`result_names`). Raises BadConfig for a path
    that cannot be read or contains no frame, a name unfit for a result file, or one frame given twice.
    """
    files = [path for path in paths if not path.is_dir() and path.suffix.lower() != ".tar"]
    groups = [[_file(path) for path in files]]
    groups += [_folder(path) if path.is_dir() else _tar(path) for path in paths if path not in files]
    frames = [
        replace(frame, sequence=number)
        for number, group in enumerate(groups)
        for frame in sorted(group, key=lambda frame: _natural(frame.name))
    ]
    names = result_names([(frame.path, frame.member, frame.where) for frame in frames])
    return [replace(frame, name=name) for frame, name in zip(frames, names, strict=True)]


def metres_a_step(unit: str) -> float:
    """Parse the size of one step of a frame, metres, from text like "mm", "0.1mm" or "1 cm". Raises BadConfig."""
    match = _UNIT.fullmatch(unit)
    step = float(match[1] or 1) * _METRES[match[2]] if match else 0.0
    if not _STEPS_M[0] <= step <= _STEPS_M[1]:
        raise BadConfig(f"a unit must be a length from 0.001mm to 10cm, such as mm or 0.1mm, found {unit!r}")
    return step


def to_metres(frame: NDArray[np.uint16], step_m: float) -> NDArray[np.float32]:
    """Convert to metres, float32 [H, W]; 0 (nothing measured) where the frame is 0 or 65535 (saturated)."""
    ranges = frame.astype(np.float32) * np.float32(step_m)
    ranges[frame == _SATURATED] = 0
    return ranges


def _file(path: Path) -> FrameFile:
    try:
        refuse_special(path)
        size = path.stat().st_size
    except OSError as error:
        raise BadConfig(f"cannot read {path}: {error.strerror or error}") from error
    return _checked(FrameFile(path.stem, str(path), path, 0, size))


def _folder(path: Path) -> list[FrameFile]:
    try:
        files = [file for file in path.iterdir() if _is_frame(file.name) and not file.is_dir()]
    except OSError as error:
        raise BadConfig(f"cannot read {path}: {error.strerror or error}") from error
    if not files:
        raise BadConfig(f"a folder of frames must hold .png files, found none in {path}")
    return [_file(file) for file in files]


def _tar(path: Path) -> list[FrameFile]:
    members = [member for member in list_tar(path) if _is_frame(PurePosixPath(member.name).name)]
    if not members:
        raise BadConfig(f"a tar of frames must hold .png files, found none in {path}")
    return [_member(path, member) for member in members]


def _member(path: Path, member: Member) -> FrameFile:
    where = f"{path}: {member.name}"
    if not member.plain:
        raise BadConfig(f"a frame in a tar must be a plain file, found a link or the like: {where}")
    # Only the last part of the name is used and the member is not extracted, so "../" in it does no harm.
    name = PurePosixPath(member.name).stem
    return _checked(FrameFile(name, where, path, member.offset, member.size, member.name))


def _checked(frame: FrameFile) -> FrameFile:
    if frame.size > _LARGEST_FILE:
        raise BadConfig(f"a frame must have at most {_LARGEST_FILE} bytes, found {frame.size} in {frame.where}")
    return frame


def _is_frame(name: str) -> bool:
    return name.lower().endswith(".png") and not name.startswith(".")


def _natural(name: str) -> list[tuple[int, str]]:
    """Sort key that orders numbers in names by value: digits without leading zeros sort by count, then themselves."""
    parts = re.split(r"([0-9]+)", name)
    key = []
    for text, digits in zip(parts[::2], [*parts[1::2], ""], strict=True):
        plain = digits.lstrip("0")
        key += [(0, text), (len(plain), plain)]
    return [*key, (0, name)]
