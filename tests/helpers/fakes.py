"""A source of plain figures, so that packing and streaming are tested in seconds and without a body model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from shapes import figure

from bodyseg_data.bodies import SOURCES, Body, BodyRef
from bodyseg_data.labels import PART_COUNT
from bodyseg_data.meshes import Mesh


@cache
def stretched(name: str, across: float, upwards: float) -> Mesh:
    """The figure, wider and taller by these factors."""
    return Mesh(name, figure(name).vertices * (across, upwards, 1.0), figure(name).faces)


class Figures:
    """Six figures of two subjects, each a little different; the last one of each subject is for testing."""

    name = "open"
    on_template = True

    def bodies(self) -> Sequence[BodyRef]:
        return [
            BodyRef(subset, subset, f"{subset}-{number}", "standing", "test" if number == 2 else "train")
            for subset in ("A", "people")
            for number in range(3)
        ]

    def missing(self) -> Sequence[str]:
        return ()

    def fingerprint(self, bodies: Sequence[BodyRef]) -> str:
        return "figures 1"

    def build(self, body: BodyRef) -> Body:
        number = [known.mesh for known in self.bodies()].index(body.mesh)
        mesh = stretched(body.mesh, 1 + 0.02 * number, 1 - 0.02 * number)
        # Equal steps through the vertices of all five pieces: a piece without a landmark would cost most of the time.
        landmarks = np.linspace(0, len(mesh.vertices) - 1, PART_COUNT).astype(np.int64)
        return Body(mesh, landmarks, template=lambda: figure(body.mesh).vertices)

    def in_pose(self, body: BodyRef, pose: str) -> Body:
        """The figure, in any pose a seventh taller."""
        built = self.build(body)
        vertices = built.mesh.vertices * (1, 8 / 7, 1)
        return replace(built, mesh=Mesh(body.mesh, vertices, built.mesh.faces))


def figures_are_open() -> None:
    """Let this process, one for this alone, take the figures for the source "open"."""
    SOURCES["open"] = Figures
