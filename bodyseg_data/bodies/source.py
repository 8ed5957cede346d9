"""Protocol of the sources of bodies, and the list of bodies that each of them keeps.

A source lists its bodies cheaply and in a fixed order, and builds each one on demand, the same bits every time. Every
process opens its own. Importing this file is quick.
"""

import hashlib
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Generic, Protocol, TypeVar
from urllib.parse import quote_from_bytes

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.alignment import Units, UpAxis
from bodyseg_data.core import BadConfig, Checked
from bodyseg_data.meshes import GeodesicMethod, Mesh, Partition, SceneMesh, SurfacePiece, partition
from bodyseg_data.samples import Split

_LAST_NUMBER: Final = re.compile(r"(\d+)(\D*)\Z")
_HASH_LETTERS: Final = 10

Entry = TypeVar("Entry")


def key_name(path: str, longest: int) -> str:
    """Turn a file's relative path, with / between folders, into part of a sample key: letters, digits, _, + and -.

    Different paths give different names: "/" becomes "++" and any other byte "+" and two hexadecimal digits.
    longest: as of `shortened`.
    """
    quoted = quote_from_bytes(os.fsencode(path), safe="/").replace(".", "%2E").replace("~", "%7E")
    return shortened(quoted.replace("%", "+").replace("/", "++"), longest)


def shortened(name: str, longest: int) -> str:
    """A name; one longer than `longest` ends in ten digits of a hash of the whole in place of the rest."""
    if len(name) <= longest:
        return name
    return f"{name[: longest - _HASH_LETTERS - 1]}-{hashlib.sha256(name.encode()).hexdigest()[:_HASH_LETTERS]}"


def collapsed(names: Sequence[str]) -> list[str]:
    """Join runs of names whose last number counts up by one: "meshes/mesh_0001.obj to mesh_0004.obj"."""

    def raised(number: re.Match[str]) -> str:
        return f"{int(number[1]) + 1:0{len(number[1])}d}{number[2]}"

    runs: list[list[str]] = []
    for name in names:
        if runs and name == _LAST_NUMBER.sub(raised, runs[-1][-1]):
            runs[-1].append(name)
        else:
            runs.append([name])
    return [run[0] if len(run) == 1 else f"{run[0]} to {run[-1].rpartition('/')[2]}" for run in runs]


@dataclass(frozen=True)
class MeshOptions(Checked):
    """Options of all sources that read mesh files.

    units, up: unit of the files and their axis that points up, found from body and landmarks if "auto" (`alignment`).
    pymeshlab: repair meshes with landmarks by coordinate that break a rule of `Mesh`, by that package (GPL-3.0).
    Raises BadConfig for an unknown unit or axis.
    """

    units: Units = "auto"
    up: UpAxis = "auto"
    pymeshlab: bool = False


DEFAULTS: Final = MeshOptions()


@dataclass(frozen=True)
class BodyRef:
    """Name of one body within a source. Fields become sample keys, so none may contain a dot or a slash.

    subset: the paper's group that the body belongs or corresponds to ("A", "B", "C", "people"), else the source's name.
    subject: the person. mesh: unique within the source. pose: the posture or motion in words. split: train or test.
    """

    subset: str
    subject: str
    mesh: str
    pose: str
    split: Split


@dataclass(frozen=True, eq=False)
class Body:
    """A body ready to be labelled, or a scene that brings its labels (`SceneMesh`).

    landmarks: int64 [N], the vertex of each of the 33 landmarks in the order of `PARTS`; none for a scene.
    notes: repairs of the mesh and the like, one line each, for the user who owns it.
    pieces: those pieces of the mesh that lie over the body, like a skirt or a held thing.
    template: function without arguments that returns where on the template of the body the first vertices lie (all but
    those of `pieces`), float64 [V, 3], metres; called where needed, None for bodies of another topology.
    """

    mesh: Mesh
    landmarks: NDArray[np.int64]
    notes: tuple[str, ...] = ()
    pieces: tuple[SurfacePiece, ...] = ()
    template: Callable[[], NDArray[np.float64]] | None = None

    def partition(self, method: GeodesicMethod = "exact") -> Partition:
        """Label every vertex of the mesh, as `partition` does and with its errors."""
        return partition(self.mesh, self.landmarks, method, self.pieces)

    def surface_labels(self, method: GeodesicMethod = "exact") -> Partition | SceneMesh:
        """Return the labels of the body's samples: those of a scene's mesh, else as `partition`, with its errors."""
        return self.mesh if isinstance(self.mesh, SceneMesh) else self.partition(method)


class BodySource(Protocol):
    """Bodies to render, as `open_source` returns them."""

    name: str

    def bodies(self) -> Sequence[BodyRef]:
        """Return all bodies found, in their fixed order."""

    def missing(self) -> Sequence[str]:
        """Return the names of the files that a complete set has and this one lacks, in order."""

    def fingerprint(self, bodies: Sequence[BodyRef]) -> str:
        """Return a digest of all that shapes these bodies beyond their names: files, models, landmarks.

        Raises BodysegError for bodies that cannot be built, as far as that can be told without building them.
        """

    def check(self, body: BodyRef) -> None:
        """Raise BadMesh or BadLandmarks for a body that cannot be built.

        For sources that read files, packing checks all bodies before it builds the first.
        """

    def build(self, body: BodyRef) -> Body:
        """Build the mesh and landmarks of one of `bodies()`. Raises BadMesh or BadLandmarks."""


class ListedBodies(Generic[Entry]):
    """Base of sources that keep one entry (a file, a figure ...) for each of their bodies, in a fixed order."""

    name: str

    def __init__(self, entries: Mapping[BodyRef, Entry], missing: Sequence[str] = ()) -> None:
        self._entries, self._missing = dict(entries), tuple(missing)

    def __repr__(self) -> str:
        return f"{type(self).__name__}(name={self.name!r}, bodies={len(self._entries)}, missing={len(self._missing)})"

    def bodies(self) -> Sequence[BodyRef]:
        return tuple(self._entries)

    def missing(self) -> Sequence[str]:
        return self._missing

    def check(self, body: BodyRef) -> None:
        """Check the files of one of `bodies()`, of which a source that reads none has no need."""

    def entry(self, body: BodyRef) -> Entry:
        """Return the entry of one of `bodies()`. Raises BadConfig for a body of another source."""
        if body not in self._entries:
            raise BadConfig(f"the source {self.name!r} has no body {body.mesh!r} of subset {body.subset!r}")
        return self._entries[body]
