"""Names of frames' result files, unique among all frames of a call."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePosixPath
from typing import Final

from bodyseg_data.core.errors import BadConfig
from bodyseg_model.recordings.recording import Frame

_NAME: Final = re.compile(r"[\w+()-][\w+(). -]{0,99}")

_NO_NAMES: Final = ("/", ".", "..")


def result_names(frames: Sequence[Frame]) -> list[str]:
    """Names of the results of frames, without suffix: their files' own ("1"), unless two of them are equal.

    Otherwise every frame gets a folder, which is named after the frame's folder or tar, with as many of the folders
    above it as tell all of them apart ("left/1", "monday/left/1"). Raises BadConfig for a name unfit for a file, or
    two frames that no folder tells apart, such as one frame given twice.
    """
    stems = [_stem(frame) for frame in frames]
    names = stems
    if len(set(stems)) < len(stems):
        homes = [_home(frame) for frame in frames]
        depth, deepest = 1, max(map(len, homes))
        while depth < deepest and len({home[-depth:] for home in homes}) < len(set(homes)):
            depth += 1
        names = ["/".join((*home[-depth:], stem)) for home, stem in zip(homes, stems, strict=True)]
    first: dict[str, str] = {}
    for name, frame in zip(names, frames, strict=True):
        if not all(map(_NAME.fullmatch, name.split("/"))):
            raise BadConfig(
                "a frame's name, which its results get, must be 1 to 100 letters, digits, spaces or _+-.() and not "
                f"begin with a dot or space, found {frame.where}"
            )
        if name in first:
            raise BadConfig(f"two frames must not have one name, as their results would: {first[name]}, {frame.where}")
        first[name] = frame.where
    return names


def _stem(frame: Frame) -> str:
    return frame.path.stem if frame.member is None else PurePosixPath(frame.member).stem


def _home(frame: Frame) -> tuple[str, ...]:
    """The folders of a frame from the root, a tar counted as one of its name; parts of no name, like "..", left out."""
    folders = frame.path.parent.resolve().parts[1:]
    if frame.member is None:
        return folders
    return (
        *folders,
        frame.path.stem,
        *(part for part in PurePosixPath(frame.member).parts[:-1] if part not in _NO_NAMES),
    )
