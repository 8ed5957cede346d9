"""Where bodies come from: one file a source, one Protocol.

A source lists its bodies cheaply and in a fixed order, and builds each one on demand, the same bits every time. It is
opened afresh in every process that needs it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.errors import BadConfig
from bodyseg_data.mesh import Mesh
from bodyseg_data.splits import Split

SourceName = Literal["open", "mit"]


@dataclass(frozen=True)
class BodyRef:
    """The name of one body within a source. No field may contain a dot or a slash: they become sample keys.

    subset: the group of the paper it belongs or corresponds to ("A", "B", "C", "people"). subject: the person.
    mesh: unique within the source. pose: what the body does, for people to read. split: train or test.
    """

    subset: str
    subject: str
    mesh: str
    pose: str
    split: Split


@dataclass(frozen=True)
class Body:
    """A body ready to be labelled. landmarks: int64 [33], the vertex of each landmark in the order of `PARTS`."""

    mesh: Mesh
    landmarks: NDArray[np.int64]


class BodySource(Protocol):
    """A set of bodies."""

    name: str

    def bodies(self) -> Sequence[BodyRef]:
        """All bodies in their fixed order. Raises BodysegError naming whatever is missing."""

    def fingerprint(self, bodies: Sequence[BodyRef]) -> str:
        """A digest of all that shapes these bodies beyond their names: files, models, landmarks.

        Raises BodysegError for bodies that cannot be built, as far as that shows without building them.
        """

    def build(self, body: BodyRef) -> Body:
        """The mesh and landmarks of one of `bodies()`. Raises BadMesh or BadLandmarks."""


def open_source(name: str, path: Path | None = None) -> BodySource:
    """The source called `name`; `path` is the folder it reads, for sources that read one. Raises BadConfig."""
    if name == "open":
        from bodyseg_data.bodies.open_bodies import OpenBodies

        if path is not None:
            raise BadConfig("the source 'open' makes its bodies and reads no folder: leave --path out")
        return OpenBodies()
    if name == "mit":
        from bodyseg_data.bodies.mit import MitBodies

        if path is None:
            raise BadConfig("the source 'mit' needs --path: the folder that holds I_crane and the other sequences")
        return MitBodies(path)
    raise BadConfig(f"the source must be one of {', '.join(get_args(SourceName))}, found {name!r}")
