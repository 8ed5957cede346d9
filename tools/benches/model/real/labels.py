"""True labels of real frames: landmarks on the fused surface, its parts where they are certain, and both in frames."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.model.real.fusion import FusedSurface
from benches.model.real.recording import Floats, Frame
from bodyseg_data.core import BadConfig, BadLandmarks
from bodyseg_data.labels import BACKGROUND, LANDMARKS
from bodyseg_data.meshes import nearest_sources
from bodyseg_data.meshes.geodesics import FALLBACK_METHOD, Unanswerable

LANDMARK_FILE: Final = "landmarks.json"
"""Landmarks in a recording's own folder, which come before those that the bench brings along."""

KINECT_V1: Final = Path(__file__).with_name("kinect_v1.json")
"""Landmarks of the recording that docs/results/real_frames.md describes, placed by hand on its fused surface."""

OFF_SURFACE_M: Final = 0.03
"""Landmarks farther from the surface are refused."""

ON_SURFACE_M: Final = 0.01
"""Points of pixels farther from the surface get no label."""

Labels = NDArray[np.uint8]


@dataclass(frozen=True)
class Placements:
    """The landmarks that are seen, placed twice. names: of `parts.LANDMARKS`. first, second: float64 [N, 3], metres, in
    the world of the recording as it is stored, mirrored or not. left_out: [M, 3], where landmarks may be that cannot be
    placed, at their nearest to those that can: what is nearest to them gets no label.
    """

    names: tuple[str, ...]
    first: Floats
    second: Floats
    left_out: Floats = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def labels(self) -> NDArray[np.int64]:
        """The part of each landmark, int64 [N]."""
        return np.array([LANDMARKS.index(name) for name in self.names])

    @property
    def apart_m(self) -> Floats:
        """Distance of the two placements of each landmark, float64 [N], metres."""
        away: Floats = np.linalg.norm(self.first - self.second, axis=1)
        return away

    def mirrored(self) -> Placements:
        """The same in a world with left and right exchanged, where names are the person's own sides."""
        flip = np.array([-1.0, 1.0, 1.0])
        return Placements(self.names, self.first * flip, self.second * flip, self.left_out * flip)


def load_placements(folder: Path) -> Placements:
    """Read the placements in a recording's folder, or else those that the bench brings along for the Kinect v1's.

    Raises BadLandmarks for a file that cannot be read, names that are not landmarks, or two tables with other names.
    """
    path = folder / LANDMARK_FILE
    path = path if path.is_file() else KINECT_V1
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
        tables = [tree["first"], tree["second"], tree.get("left_out", {})]
        points = [np.array(list(table.values()), np.float64).reshape(-1, 3) for table in tables]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise BadLandmarks(f"landmarks {path}: needs 'first' and 'second', names with x, y, z: {error}") from error
    names = tuple(tables[0])
    if not names or tuple(tables[1]) != names or not {*names, *tables[2]} <= {*LANDMARKS}:
        raise BadLandmarks(f"landmarks {path}: both tables need the same names of the 33, found {tables}")
    return Placements(names, *points)


def surface_labels(
    surface: FusedSurface, points: Floats, labels: NDArray[np.int64], left_out: Floats | None = None
) -> Labels:
    """Part of every vertex, uint8 [V]: that of the nearest landmark along the surface; `BACKGROUND` where the rim is
    nearer, as a landmark that is not seen may lie just behind it, or a point of `left_out` [M, 3].

    points: [N, 3], metres, of the landmarks that are seen. labels: their parts, [N]. Every other landmark must lie
    beyond the rim, or no nearer than its point of `left_out`. Raises BadConfig if a landmark is not on the surface.
    """
    from scipy.spatial import KDTree

    tree = KDTree(surface.vertices)
    away, vertices = tree.query(points)
    if away.max() > OFF_SURFACE_M:
        worst = int(away.argmax())
        raise BadConfig(
            f"landmarks must lie within {1000 * OFF_SURFACE_M:g} mm of the fused surface, found "
            f"{LANDMARKS[labels[worst]]} at {1000 * away[worst]:.0f} mm: are they of this recording?"
        )
    unknown = surface.rim if left_out is None else np.concatenate([surface.rim, tree.query(left_out)[1]])
    rim = np.setdiff1d(unknown, vertices)
    sources = np.concatenate([vertices, rim])
    try:
        nearest = nearest_sources("exact", surface.vertices, surface.faces, sources)
    except Unanswerable:
        nearest = nearest_sources(FALLBACK_METHOD, surface.vertices, surface.faces, sources)
    part = np.concatenate([labels, np.full(len(rim), BACKGROUND)]).astype(np.uint8)
    found: Labels = part[nearest.source]
    found[~np.isfinite(nearest.distance)] = BACKGROUND
    return found


def frame_labels(frame: Frame, tree: Any, labels: Labels) -> Labels:
    """True labels of a frame, uint8 [H, W]: of the surface's vertex nearest to each of the person's pixels.

    tree: scipy's KDTree of the surface's vertices. labels: uint8 [V], theirs. `BACKGROUND` where no vertex is within
    `ON_SURFACE_M`, where the surface has none, and off the person.
    """
    image = np.full(frame.range_m.shape, BACKGROUND, np.uint8)
    away, vertices = tree.query(frame.points(), distance_upper_bound=ON_SURFACE_M)
    near = np.isfinite(away)
    image.ravel()[frame.pixels[near]] = labels[vertices[near]]
    return image


def repeatability(placements: Placements, first: Labels, second: Labels) -> dict[str, Any]:
    """Distances of the two placements, and the share of vertices with another label, of those that both label.

    first, second: uint8 [V], labels of the surface by either.
    """
    away = dict(zip(placements.names, (1000 * placements.apart_m).round(1).tolist(), strict=True))
    both = (first != BACKGROUND) & (second != BACKGROUND)
    return {
        "landmarks_mm": away,
        "mean_mm": round(1000 * float(placements.apart_m.mean()), 1),
        "worst_mm": round(1000 * float(placements.apart_m.max()), 1),
        "surface_with_another_label": round(float((first[both] != second[both]).mean()), 4),
    }
