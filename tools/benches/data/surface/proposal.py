"""`bench proposal`: how far proposed landmarks are from placed ones, and how much of the surface that labels otherwise.

Open bodies are decimated to half their triangles, and vertices and faces shuffled, so that landmarks can be found by
shape alone. All bodies are turned about the vertical by different angles.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.data.surface.areas import part_areas
from benches.landmarks.proposal import Proposal, propose
from bodyseg_data.bodies import open_source
from bodyseg_data.core import BadConfig, ProgressCallback, silent
from bodyseg_data.labels import PARTS
from bodyseg_data.meshes import Mesh, partition, with_pymeshlab

OPEN: Final = (
    "person-007",
    "person-100",
    "person-350",
    "B-march-100",
    "B-squat-125",
    "C-march-060",
    "C-bouncing-090",
)
HARD: Final = ("hard-00", "hard-04", "hard-19")
MIT: Final = ("I_crane_0000", "I_crane_0040", "I_crane_0080", "I_crane_0120")
"""Bodies measured on: standing people, dressed people in motion, crossed arms and the like, and real scans."""

_TURN_DEG: Final = 137.5  # from one body to the next, so that none faces as another does

Placed = tuple[str, Mesh, NDArray[np.float64]]
"""Name, mesh and the positions [33, 3] of its landmarks."""


def bench_proposal(mit: Path | None = None, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Error in centimetres of every body: median and worst landmark; {"bodies": {NAME: {...}}}.

    swapped: landmarks of a pair that are nearer to the other one's position. wrong_surface: share of the surface that
    proposed landmarks label otherwise. seconds: processor time. mit: folder of MIT
    frames, measured on as well. Raises BadConfig for frames that are not there.
    """
    total = len(OPEN) + len(HARD) + (len(MIT) if mit else 0)
    bodies: dict[str, dict[str, Any]] = {}
    for done, (name, mesh, positions) in enumerate(_bodies(mit), start=1):
        turn = math.radians(_TURN_DEG * done)
        rotation = np.array([[math.cos(turn), 0, math.sin(turn)], [0, 1, 0], [-math.sin(turn), 0, math.cos(turn)]])
        turned = Mesh(name, mesh.vertices @ rotation.T, mesh.faces)
        start = time.process_time()
        proposal = propose(turned)
        seconds = round(time.process_time() - start, 1)
        bodies[name] = measure(turned, positions @ rotation.T, proposal) | {"seconds": seconds}
        progress(done, total)
    return {"bodies": bodies}


def measure(mesh: Mesh, positions: NDArray[np.float64], proposal: Proposal) -> dict[str, Any]:
    """Errors of a proposal for `mesh`, whose landmarks are at `positions` [33, 3]."""
    vertices = proposal.landmarks.for_mesh(mesh)
    found = mesh.vertices[vertices]
    error = 100 * np.linalg.norm(found - positions, axis=1)
    other = [part.mirror for part in PARTS]
    swapped = np.linalg.norm(found - positions[other], axis=1) < np.linalg.norm(found - positions, axis=1)
    true = np.linalg.norm(mesh.surface_vertices[:, None] - positions, axis=2).argmin(axis=0)
    labels = [partition(mesh, at).labels for at in (vertices, np.unique(mesh.faces)[true])]
    differ = (labels[0] != labels[1]).astype(np.uint8)
    return {
        "median_cm": round(float(np.median(error)), 2),
        "worst_cm": round(float(error.max()), 1),
        "beyond_8_cm": int((error > 8).sum()),
        "swapped": int(swapped.sum()),
        "wrong_surface": round(float(part_areas(mesh, differ)[1]), 3),
    }


def _bodies(mit: Path | None) -> Iterator[Placed]:
    for name, wanted in (("open", OPEN), ("hard", HARD)):
        source = open_source(name)
        listed = {body.mesh: body for body in source.bodies()}
        for seed, mesh in enumerate(wanted):
            built = source.build(listed[mesh])
            yield mesh, shuffled(built.mesh, seed), built.mesh.vertices[built.landmarks]
    if mit is not None:
        source = open_source("mit", mit)
        listed = {body.mesh: body for body in source.bodies()}
        for mesh in MIT:
            if mesh not in listed:
                raise BadConfig(f"bench proposal needs the frame {mesh}, found none in {mit}")
            built = source.build(listed[mesh])
            yield mesh, built.mesh, built.mesh.vertices[built.landmarks]


def shuffled(mesh: Mesh, seed: int) -> Mesh:
    """The same surface with half the triangles and all numbers changed. Raises MissingLibrary without pymeshlab."""

    def halve(pymeshlab: Any) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        meshes = pymeshlab.MeshSet()
        meshes.add_mesh(pymeshlab.Mesh(mesh.vertices, mesh.faces))
        meshes.meshing_decimation_quadric_edge_collapse(targetfacenum=len(mesh.faces) // 2)
        return np.array(meshes.current_mesh().vertex_matrix()), np.array(meshes.current_mesh().face_matrix())

    vertices, faces = with_pymeshlab("bench proposal", halve)
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(vertices))
    renumbered = np.argsort(order)
    return Mesh(mesh.name, vertices[order], renumbered[faces][rng.permutation(len(faces))].astype(np.int32))
