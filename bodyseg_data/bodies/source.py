"""Protocol of the sources of bodies, and the list of bodies that each of them keeps.

A source lists its bodies cheaply and in a fixed order, and builds each one on demand, the same bits every time. Every
process opens its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.splits import Split
from bodyseg_data.meshes.mesh import Mesh
from bodyseg_data.meshes.partition.geodesics import GeodesicMethod
from bodyseg_data.meshes.partition.pieces import SurfacePiece
from bodyseg_data.meshes.partition.surface_parts import Partition, partition

Entry = TypeVar("Entry")


@dataclass(frozen=True)
class BodyRef:
    """Name of one body within a source. No field may contain a dot or a slash: they become sample keys.

    subset: the paper's group that it belongs or corresponds to ("A", "B", "C", "people"), else the source's name.
    subject: the person. mesh: unique within the source. pose: the posture or motion in words. split: train or test.
    """

    subset: str
    subject: str
    mesh: str
    pose: str
    split: Split


@dataclass(frozen=True)
class Body:
    """A body ready to be labelled.

    landmarks: int64 [33], the vertex of each landmark in the order of `PARTS`. notes: repairs of the mesh and the like,
    one line each, for its owner. pieces: those of the mesh that lie over the body, like a skirt or a held thing.
    """

    mesh: Mesh
    landmarks: NDArray[np.int64]
    notes: tuple[str, ...] = ()
    pieces: tuple[SurfacePiece, ...] = ()

    def partition(self, method: GeodesicMethod = "exact") -> Partition:
        """Label every vertex of the mesh, as `partition` does and with its errors."""
        return partition(self.mesh, self.landmarks, method, self.pieces)


class BodySource(Protocol):
    """A set of bodies."""

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
        """Raise BadMesh or BadLandmarks for a body that cannot be built, as far as that can be told at little cost.

        Packing calls it, for sources that read files, for all bodies before it builds the first.
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
        """Return all bodies found, in their fixed order."""
        return tuple(self._entries)

    def missing(self) -> Sequence[str]:
        """Return the names of the files that a complete set has and this one lacks, in order."""
        return self._missing

    def check(self, body: BodyRef) -> None:
        """Check the files of one of `bodies()`, of which a source that reads none has no need."""

    def entry(self, body: BodyRef) -> Entry:
        """Return the entry of one of `bodies()`. Raises BadConfig for a body of another source."""
        if body not in self._entries:
            raise BadConfig(f"the source {self.name!r} has no body {body.mesh!r} of subset {body.subset!r}")
        return self._entries[body]
