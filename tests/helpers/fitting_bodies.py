"""The open body that benches fit, made once a process, and the same with fewer vertices. Tests must not change them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Final

import numpy as np
from benches.landmarks.fitting_body import FittingBody, fitting_body

from bodyseg_data.machine import torch_threads
from bodyseg_data.meshes import Mesh

_CELL_M: Final = 0.03


@cache
def whole_body() -> FittingBody:
    with torch_threads(1):
        return fitting_body()


@cache
def coarse_body() -> FittingBody:
    """A sixth of its skin's vertices, as symmetric: one of each cell, the landmark if there is one, for all of it."""
    body = whole_body()
    skin = np.concatenate([body.landmark_vertices, np.setdiff1d(body.skin, body.landmark_vertices)])
    x, y, z = body.mesh.vertices[skin].T
    cells = np.stack([np.sign(x) * (np.abs(x) // _CELL_M + 1), y // _CELL_M, z // _CELL_M], axis=1)
    _, first, cell = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    own = np.full(len(body.mesh.vertices), -1)
    own[skin] = cell.ravel()
    faces = own[body.mesh.faces]
    faces = faces[(faces >= 0).all(axis=1) & (faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    kept = skin[first]
    return replace(
        body,
        mesh=Mesh("the open body, coarse", body.mesh.vertices[kept], faces.astype(np.int32)),
        whole=body.whole.at(kept),
        landmark_vertices=own[body.landmark_vertices],
        skin=np.arange(len(kept)),
    )
