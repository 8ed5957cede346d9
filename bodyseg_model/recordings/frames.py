"""Frames of a range sensor at the paths of a command: PNGs in files or folders, and recordings of any format.

Their result files' names are unique among all frames of a call. Frames that cannot be read are skipped, up to a budget.
"""

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, check_int, reported
from bodyseg_data.files import entries_of, natural_key, refuse_special
from bodyseg_data.shards import SIGNATURE, check_checksums, decode_chunks, read_chunks, read_header
from bodyseg_model.recordings.formats import SUFFIXES, find_format
from bodyseg_model.recordings.recording import MILLIMETRE, Frame, FrameSource, Pixels, Unopened, check_pixels

_NAME: Final = re.compile(r"[\w+()#,:@=-][\w+()#,:@=. -]{0,99}")

_DEPTH_NAME: Final = re.compile(r"(?:^|[^a-z])(depth|range)(?![a-z])")
_DEPTH_FOLDERS: Final = ("depth", "depth_raw", "range")

_FORMATS: Final = "recordings: bags, MCAP, NPY, NPZ, TIFF, MKV"
RECORDINGS_HELP: Final = f"16-bit grey PNGs, folders of them, or {_FORMATS}"
"""Help of commands' argument for frames."""

FOCAL_HELP: Final = "focal length, pixels (default: the recording's, or by the frames' size)"
CENTRE_HELP: Final = "with --focal: principal point, x y, pixels (default: the image's middle)"
UNITS_HELP: Final = "length of one step of a pixel's value: mm, 0.1mm, cm ... (default: the recording's, or mm)"
"""Help of options of the camera; `metres_a_step` reads the text of `--units`."""

_PAUSE_S: Final = 1.0  # longest between two files of one recording
_LARGEST_FILE: Final = 1 << 28
_UNIT: Final = re.compile(r"([0-9]+(?:\.[0-9]+)?|\.[0-9]+)? ?(mm|cm|m)")
_METRES: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_STEPS_M: Final = (1e-6, 0.1)
_SATURATED: Final = 65535


def find_frames(
    paths: Sequence[Path], topic: str | None = None, step_m: float | None = None, skip: int = 0
) -> list[Frame]:
    """List the frames at `paths`, as `open_recording` opens them.

    Files of one frame come first, as one input in natural order of folders and names (2 before 10), then recordings one
    after another. A frame is named after its file, or its number in its recording; where two frames would have one
    name, all are named with their folders or recordings (`result_names`). topic, step_m: as of `open_recording`. skip:
    the most recordings that may be there and not open; each is a frame that cannot be read. Raises BadConfig for a
    path that cannot be read or contains no frame, a name unfit for a result file, or one frame given twice;
    MissingLibrary.
    """
    skipping = Skipping(skip)
    opened = [(path.is_dir(), open_recording(path, topic, step_m, skipping.budget > 0)) for path in paths]
    single = [found[0] for is_folder, found in opened if not is_folder and found[0].member is None]
    single.sort(key=lambda frame: (natural_key(str(frame.path.parent)), natural_key(frame.name)))
    several = (found for is_folder, found in opened if is_folder or found[0].member is not None)
    frames, begun = single, 1
    for found in several:
        frames += [replace(frame, sequence=begun + frame.sequence) for frame in found]
        begun = frames[-1].sequence + 1
    for lost in (frame for frame in frames if not frame.source.opened):
        skipping.read(lost)  # now, so that too many end a call before any frame is labelled
    return [replace(frame, name=name) for frame, name in zip(frames, result_names(frames), strict=True)]


def open_recording(
    path: Path | str, topic: str | None = None, step_m: float | None = None, skip: bool = False
) -> tuple[Frame, ...]:
    """Open a recording, its frames in order: a PNG, a folder of PNGs, or a file or folder of one of `FORMATS`, told by
    content or suffix.

    A folder without any of these may hold files of `FORMATS`, which are read one after another, in natural order; a
    file whose times do not go on with those of the file before begins another sequence.
    topic: which of several streams of frames; None for the only one. step_m: metres a step, or metres that 1.0 is in
    floating point; None: as the recording says, or else millimetres and metres. skip: what is there but does not open
    is one frame, which says why when it is read. Raises BadConfig for a path that cannot be read, or holds no frame,
    and for a step that is not above 0; MissingLibrary.
    """
    path = Path(path)
    if step_m is not None and not 0 < step_m < inf:
        raise BadConfig(f"step_m must be above 0, found {step_m!r}")
    try:
        if path.is_dir():
            return _folder(path, topic, step_m, skip)
        found = find_format(path)
        return _pngs([png_file(path)], path, topic, step_m) if found is None else found.open(path, topic, step_m)
    except BadConfig as error:
        if not skip or not path.exists():
            raise
        lost = Unopened(str(error).removeprefix(str(path)).lstrip(": "))  # `Frame.read` names it again
        return (Frame(path.stem, str(path), path, None, lost, ("",), step_m=step_m or MILLIMETRE),)


