"""Files of Isaac Sim's Replicator, as the BasicWriter of omni.replicator.core 1.x writes them.

    distance_to_image_plane_0000.npy or distance_to_camera_0000.npy            metres, along the axis or along the ray
    semantic_segmentation_0000.png, semantic_segmentation_labels_0000.json     in colours or as numbers
    camera_params_0000.json                                                    intrinsics and pose

Of one render product they lie in the camera's folder, of several in PRODUCT/ANNOTATOR/; both are read. The projector is
a second camera with its own folder. Classes come from labels' files, rigs from cameras', unless set.toml names them.
"""

import math
import re
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, BadSample, reported
from bodyseg_data.files import Table, read_json
from bodyseg_data.labels import BACKGROUND, classes_of
from bodyseg_data.renders.images import read_array
from bodyseg_data.renders.set_file import LabelTable, SetFile, read_rows
from bodyseg_data.renders.source import LABELS, PROJECTOR, RANGE, RenderSource, Stored, by_key
from bodyseg_data.rigs import RANGE_STEP_MM, Camera, Rig
from bodyseg_data.samples import Value

AXIS, RAY = "distance_to_image_plane", "distance_to_camera"
_IMAGE: Final = "semantic_segmentation"
_SUFFIX: Final = "_labels"
_MEANINGS: Final = _IMAGE + _SUFFIX
_PARAMS: Final = "camera_params"
_NONE: Final = ("BACKGROUND", "UNLABELLED")
_POSE: Final = "camera_pose"
_KEY: Final = re.compile(
    r"(?P<number>\d{1,9})|\((?P<red>\d{1,3}), ?(?P<green>\d{1,3}), ?(?P<blue>\d{1,3})(, ?\d{1,3})?\)"
)
_TO_OURS: Final = np.diag([1.0, -1.0, -1.0, 1.0])  # USD's cameras look along -z, with y up


class IsaacRenders(RenderSource):
    """Renders of Isaac Sim. Raises BadConfig for a file that is missing or that another writer wrote."""

    def __init__(self, folder: Path, content: SetFile) -> None:
        camera, lights = folder / content.camera, folder / content.projector
        files = {RANGE: _distances(camera), LABELS: _needed(camera, _IMAGE, ".png")}
        files[_MEANINGS] = _needed(camera, _MEANINGS, ".json")
        if lights.is_dir():
            files[PROJECTOR] = _distances(lights)
        params = {kind: frames(home, _PARAMS, ".json") for kind, home in ((_PARAMS, camera), (PROJECTOR, lights))}
        if params[_PARAMS]:
            files[_PARAMS] = params[_PARAMS]
        names = {name for path in files[_MEANINGS].values() for name in _meanings(path).values() if name not in _NONE}
        self._away, self._step_mm = content.stand_off_m, content.range_step_mm or RANGE_STEP_MM
        rigs = None
        if not content.rigs:
            if not all(path.keys() >= files[RANGE].keys() for path in params.values()):
                made = f"a rig is made of {_PARAMS}_*.json where every frame of camera and projector has one"
                raise BadConfig(f"{content.path}: 'rig' is missing; {made}")
            rigs = {key: self._rig(params[_PARAMS][key], params[PROJECTOR][key]) for key in files[RANGE]}
        classes = None if content.classes else classes_of(sorted(names), "isaac")
        super().__init__(content, read_rows(folder, content), files, classes, rigs)
        if _PARAMS in files:
            self.fields = {_POSE: "numbers", **self.fields}

    def read(self, key: str) -> Mapping[str, Stored]:
        found = {}
        for kind in (RANGE, LABELS, PROJECTOR):
            if kind in self._files:
                path = self._files[kind][key]
                found[kind] = Stored(read_array(path), str(path), path.name.startswith(RAY))
        return found

    def table(self, key: str) -> LabelTable:
        """Meaning of the numbers and colours of a frame. Raises BadSample, naming the file."""
        path = self._files[_MEANINGS][key]
        numbers: dict[int, int] = {}
        colours: dict[int, int] = {}
        for words, name in _meanings(path).items():
            if name not in (*_NONE, *self.classes.names):
                raise BadSample(f"{path}: {name!r} is no class of {self._content.path.name}")
            label = BACKGROUND if name in _NONE else self.classes.names.index(name)
            match = _KEY.fullmatch(words)
            if match is None:
                raise BadSample(f"{path}: a key must be like '3' or the colour '(140, 25, 255, 255)', found {words!r}")
            if match["number"]:
                numbers[int(match["number"])] = label
            else:
                red, green, blue = map(int, match.group("red", "green", "blue"))
                colours[red << 16 | green << 8 | blue] = label
        return LabelTable(numbers, colours, path.name)

    def further(self, key: str) -> Mapping[str, Value]:
        """The camera's pose: rotation and position in the world, rows of [3, 4], x right, y down, z forward, metres."""
        if _PARAMS not in self._files:
            return {}
        pose = np.linalg.inv(_camera(self._files[_PARAMS][key])[1])[:3]
        return {_POSE: tuple(map(float, pose.ravel()))}

    def _rig(self, camera: Path, projector: Path) -> Rig:
        """The rig of one frame, in its camera's frame; rounded, so that all frames of a rig give the same."""
        (eye, to_camera), (light, to_light), away = _camera(camera), _camera(projector), self._away
        between = (to_light @ np.linalg.inv(to_camera))[:3]  # the camera's frame -> the projector's
        position = -between[:, :3].T @ between[:, 3]
        placed = position, position + away * between[2, :3], -between[1, :3]
        vectors = [tuple(round(float(x), 6) + 0.0 for x in vector) for vector in placed]
        with reported(f"{camera} and {projector} are no rig", BadConfig):
            seen = _device(eye, (0.0, 0.0, 0.0), (0.0, 0.0, away))
            return Rig("isaac", away, seen, _device(light, *vectors), self._step_mm)


