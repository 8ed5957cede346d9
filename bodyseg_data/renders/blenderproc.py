"""BlenderProc's files: one HDF5 a frame, as its version 2 writes them (`bproc.writer.write_hdf5`).

Read: depth (along the axis) or distance (along the ray); class_segmaps or category_id_segmaps, else instance_segmaps
with the categories of instance_attribute_maps; instance_segmaps also as the plane `instances`. The files hold neither
intrinsics nor names of classes: set.toml gives both. The projector is a second camera, with a folder of its own.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, BadSample, reported
from bodyseg_data.files import entries_of, refuse_special
from bodyseg_data.machine import required
from bodyseg_data.renders.images import MOST_NUMBERS
from bodyseg_data.renders.set_file import SetFile, read_rows
from bodyseg_data.renders.source import LABELS, PROJECTOR, RANGE, RenderSource, Stored, by_key

ENDINGS: Final = (".hdf5", ".h5")
_DEPTH, _DISTANCE = "depth", "distance"
_CLASSES: Final = ("class_segmaps", "category_id_segmaps")
_INSTANCES: Final = "instance_segmaps"
_ATTRIBUTES: Final = "instance_attribute_maps"
_PLANE: Final = "instances"


class BlenderProcRenders(RenderSource):
    """Renders of BlenderProc. Raises BadConfig for a file that is missing, MissingLibrary without h5py."""

    def __init__(self, folder: Path, content: SetFile) -> None:
        files = {RANGE: _frames(folder / content.camera)}
        if (folder / content.projector).is_dir():
            files[PROJECTOR] = _frames(folder / content.projector)
        super().__init__(content, read_rows(folder, content), files)
        if _INSTANCES in _datasets(self._files[RANGE][self._keys[0]]):
            self.planes = {_PLANE: "uint16"}

    def read(self, key: str) -> Mapping[str, Stored]:
        path = self._files[RANGE][key]
        data = _datasets(path)
        found = {RANGE: _range(data, path), LABELS: Stored(_labels(data, path), f"{path}, labels")}
        if _INSTANCES in data and self.planes:
            found[_PLANE] = Stored(data[_INSTANCES], f"{path}, {_INSTANCES}")
        if PROJECTOR in self._files:
            other = self._files[PROJECTOR][key]
            found[PROJECTOR] = _range(_datasets(other), other)
        return found


def _frames(folder: Path) -> dict[str, Path]:
    paths = [path for path in entries_of(folder) if path.suffix in ENDINGS] if folder.is_dir() else []
    if not paths:
        raise BadConfig(f"{folder}: BlenderProc writes {ENDINGS[0]} files, found none")
    return by_key((path.stem, path) for path in paths)


def _datasets(path: Path) -> dict[str, Any]:
    """Arrays of a frame by name, and its attribute maps as JSON. Raises BadSample, naming the file."""
    h5py = required("h5py", "reading HDF5 files", "renders")
    found: dict[str, Any] = {}
    with reported(f"{path}: cannot be read as HDF5", BadSample, Exception):
        refuse_special(path)
        with h5py.File(path, "r") as file:
            for name in (_DEPTH, _DISTANCE, *_CLASSES, _INSTANCES, _ATTRIBUTES):
                held = file.get(name)
                if isinstance(held, h5py.Dataset):
                    most = None if held.size is None else max(held.size, math.prod(held.chunks or ()))
                    elsewhere = held.external or held.is_virtual or held.file.filename != file.filename
                    if most is None or elsewhere or most * held.dtype.itemsize > MOST_NUMBERS * 8:
                        raise ValueError(f"{name} holds nothing, or more than an image can, or lies in another file")
                    found[name] = held[()]
            if _ATTRIBUTES in found:
                text = found[_ATTRIBUTES]
                found[_ATTRIBUTES] = json.loads(text if isinstance(text, str | bytes) else np.asarray(text).tobytes())
    for name, array in found.items():
        if name != _ATTRIBUTES and (np.ndim(array) != 2 or array.dtype.kind not in "uif"):
            stereo = ": the images of a stereo pair go into two folders" if np.ndim(array) == 3 else ""
            raise BadSample(f"{path}: {name} must be [H, W] of numbers, found {np.shape(array)}{stereo}")
    return found


def _range(data: Mapping[str, Any], path: Path) -> Stored:
    for name in (_DEPTH, _DISTANCE):
        if name in data:
            return Stored(data[name], f"{path}, {name}", ray=name == _DISTANCE)
    held = ", ".join(data) or "none of them"
    raise BadSample(f"{path}: a frame needs {_DEPTH} (bproc.renderer.enable_depth_output) or {_DISTANCE}, found {held}")


def _labels(data: Mapping[str, Any], path: Path) -> NDArray[Any]:
    """Category of every pixel. Raises BadSample, naming the file."""
    for name in _CLASSES:
        if name in data:
            image: NDArray[Any] = data[name]
            return image
    if _INSTANCES not in data or _ATTRIBUTES not in data:
        needs = f"{_CLASSES[0]} or {_CLASSES[1]} (bproc.renderer.enable_segmentation_output)"
        raise BadSample(f"{path}: a frame needs {needs}, or {_INSTANCES} with {_ATTRIBUTES}")
    try:
        categories = {int(each["idx"]): int(each["category_id"]) for each in data[_ATTRIBUTES]}
        found, places = np.unique(data[_INSTANCES], return_inverse=True)
        labels = np.array([categories[int(each)] for each in found])
    except (KeyError, TypeError, ValueError) as error:
        raise BadSample(f"{path}: {_ATTRIBUTES} must give idx and category_id of every instance: {error!r}") from None
    return labels[places].reshape(data[_INSTANCES].shape)
