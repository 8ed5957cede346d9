"""Where bodies come from: one file a source, one Protocol.

A source lists its bodies cheaply and in a fixed order, and builds each one on demand, the same bits every time. It is
opened afresh in every process that needs it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.meshes.mesh import Mesh
from bodyseg_data.bodies.alignment import Units, UpAxis
from bodyseg_data.core.splits import Split

SourceName = Literal["open", "bare", "wide", "hard", "scape", "mit", "caesar", "folder", "paper"]


@dataclass(frozen=True)
class BodyRef:
    """The name of one body within a source. No field may contain a dot or a slash: they become sample keys.

    subset: the group of the paper it belongs or corresponds to ("A", "B", "C", "people"), else the source's name.
    subject: the person.
    mesh: unique within the source. pose: what the body does, for people to read. split: train or test.
    """

    subset: str
    subject: str
    mesh: str
    pose: str
    split: Split


@dataclass(frozen=True)
class Body:
    """A body ready to be labelled.

    landmarks: int64 [33], the vertex of each landmark in the order of `PARTS`. notes: one line each on what had to be
    done to the mesh that its owner may want to know.
    """

    mesh: Mesh
    landmarks: NDArray[np.int64]
    notes: tuple[str, ...] = ()


class BodySource(Protocol):
    """A set of bodies."""

    name: str

    def bodies(self) -> Sequence[BodyRef]:
        """All bodies that are there, in their fixed order."""

    def missing(self) -> Sequence[str]:
        """Names of what a complete set has and this one has not, in order; none for sources that make their bodies."""

    def fingerprint(self, bodies: Sequence[BodyRef]) -> str:
        """A digest of all that shapes these bodies beyond their names: files, models, landmarks.

        Raises BodysegError for bodies that cannot be built, as far as that shows without building them.
        """

    def build(self, body: BodyRef) -> Body:
        """The mesh and landmarks of one of `bodies()`. Raises BadMesh or BadLandmarks."""


def open_source(
    name: str,
    path: Path | None = None,
    landmarks: Path | None = None,
    units: Units = "auto",
    up: UpAxis = "auto",
) -> BodySource:
    """The source called `name`.

    path: the folder it reads, for sources that read one. landmarks: a landmark file for all of its meshes that have
    none of their own, or a folder in which landmark files are looked for instead of in `path`. units, up: what the
    mesh files are in and which of their axes points up, found from body and landmarks if "auto" (`placing`).
    Raises BadConfig.
    """
    if name in ("open", "bare", "wide", "hard"):
        given = {"--path": path, "--landmarks": landmarks, "--units": units != "auto", "--up": up != "auto"}
        unused = [option for option, value in given.items() if value]
        if unused:
            raise BadConfig(f"the source {name!r} makes its bodies and reads no files: leave {', '.join(unused)} out")
        return _made_bodies(name)
    if name not in get_args(SourceName):
        raise BadConfig(f"the source must be one of {', '.join(get_args(SourceName))}, found {name!r}")
    if path is None:
        raise BadConfig(f"the source {name!r} needs --path: the folder that holds {_HELD_BY[name]}")
    if not path.is_dir():
        raise BadConfig(f"the source {name!r} reads a folder, found {'a file' if path.exists() else 'none'} at {path}")
    return _read_bodies(name, path, landmarks, units, up)


def _made_bodies(name: str) -> BodySource:
    if name == "hard":
        from bodyseg_data.bodies.sources.hard import HardBodies

        return HardBodies()
    if name == "wide":
        from bodyseg_data.bodies.sources.wide import WideBodies

        return WideBodies()
    from bodyseg_data.bodies.sources.open_bodies import OpenBodies

    return OpenBodies(dressed=name == "open")


_HELD_BY: Final[dict[str, str]] = {
    "scape": "mesh000.ply to mesh071.ply",
    "mit": "I_crane and the other sequences",
    "caesar": "one mesh and one .lnd file a subject",
    "folder": "meshes and landmark files",
    "paper": "scape, mit and caesar",
}


def _read_bodies(name: str, path: Path, landmarks: Path | None, units: Units, up: UpAxis) -> BodySource:
    if name == "scape":
        from bodyseg_data.bodies.sources.scape import ScapeBodies

        return ScapeBodies(path, landmarks, units, up)
    if name == "mit":
        from bodyseg_data.bodies.sources.mit import MitBodies

        return MitBodies(path, landmarks, units, up)
    if name == "caesar":
        from bodyseg_data.bodies.sources.caesar import CaesarBodies

        return CaesarBodies(path, landmarks, units, up)
    if name == "folder":
        from bodyseg_data.bodies.sources.folder import FolderBodies

        return FolderBodies(path, landmarks, units, up)
    from bodyseg_data.bodies.sources.paper import PaperBodies

    return PaperBodies(path, landmarks, units, up)