def frames(folder: Path, annotator: str, ending: str) -> dict[str, Path]:
    """Files of an annotator in a folder, or in its folder of that name, by the frame's number."""
    pattern = re.compile(rf"{annotator}_([0-9_]+){re.escape(ending)}")
    homes = [home for home in (folder, folder / annotator.removesuffix(_SUFFIX)) if home.is_dir()]
    matches = [(pattern.fullmatch(path.name), path) for home in homes for path in sorted(home.iterdir())]
    return by_key((match[1], path) for match, path in matches if match is not None)


def _distances(folder: Path) -> dict[str, Path]:
    return frames(folder, AXIS, ".npy") or _needed(folder, RAY, ".npy")


def _needed(folder: Path, annotator: str, ending: str) -> dict[str, Path]:
    found = frames(folder, annotator, ending)
    if not found:
        option = annotator.removesuffix(_SUFFIX)
        raise BadConfig(f"{folder}: a frame needs {annotator}_*{ending} (BasicWriter with {option}=True), found none")
    return found


def _meanings(path: Path) -> dict[str, str]:
    """Key -> name of the class of a labels' file, whose entries are {"class": name} or the name. Raises BadConfig."""
    found = {}
    for key, entry in read_json(path).items():
        value = (entry.get("class") or next(iter(entry.values()), None)) if isinstance(entry, dict) else entry
        if not isinstance(value, str):
            raise BadConfig(f"{path}: {key!r} must name a class, found {entry!r:.60}")
        found[key] = value
    return found


@lru_cache(maxsize=64)
def _camera(path: Path) -> tuple[tuple[int, int, float], NDArray[np.float64]]:
    """Rows, columns and focal length, pixels, and the matrix [4, 4] from world to camera, metres. Raises BadConfig."""
    table = Table(read_json(path), str(path))
    if "cameraModel" in table and (model := table.text("cameraModel")) not in ("pinhole", ""):
        raise BadConfig(f"{path}: 'cameraModel' must be pinhole, not F-Theta or another fisheye, found {model!r}")
    columns, rows = (int(side) for side in table.numbers("renderProductResolution", 2))
    width = table.numbers("cameraAperture", 2)[0]
    focal_px = table.positive("cameraFocalLength") / width * columns if width > 0 else 0.0
    if "cameraApertureOffset" in table and any(table.numbers("cameraApertureOffset", 2)):
        raise BadConfig(f"{path}: an aperture with an offset is not read: name the rig in set.toml")
    view = np.array(table.numbers("cameraViewTransform", 16)).reshape(4, 4).T  # USD multiplies points as rows
    axes = view[:3, :3]
    if not (np.allclose(axes @ axes.T, np.eye(3), atol=1e-3) and math.isclose(np.linalg.det(axes), 1, abs_tol=1e-2)):
        raise BadConfig(f"{path}: 'cameraViewTransform' must turn and move only, found one that mirrors or scales")
    placed = _TO_OURS @ view
    placed[:3, 3] *= table.positive("metersPerSceneUnit") if "metersPerSceneUnit" in table else 1.0
    return (rows, columns, focal_px), placed


def _device(eye: tuple[int, int, float], position: Any, aim: Any, up: Any = (0.0, -1.0, 0.0)) -> Camera:
    rows, columns, focal_px = eye
    return Camera(rows, columns, round(focal_px, 6), (columns / 2, rows / 2), position, aim, up)
