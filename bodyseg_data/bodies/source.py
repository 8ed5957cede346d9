"""Where bodies come from: one file a source, one Protocol.

A source lists its bodies cheaply and in a fixed order, and builds each one on demand, the same bits every time. It is
opened afresh in every process that needs it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core.splits import Split
from bodyseg_data.meshes.mesh import Mesh


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
