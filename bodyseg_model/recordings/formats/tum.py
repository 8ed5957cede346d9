"""Recordings in the form of TUM's RGB-D sets: 16-bit PNGs listed with their times in depth.txt, 5000 steps a metre.

The form: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from pathlib import Path, PurePosixPath
from typing import Final

from bodyseg_data.core import BadConfig, reported
from bodyseg_data.files import read_bytes
from bodyseg_model.recordings.frames import png_file
from bodyseg_model.recordings.recording import Frame

_LIST: Final = "depth.txt"
_STEP_M: Final = 1 / 5000
_LARGEST_LIST: Final = 1 << 26


def open_tum(path: Path, topic: str | None, step_m: float | None) -> tuple[Frame, ...]:
    """Open a folder whose `depth.txt` has a line "time file" for every frame, the file's path from the folder.

    Raises BadConfig for a list that is damaged or names files elsewhere.
    """
    if topic is not None:
        raise BadConfig(f"--topic is for recordings that hold several, found a folder with {_LIST}: {path}")
    list_file = path / _LIST
    with reported(f"a list of frames must be text: {list_file}", BadConfig, UnicodeDecodeError):
        lines = read_bytes(list_file, _LARGEST_LIST).decode().splitlines()
    step = step_m or _STEP_M
    frames = []
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        file = PurePosixPath(words[-1])
        if len(words) != 2 or not _is_time(words[0]) or file.is_absolute() or ".." in file.parts:
            raise BadConfig(
                f"a line must hold a time, seconds, and a file in the folder, found {line!r:.100}: {list_file}, "
                f"line {number}"
            )
        frames.append(png_file(path / file, float(words[0]), step))
    if not frames:
        raise BadConfig(f"a list of frames must name at least one, found none in {list_file}")
    return tuple(frames)


def _is_time(text: str) -> bool:
    try:
        return abs(float(text)) < 1 << 31  # as the time of a message; later is no second
    except ValueError:
        return False
