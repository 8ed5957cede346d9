"""Registry of the sources of bodies: a new one is a file in this folder and an entry of `SOURCES`.

Packages of users add theirs by the entry point `bodyseg.sources`: name -> class.
"""

from functools import cache
from importlib import import_module, metadata
from pathlib import Path
from typing import Any, Final

from bodyseg_data.bodies.alignment import Units, UpAxis
from bodyseg_data.bodies.source import BodySource, MeshOptions
from bodyseg_data.core import BadConfig, check_choice, reported

SOURCES: Final[dict[str, Any]] = {
    "open": "open_bodies.OpenBodies",
    "bare": "open_bodies.BareBodies",
    "wide": "open_bodies.WideBodies",
    "everyday": "open_bodies.EverydayBodies",
    "candidates": "open_bodies.CandidateBodies",
    "hard": "hard.HardBodies",
    "scape": "paper.ScapeBodies",
    "mit": "paper.MitBodies",
    "caesar": "paper.CaesarBodies",
    "folder": "folder.FolderBodies",
    "labelled": "labelled.LabelledScenes",
    "paper": "paper.PaperBodies",
}
"""Name -> class; those of this folder as "module.Class", imported when opened. The order is that of messages and
of `--help`.
"""


ENTRY_POINT: Final = "bodyseg.sources"
"""Group of the entry points by which an installed package adds sources."""

_METHODS: Final = ("bodies", "missing", "fingerprint", "check", "build")


def check_source(name: str, *others: str) -> str:
    """Return the name of a source, or of one of `others`. Raises BadConfig, listing all, for another."""
    added = (entry.name for entry in metadata.entry_points(group=ENTRY_POINT))
    return check_choice("the source", name, dict.fromkeys((*SOURCES, *added, *others)))


def source_class(name: str) -> Any:
    """Return the class of the source called `name`. Raises BadConfig if there is none, or it breaks the protocol."""
    kind = SOURCES[name] if name in SOURCES else _added(name)
    if isinstance(kind, str):
        module, own = kind.split(".")
        kind = getattr(import_module(f"{__name__}.{module}"), own)
    return kind


@cache
def _added(name: str) -> type[Any]:
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
    return kind


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
    kind = source_class(name)
    reads = getattr(kind, "reads", None)  # the content of the folder; None for sources that make their bodies
    path, landmarks = (None if each is None else Path(each) for each in (path, landmarks))
    if reads is None:
        source: BodySource = kind()
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
        raise BadConfig(f"the source {name!r} needs --path: the folder that holds {reads}")
    if not path.is_dir():
        raise BadConfig(f"the source {name!r} reads a folder, found {'a file' if path.exists() else 'none'} at {path}")
    opened: BodySource = kind(path, landmarks, MeshOptions(units, up, pymeshlab))
    return opened
