"""`bench clothes`: roughness of dressed bodies as the rig sees them, beside bare ones and a scanned man in clothes."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from benches.measuring import counter
from bodyseg_data.bodies import Body, open_source
from bodyseg_data.bodies.sources.open_bodies import OpenBodies
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.labels import PARTS
from bodyseg_data.rendering.embree import EmbreeRenderer
from bodyseg_data.rigs import load_rig
from bodyseg_data.samples import View

FRAMES: Final = 4
"""Frames of each motion, evenly."""

AZIMUTHS: Final = (0, 90, 180, 270)
_DISTANCE_CM: Final = 255
_WINDOW_PX: Final = 15  # 5 cm at that distance
_STEP_PX: Final = 5
_EDGE_M: Final = 0.08  # a window with more range than this holds the edge of a limb
_ROUNDING_M: Final = 1e-5  # bodies are rounded to the micrometre
_PERCENTILES: Final = (25, 50, 75, 95)
_BARE: Final = ("Sellion", "Nuchale", "Supramenton", "Dactylion", "Digit II")
"""Parts of head, hands and feet, which no outfit covers."""

Floats = NDArray[np.float64]


def bench_clothes(mit: Path | None = None, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Roughness and looseness of the outfits of subjects B and C.

    roughness_mm: percentiles of the standard deviation of range in windows of 5 x 5 cm on trunk and limbs, after the
    best quadratic surface is taken away. distance_mm: percentiles of the distance between dressed and bare vertices.
    mit: folder of MIT frames to measure beside them. Raises BadConfig.
    """
    source = OpenBodies()
    bodies = {subject: [body for body in source.bodies() if body.subset == subject] for subject in ("B", "C")}
    scanned = [] if mit is None else _scanned(open_source("mit", mit))
    advance = counter(progress, sum(len(_chosen(listed)) for listed in bodies.values()) + len(scanned))
    figures: dict[str, Any] = {}
    for subject, listed in bodies.items():
        rough: dict[str, list[Floats]] = {"dressed": [], "bare": []}
        away = []
        for ref in _chosen(listed):
            dressed, bare = source.build(ref), source.build(ref, dressed=False)
            rough["dressed"].append(roughness(dressed))
            rough["bare"].append(roughness(bare))
            away.append(_away(dressed, bare))
            advance()
        moved = np.concatenate(away)
        figures[subject] = {
            "roughness_mm": {name: _percentiles(np.concatenate(values)) for name, values in rough.items()},
            "distance_mm": _percentiles(moved[moved > 0] * 1e3),
        }
    if scanned:
        values = []
        for body in scanned:
            values.append(roughness(body))
            advance()
        figures["scanned man"] = {"roughness_mm": _percentiles(np.concatenate(values))}
    return {"bodies": figures, "frames_per_motion": FRAMES, "azimuths": list(AZIMUTHS), "distance_cm": _DISTANCE_CM}


def roughness(body: Body) -> Floats:
    """Standard deviation, mm, of the range in every window that sees trunk and limbs only, after a quadratic fit."""
    rig = load_rig()
    parts = body.partition()
    bare = np.array([part.label for part in PARTS if part.landmark.endswith(_BARE)])
    renderer = EmbreeRenderer(body.mesh)
    found = []
    for azimuth in AZIMUTHS:
        camera, _ = rig.placed(body.mesh.centre, View(_DISTANCE_CM, azimuth))
        seen = renderer.render(camera)
        rows, columns = np.nonzero(seen.face >= 0)
        points = camera.points(seen.range, rows, columns)
        wanted = np.zeros(seen.face.shape, np.bool_)
        wanted[rows, columns] = ~np.isin(parts.labels_at(body.mesh, seen.face[rows, columns], points), bare)
        found.append(_residuals(seen.range, wanted))
    return np.concatenate(found)


def _residuals(image: NDArray[np.float32], wanted: NDArray[np.bool_]) -> Floats:
    shape = (_WINDOW_PX, _WINDOW_PX)
    windows = sliding_window_view(image, shape)[::_STEP_PX, ::_STEP_PX].reshape(-1, _WINDOW_PX**2)
    whole = sliding_window_view(wanted, shape)[::_STEP_PX, ::_STEP_PX].all(axis=(2, 3)).ravel()
    windows = windows[whole].astype(np.float64)
    windows = windows[np.ptp(windows, axis=1) < _EDGE_M]
    y, x = np.indices(shape).reshape(2, -1) / (_WINDOW_PX // 2) - 1.0
    surfaces, _ = np.linalg.qr(np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1))
    residuals = windows - (windows @ surfaces) @ surfaces.T
    spread: Floats = residuals.std(axis=1) * 1e3
    return spread


def _scanned(source: Any) -> list[Body]:
    return [source.build(body) for body in _evenly([body for body in source.bodies() if body.subset == "B"])]


def _evenly(frames: list[Any]) -> list[Any]:
    return [frames[index * len(frames) // FRAMES] for index in range(FRAMES)]


def _chosen(listed: list[Any]) -> list[Any]:
    """FRAMES frames of every motion, evenly."""
    motions: dict[str, list[Any]] = {}
    for body in listed:
        motions.setdefault(body.pose, []).append(body)
    return [frame for frames in motions.values() for frame in _evenly(frames)]


def _away(dressed: Body, bare: Body) -> Floats:
    """Distance [V] between dressed and bare vertices; both are centred afresh, so the bare head aligns them."""
    offset = np.median(dressed.mesh.vertices - bare.mesh.vertices, axis=0)
    away: Floats = np.linalg.norm(dressed.mesh.vertices - bare.mesh.vertices - offset, axis=1)
    away[away < _ROUNDING_M] = 0
    return away


def _percentiles(values: Floats) -> dict[str, float]:
    return {f"{share}%": round(float(np.percentile(values, share)), 2) for share in _PERCENTILES}
