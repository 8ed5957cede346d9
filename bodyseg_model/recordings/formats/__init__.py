"""Registry of the formats of recordings that hold many frames: a new one is a file and an entry of `FORMATS`."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Final

from bodyseg_data.core import BadConfig, reported
from bodyseg_data.files import refuse_special
from bodyseg_model.recordings.recording import Frame

Opener = Callable[[Path, str | None, float | None], tuple[Frame, ...]]
"""Opens a recording: its path, a topic or array of it, and metres a step, both None where they are not given."""


@dataclass(frozen=True)
class Format:
    """One format. home: "module.function" of this room, an `Opener`, imported when a recording is opened.

    title: for messages. magic: first bytes of such a file, any of them. suffixes: of its name, where its first bytes
    say nothing. entry: a file in a folder of this format.
    """

    title: str
    home: str
    magic: tuple[bytes, ...] = ()
    suffixes: tuple[str, ...] = ()
    entry: str | None = None

    def open(self, path: Path, topic: str | None, step_m: float | None) -> tuple[Frame, ...]:
        """Open a recording. Raises BadConfig, MissingLibrary."""
        module, _, name = self.home.rpartition(".")
        opener: Opener = getattr(import_module(f"bodyseg_model.recordings.{module}"), name)
        return opener(path, topic, step_m)


FORMATS: Final[dict[str, Format]] = {
    "ros1": Format("ROS 1 bag", "bag_files.open_ros1", (b"#ROSBAG V",), (".bag",)),
    "ros2": Format("ROS 2 bag", "bag_files.open_ros2", entry="metadata.yaml"),
    "db3": Format("file of a ROS 2 bag", "bag_files.open_sqlite", (b"SQLite format 3\0",), (".db3",)),
    "mcap": Format("MCAP", "bag_files.open_mcap", (b"\x89MCAP0\r\n",), (".mcap",)),
    "npy": Format("NPY array", "formats.arrays.open_npy", (b"\x93NUMPY",), (".npy",)),
    "npz": Format("NPZ arrays", "formats.arrays.open_npz", (b"PK\x03\x04", b"PK\x05\x06"), (".npz",)),
    "tiff": Format("TIFF", "formats.tiff.open_tiff", (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), (".tif", ".tiff")),
    "mkv": Format("Matroska", "formats.matroska.open_mkv", (b"\x1a\x45\xdf\xa3",), (".mkv",)),
    "tum": Format("folder with depth.txt", "formats.tum.open_tum", entry="depth.txt"),
}
"""Name -> format. The order is that of messages."""

SUFFIXES: Final = tuple(suffix for each in FORMATS.values() for suffix in each.suffixes)
"""Suffixes of the names of recordings, in lower case."""

_LONGEST_MAGIC: Final = max(len(magic) for each in FORMATS.values() for magic in each.magic)


def find_format(path: Path) -> Format | None:
    """Tell a path's format by content, else by suffix; None for no format. Raises BadConfig if it cannot be read."""
    if path.is_dir():
        return next((each for each in FORMATS.values() if each.entry and (path / each.entry).is_file()), None)
    with reported(f"cannot read {path}", BadConfig, OSError):
        refuse_special(path)
        with path.open("rb") as file:
            start = file.read(_LONGEST_MAGIC)
    by_content = (each for each in FORMATS.values() if start.startswith(each.magic))
    by_suffix = (each for each in FORMATS.values() if path.suffix.lower() in each.suffixes)
    return next(by_content, None) or next(by_suffix, None)