def _pngs(frames: list[Frame], path: Path, topic: str | None, step_m: float | None) -> tuple[Frame, ...]:
    """Frames of PNGs in natural order, and in the given steps. Raises BadConfig for a topic."""
    if topic is not None:
        raise BadConfig(f"--topic is for recordings that hold several, found PNG files: {path}")
    frames = [replace(frame, step_m=step_m or MILLIMETRE) for frame in frames]
    return tuple(sorted(frames, key=lambda frame: natural_key(frame.name)))


def metres_a_step(unit: str) -> float:
    """Parse the size of one step of a frame, metres, from text like "mm", "0.1mm" or "1 cm". Raises BadConfig."""
    match = _UNIT.fullmatch(unit)
    step = float(match[1] or 1) * _METRES[match[2]] if match else 0.0
    if not _STEPS_M[0] <= step <= _STEPS_M[1]:
        rule = "a unit must be a length from 0.001mm to 10cm, such as mm or 0.1mm; floating point needs none for metres"
        raise BadConfig(f"{rule}: found {unit!r}")
    return step


def to_metres(frame: NDArray[np.uint16], step_m: float) -> NDArray[np.float32]:
    """Convert a frame's steps to metres, float32 [H, W]; 0 (nothing measured) where it is 0 or 65535 (saturated).

    Raises BadConfig for floating point, which is in metres already.
    """
    if frame.dtype.kind not in "ui":
        raise BadConfig(f"a frame's steps must be whole numbers, found {frame.dtype}: it may be in metres already")
    ranges = frame.astype(np.float32) * np.float32(step_m)
    ranges[frame == _SATURATED] = 0
    return ranges


def png_file(path: Path, time_s: float | None = None, step_m: float = MILLIMETRE) -> Frame:
    """Return the frame in a PNG file, whose content is not read yet; one that is not there tells so when it is read."""
    source: FrameSource
    try:
        with reported("the file cannot be read", BadConfig, OSError):
            refuse_special(path)
            source = PngSource(path, path.stat().st_size)
        if source.size > _LARGEST_FILE:
            raise BadConfig(f"a frame must have at most {_LARGEST_FILE} bytes, found {source.size}")
    except BadConfig as error:
        source = Unopened(str(error))
    return Frame(path.stem, str(path), path, None, source, ("",), 0, time_s, step_m)


def _folder(path: Path, topic: str | None, step_m: float | None, skip: bool) -> tuple[Frame, ...]:
    """The PNGs in a folder; without any, the recording that the folder is, or all recordings in it as one.

    Of images of several kinds, as 7-Scenes, ScanNet and others have them, those of depth are read: by their names
    ("000.depth", "depth_0") if some have such a name; or those in the folder called depth if there is nothing else.
    """
    with reported(f"cannot read {path}", BadConfig, OSError):
        files = [file for file in entries_of(path) if not file.is_dir()]
    pngs = _of_depth([file for file in files if file.suffix.lower() == ".png"])
    files = _of_depth([*pngs, *(file for file in files if file.suffix.lower() in SUFFIXES)])
    if pngs := [file for file in files if file.suffix.lower() == ".png"]:
        return _pngs([png_file(file) for file in pngs], path, topic, step_m)
    if (found := find_format(path)) is not None:
        return found.open(path, topic, step_m)
    inner = [path / name for name in _DEPTH_FOLDERS if (path / name).is_dir()]
    if not files and inner:
        return _folder(inner[0], topic, step_m, skip)
    if not files:
        raise BadConfig(
            f"a folder of frames must hold .png files or recordings ({', '.join(SUFFIXES)}), found none in {path}"
        )
    files.sort(key=lambda file: natural_key(file.name))
    frames = list[Frame]()
    for part in files:
        opened = open_recording(part, topic, step_m, skip)
        sequence = frames[-1].sequence if frames else 0
        if frames and not _goes_on(frames[-1], opened[0]):
            sequence += 1
        frames += [replace(frame, sequence=sequence) for frame in opened]
    return tuple(frames)


def _goes_on(before: Frame, frame: Frame) -> bool:
    """True if a frame was taken soon after another, as where a recorder begins its next file, or each is a file."""
    if before.member is frame.member is None:
        return True
    return before.time_s is not None and frame.time_s is not None and 0 <= frame.time_s - before.time_s <= _PAUSE_S


def _of_depth(files: list[Path]) -> list[Path]:
    """Files whose names say depth, if a quarter or more have such names; else all."""
    depth = [file for file in files if _DEPTH_NAME.search(file.stem.lower())]
    return depth if 4 * len(depth) >= len(files) else files


