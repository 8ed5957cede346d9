"""Options of the sources that read mesh files; importing them is quick."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from bodyseg_data.bodies.alignment import Units, UpAxis, check_alignment


@dataclass(frozen=True)
class MeshOptions:
    """Options of all sources that read mesh files.

    units, up: unit of the files and their axis that points up, found from body and landmarks if "auto" (`alignment`).
    pymeshlab: repair meshes with landmarks by coordinate that break a rule of `Mesh`, by that package (GPL-3.0).
    Raises BadConfig for an unknown unit or axis.
    """

    units: Units = "auto"
    up: UpAxis = "auto"
    pymeshlab: bool = False

    def __post_init__(self) -> None:
        check_alignment(self.units, self.up)


DEFAULTS: Final = MeshOptions()
