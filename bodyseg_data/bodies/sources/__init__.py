"""Registry of the sources of bodies: a new one is a file in this folder and an entry of `SOURCES`.

Packages of users add theirs by the entry point `bodyseg.sources`: name -> class.
"""

from dataclasses import dataclass
from functools import cache
from importlib import import_module, metadata
from pathlib import Path
from typing import Any, Final

from bodyseg_data.bodies.alignment import Units, UpAxis
from bodyseg_data.bodies.source import BodySource, MeshOptions
from bodyseg_data.core import BadConfig, check_choice, reported


@dataclass(frozen=True)
class SourceEntry:
    """Class of a source; one of this folder as "module.Class", which is imported when the source is opened.

    reads: content of the folder that `--path` must name; None for sources that make their bodies and read no files.
    """

    home: str | type[Any]
    reads: str | None = None

    def open(self, *arguments: Any) -> BodySource:
        """Construct the source with `arguments`."""
        kind: Any = self.home
        if isinstance(kind, str):
            module, name = kind.split(".")
            kind = getattr(import_module(f"{__name__}.{module}"), name)
        source: BodySource = kind(*arguments)
        return source


SOURCES: Final[dict[str, SourceEntry]] = {
    "open": SourceEntry("open_bodies.OpenBodies"),
    "bare": SourceEntry("open_bodies.BareBodies"),
    "wide": SourceEntry("open_bodies.WideBodies"),
    "everyday": SourceEntry("open_bodies.EverydayBodies"),
    "candidates": SourceEntry("open_bodies.CandidateBodies"),
    "hard": SourceEntry("hard.HardBodies"),
    "scape": SourceEntry("paper.ScapeBodies", reads="mesh000.ply to mesh071.ply"),
    "mit": SourceEntry("paper.MitBodies", reads="I_crane and the other sequences"),
    "caesar": SourceEntry("paper.CaesarBodies", reads="one mesh and one .lnd file a subject"),
    "folder": SourceEntry("folder.FolderBodies", reads="meshes and landmark files"),
    "labelled": SourceEntry("labelled.LabelledScenes", reads="meshes with labels of their own, or scene files"),
    "paper": SourceEntry("paper.PaperBodies", reads="scape, mit and caesar"),
}
"""Name -> class. The order is that of messages and of `--help`."""


ENTRY_POINT: Final = "bodyseg.sources"
"""Group of the entry points by which an installed package adds sources."""

_METHODS: Final = ("bodies", "missing", "fingerprint", "check", "build")


def check_source(name: str, *others: str) -> str:
    """Return the name of a source, or of one of `others`. Raises BadConfig, listing all, for another."""
    added = (entry.name for entry in metadata.entry_points(group=ENTRY_POINT))
    return check_choice("the source", name, dict.fromkeys((*SOURCES, *added, *others)))


@cache
def _added(name: str) -> SourceEntry:
    """The source that an installed package adds. Raises BadConfig if there is none, or it breaks the protocol."""
    entries = {entry.name: entry for entry in metadata.entry_points(group=ENTRY_POINT)}
    check_source(name)
    where = f"entry point {name} = {entries[name].value!r} of {ENTRY_POINT}"
    with reported(f"{where} cannot be loaded", BadConfig, Exception):  # whatever the user's module raises
        kind = entries[name].load()
    if not isinstance(kind, type) or not all(callable(getattr(kind, method, None)) for method in _METHODS):
        raise BadConfig(f"{where}: a source must be a class with the methods of BodySource, found {kind!r}")
    if getattr(kind, "name", None) != name:
        raise BadConfig(f"{where}: the source must be called as its entry point")
    return SourceEntry(kind, getattr(kind, "reads", None))


def open_source(
    name: str,
    path: Path | str | None = None,
    landmarks: Path | str | None = None,
    units: Units = "auto",
    up: UpAxis = "auto",
    pymeshlab: bool = False,
) -> BodySource:
    """Open the source of bodies called `name`.

    path: the folder it reads, for sources that read one.
    landmarks: a landmark file for all of its meshes that have none of their own, or a folder that is searched for
    landmark files instead of `path`; sources of the open body take a file of its vertices.
    units, up: unit of the mesh files and their axis that points up; "auto" finds them from body and landmarks.
    pymeshlab: repair scans that break a rule of meshes by that package (GPL-3.0).
    Raises BadConfig for an unknown name, or for arguments that the source does not take, BadLandmarks for a file that
    is not of the open body.
    """
    entry = SOURCES[name] if name in SOURCES else _added(name)
    path, landmarks = (None if each is None else Path(each) for each in (path, landmarks))
    if entry.reads is None:
        source = entry.open()
        label_by = getattr(source, "label_by", None)
        given = {
            "--path": path,
            "--landmarks": landmarks is not None and label_by is None,
            "--units": units != "auto",
            "--up": up != "auto",
            "--pymeshlab": pymeshlab,
        }
        unused = [option for option, value in given.items() if value]
        if unused:
            raise BadConfig(f"the source {name!r} makes its bodies and reads no files: leave {', '.join(unused)} out")
        if landmarks is not None and label_by is not None:
            label_by(landmarks)
        return source
    if path is None:
        raise BadConfig(f"the source {name!r} needs --path: the folder that holds {entry.reads}")
    if not path.is_dir():
        raise BadConfig(f"the source {name!r} reads a folder, found {'a file' if path.exists() else 'none'} at {path}")
    return entry.open(path, landmarks, MeshOptions(units, up, pymeshlab))