def result_names(frames: Sequence[Frame]) -> list[str]:
    """Names of the results of frames, without suffix: their files' own ("1"), unless two of them are equal.

    Otherwise every frame gets a folder, named after the frame's folder or recording, with as many of the folders above
    it as tell all of them apart ("left/1", "monday/left/1"). Raises BadConfig for a name unfit for a file, or
    two frames that no folder tells apart, such as one frame given twice.
    """
    stems = [frame.member or frame.path.stem for frame in frames]
    names = stems
    if len(set(stems)) < len(stems):
        folders = [frame.path.parent.resolve().parts[1:] for frame in frames]
        # A recording of several frames counts as a folder with its name.
        inner = [() if frame.member is None else (frame.path.stem,) for frame in frames]
        homes = [(*above, *own) for above, own in zip(folders, inner, strict=True)]
        depth, deepest = 1, max(map(len, homes))
        while depth < deepest and len({home[-depth:] for home in homes}) < len(set(homes)):
            depth += 1
        names = ["/".join((*home[-depth:], stem)) for home, stem in zip(homes, stems, strict=True)]
    first: dict[str, str] = {}
    for name, frame in zip(names, frames, strict=True):
        letters = "".join(each for each in name if not unicodedata.category(each).startswith("M"))  # without accents
        if not all(map(_NAME.fullmatch, letters.split("/"))):
            raise BadConfig(
                "a frame's name, which its results get, must be 1 to 100 letters, digits, spaces or _+-.()#,:@= and "
                f"not begin with a dot or space, found {frame.where}"
            )
        if name in first:
            raise BadConfig(f"two frames must not have one name, as their results would: {first[name]}, {frame.where}")
        first[name] = frame.where
    return names


class Skipping:
    """Reads frames and skips those that cannot be read, up to `budget` of them.

    skipped: name, file and error of each, in the order of reading. Raises BadConfig for a budget below 0.
    """

    def __init__(self, budget: int = 0) -> None:
        self.budget = check_int("--skip-unreadable", budget, least=0)
        self.skipped: list[dict[str, str]] = []

    def read(self, frame: Frame) -> Pixels | None:
        """Read a frame, uint16 [H, W]; None for one that cannot be read. Raises BadConfig once the budget is spent."""
        try:
            return frame.read()
        except BadConfig as error:
            entry = {"name": frame.name, "file": frame.where, "error": str(error)}
            if entry not in self.skipped:
                if len(self.skipped) >= self.budget:
                    beyond = f", after {self.budget} that --skip-unreadable allowed" if self.budget else ""
                    raise BadConfig(f"{error}{beyond}") from error
                self.skipped.append(entry)
            return None


def first_readable(frames: Sequence[Frame], skipping: Skipping) -> Frame | None:
    """Return the first frame that can be read, None if none can. Raises BadConfig if too many cannot."""
    return next((frame for frame in frames if skipping.read(frame) is not None), None)


_KINDS: Final = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGB with alpha"}
_NEEDED: Final = (b"IHDR", b"IDAT", b"IEND")


def parse_frame(data: bytes) -> NDArray[np.uint16]:
    """Decode the pixels of a 16-bit grey PNG, uint16 [H, W]. Raises BadConfig.

    Chunks without pixels are checked but not decoded: ranges need none of them, and the sizes they claim could exhaust
    memory.
    """
    if not data.startswith(SIGNATURE):
        found = f"no PNG, nor one of the {_FORMATS}" if data else "nothing at all"
        raise BadConfig(f"a frame must be a 16-bit grey PNG, found {found}")
    with reported("", BadConfig, ValueError):
        chunks = read_chunks(data)
        check_checksums(chunks)
        needed = [chunk for chunk in chunks if chunk.name in _NEEDED]
        header = read_header(needed[0])
        if (header.bits, header.colour) != (16, 0):
            kind = f"{header.bits}-bit {_KINDS.get(header.colour, header.colour)}"
            raise BadConfig(f"a frame must be a 16-bit grey PNG, found {kind}")
        check_pixels((header.rows, header.columns), np.dtype(np.uint16))
        image: NDArray[np.uint16] = decode_chunks(needed)
    return image


@dataclass(frozen=True)
class PngSource(FrameSource):
    """Reader of one frame, the PNG of `size` bytes at `path`."""

    path: Path
    size: int

    def read(self, index: int) -> NDArray[np.uint16]:
        with reported("the file cannot be read", BadConfig, OSError), self.path.open("rb") as file:
            data = file.read(self.size)
        if len(data) != self.size:
            raise BadConfig(f"the file must still have the {self.size} bytes it had, found {len(data)}")
        return parse_frame(data)
