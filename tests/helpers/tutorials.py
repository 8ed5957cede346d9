"""The commands and files of a tutorial, read from the document, so that what is tested is what a reader types; and a
simulated recording for docs/tutorials/your_camera.md.
"""

from __future__ import annotations

import io
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from benches.model.sensor_fit.recordings import Scene, Scenes
from folders import DOCS
from PIL import Image

from bodyseg_data.artifacts import load_sensor_model
from bodyseg_data.bodies import open_source
from bodyseg_data.rigs import load_rig

DOCUMENT: Final = DOCS / "tutorials" / "your_camera.md"

SENSOR: Final = "realsense_d435"
"""The sensor that the simulated recording is made with."""

_RIG_FILE: Final = "my_rig.toml"
_BLOCK: Final = re.compile(r"```(bash|toml)\n(.*?)```", re.DOTALL)


@dataclass(frozen=True)
class Tutorial:
    """A document's files, name -> content, and the words of its `bodyseg` commands in their order."""

    files: Mapping[str, str]
    commands: Sequence[tuple[str, ...]]


def read_tutorial(document: Path = DOCUMENT) -> Tutorial:
    """Read files (TOML blocks that begin with a comment of their name) and commands of a document."""
    files, commands = {}, []
    for language, text in _BLOCK.findall(document.read_text()):
        if language == "toml":
            files[text.partition("\n")[0].removeprefix("# ")] = text
        else:
            commands += [tuple(shlex.split(line)[1:]) for line in text.splitlines() if line.startswith("bodyseg ")]
    return Tutorial(files, commands)


def smaller(command: Sequence[str], sizes: Mapping[str, str]) -> list[str]:
    """Return a command with other values for some of its options, and with those options added that it lacks.

    sizes: "COMMAND --option" -> value.
    """
    words = list(command)
    for place, value in sizes.items():
        name, _, flag = place.partition(" ")
        if words[0] != name:
            continue
        if flag in words:
            words[words.index(flag) + 1] = value
        else:
            words += [flag, value]
    return words


def record(folder: Path, rig: Path, frames: int) -> None:
    """Write frames of a body of `open` before a wall, as the rig and the sensor `SENSOR` see it: 16-bit PNGs in mm."""
    placed = load_rig(rig)
    source = open_source("open")
    scenes = Scenes(source.build(source.bodies()[0]), placed)
    folder.mkdir()
    recording = scenes.record(Scene(frames, wall=True), load_sensor_model(SENSOR))
    for number, frame in enumerate(recording.frames):
        buffer = io.BytesIO()
        Image.fromarray(frame.stored).save(buffer, "PNG")
        (folder / f"{number:04d}.png").write_bytes(buffer.getvalue())
    scenes.close()


def prepare(folder: Path, tutorial: Tutorial, frames: int) -> None:
    """Write the files of the tutorial and a recording of so many frames into a folder."""
    for name, text in tutorial.files.items():
        (folder / name).write_text(text)
    record(folder / "recording", folder / _RIG_FILE, frames)
