"""Reader of all kinds of landmark files: JSON by vertex, JSON by coordinate, and CAESAR's .lnd."""

from __future__ import annotations

from pathlib import Path

from bodyseg_data.core.errors import BadLandmarks
from bodyseg_data.meshes.landmarks.by_point import PointLandmarks, parse_points
from bodyseg_data.meshes.landmarks.by_vertex import LandmarkSet, json_table, parse_landmarks, read_text
from bodyseg_data.meshes.landmarks.caesar import read_lnd


def load_landmark_file(path: Path) -> LandmarkSet | PointLandmarks:
    """Read a landmark file: .lnd (or .lnd.gz), or .json, by vertex or, if it has "points", by coordinate.

    Raises BadLandmarks, naming the file and, where there is one, the landmark at fault.
    """
    name = path.name.lower().removesuffix(".gz")
    if name.endswith(".lnd"):
        return read_lnd(path)
    if path.suffix.lower() != ".json":
        raise BadLandmarks(f"a landmark file must be .json, .lnd or .lnd.gz, found {path}")
    text = read_text(path)
    return (parse_points if "points" in json_table(text, str(path)) else parse_landmarks)(text, str(path))
