"""Small scenes rendered by ray casting, and written to folders as other programs lay out theirs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from bodyseg_data.rigs import Camera, Rig

CAMERA = Camera(16, 20, 24.0, (10.0, 8.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
PROJECTOR = Camera(24, 30, 36.0, (15.0, 12.0), (0.3, 0.0, 0.0), (0.1, 0.0, 1.5))
RIG = Rig("cell", 1.5, CAMERA, PROJECTOR)
NAMES = ["floor", "arm", "box"]

RIG_TOML = """format = "bodyseg rig 1"
name = "cell"
stand_off_m = 1.5
[camera]
rows = 16
columns = 20
focal_px = 24.0
[projector]
rows = 24
columns = 30
focal_px = 36.0
position_m = [0.3, 0.0, 0.0]
aims_at_m = [0.1, 0.0, 1.5]
"""
SET_TOML = """format = "bodyseg renders 1"
classes = ["floor", "arm", "box"]
first_label = 1
background = [0]
rig = "rig.toml"
unit_m = 0.001
"""


def seen_by(device: Camera, number: int) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Range in metres along the axis, 0 for nothing, and labels (255 for nothing) of scene `number`: a floor, an
    upright arm and a box, all boxes along the axes of the rig.
    """
    shift = 0.05 * (number % 3)
    boxes = [((-1.0, 0.35, 1.0), (1.0, 0.4, 2.2)), ((-0.4, -0.3, 1.3), (-0.25, 0.3, 1.45))]
    boxes.append(((0.1 + shift, 0.05, 1.4), (0.35 + shift, 0.35, 1.7)))
    rays = device.pixel_rays() @ device.axes
    nearest, labels = np.full(rays.shape[:2], np.inf), np.full(rays.shape[:2], 255, np.uint8)
    for label, (low, high) in enumerate(boxes):
        with np.errstate(divide="ignore"):
            ends = np.stack([(np.array(corner) - device.position_m) / rays for corner in (low, high)])
        enter, leave = ends.min(axis=0).max(axis=2), ends.max(axis=0).min(axis=2)
        hit = (enter <= leave) & (enter > 0) & (enter < nearest)
        nearest[hit], labels[hit] = enter[hit], label
    return np.where(np.isfinite(nearest), nearest, 0.0), labels


def millimetres(range_m: NDArray[np.float64]) -> NDArray[np.uint16]:
    return np.rint(1000 * range_m).astype(np.uint16)


def save(path: Path, image: NDArray[Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix in (".png", ".tif"):
        Image.fromarray(image).save(path)
    elif path.suffix == ".npz":
        np.savez(path, image=image)
    elif path.suffix == ".exr":
        import OpenEXR

        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"ViewLayer.Depth.Z": np.ascontiguousarray(image)}).write(str(path))
    else:
        np.save(path, image)


def write_set(folder: Path, text: str = SET_TOML) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "set.toml").write_text(text)
    (folder / "rig.toml").write_text(RIG_TOML)


def plain(folder: Path, count: int = 4, ending: str = ".png", table: bool = True) -> Path:
    """The plain layout: ranges in millimetres, labels from 1 on, the last scene of the split test."""
    write_set(folder)
    for number in range(count):
        key = f"scene-{number:03d}"
        (range_m, labels), (lit, _) = seen_by(CAMERA, number), seen_by(PROJECTOR, number)
        for kind, image in (("range", range_m), ("projector", lit)):
            stored = millimetres(image) if ending in (".png", ".tif") else 1000 * image.astype(np.float32)
            save(folder / kind / f"{key}{ending}", stored)
        save(folder / "labels" / f"{key}.png", np.where(labels == 255, 0, labels + 1).astype(np.uint8))
    if table:
        rows = [
            {
                "key": f"scene-{n:03d}",
                "split": "test" if n == count - 1 else "train",
                "robot": f"r{n % 2}",
                "tilt_deg": 2 * n,
            }
            for n in range(count)
        ]
        rows[-1]["split"] = "test"
        (folder / "samples.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def along_ray(range_m: NDArray[np.float64], device: Camera) -> NDArray[np.float32]:
    """Distances along the rays, 1e10 for nothing, as Blender writes them."""
    distance = range_m * np.linalg.norm(device.pixel_rays(), axis=2)
    return np.where(range_m > 0, distance, 1e10).astype(np.float32)


def blenderproc(folder: Path, count: int = 3, distance: bool = False, labels_as: str = "class_segmaps") -> Path:
    """BlenderProc's files, the projector's in a folder of its own."""
    import h5py

    write_set(folder, SET_TOML.replace("unit_m = 0.001\n", ""))
    (folder / "projector").mkdir()
    for number in range(count):
        for home, device in ((folder, CAMERA), (folder / "projector", PROJECTOR)):
            range_m, labels = seen_by(device, number)
            categories = np.where(labels == 255, 0, labels + 1).astype(np.uint8)
            attributes = [{"idx": 0, "category_id": 0, "name": "World"}]
            attributes += [{"idx": i, "category_id": i, "name": f"Cube.{i:03d}"} for i in (1, 2, 3)]
            with h5py.File(home / f"{number}.hdf5", "w") as file:
                depth = np.where(range_m > 0, range_m, 1e10).astype(np.float32)
                if distance:
                    file.create_dataset("distance", data=along_ray(range_m, device), compression="gzip")
                else:
                    file.create_dataset("depth", data=depth, compression="gzip")
                file.create_dataset(labels_as, data=categories, compression="gzip")
                file.create_dataset("instance_attribute_maps", data=np.bytes_(json.dumps(attributes)))
                file.create_dataset("colors", data=np.zeros((*range_m.shape, 3), np.uint8))
    return folder


def view_transform(device: Camera, unit_m: float) -> list[float]:
    """USD's matrix from the world, here the rig's frame, to a camera that looks along -z, for points as rows."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ device.axes
    matrix[:3, 3] = -matrix[:3, :3] @ device.position_m / unit_m
    return [float(x) for x in matrix.T.ravel()]


def isaac(folder: Path, count: int = 3, colours: bool = True, ray: bool = False, nested: bool = False) -> Path:
    """The files of BasicWriter, of a stage in centimetres."""
    palette = {255: (0, 0, 0, 0), 0: (140, 25, 255, 255), 1: (25, 255, 82, 255), 2: (255, 111, 25, 255)}
    kind = "distance_to_camera" if ray else "distance_to_image_plane"
    for number in range(count):
        for home, device in ((folder, CAMERA), (folder / "projector", PROJECTOR)):
            range_m, labels = seen_by(device, number)
            meant = {
                label: name.upper() if label == 255 else name
                for label, name in {**dict(enumerate(NAMES)), 255: "background"}.items()
            }
            ids = {255: 0, 0: 2, 1: 3, 2: 5}
            there = np.unique(labels).tolist()
            stored = along_ray(range_m, device) if ray else range_m.astype(np.float32)
            stored[range_m == 0] = np.inf
            image = np.zeros((*labels.shape, 4), np.uint8) if colours else np.zeros(labels.shape, np.uint16)
            for label in there:
                image[labels == label] = palette[label] if colours else ids[label]
            words = {str(palette[label] if colours else ids[label]): {"class": meant[label]} for label in there}
            params = {
                "cameraAperture": [20.0, 16.0],
                "cameraApertureOffset": [0.0, 0.0],
                "cameraFocalLength": 24.0,
                "cameraModel": "pinhole",
                "cameraViewTransform": view_transform(device, 0.01),
                "metersPerSceneUnit": 0.01,
                "renderProductResolution": [device.columns, device.rows],
            }

            def path(name: str, ending: str, home: Path = home, number: int = number) -> Path:
                annotator = name.removesuffix("_labels")
                found = (home / annotator if nested else home) / f"{name}_{number:04d}{ending}"
                found.parent.mkdir(parents=True, exist_ok=True)
                return found

            np.save(path(kind, ".npy"), stored)
            Image.fromarray(image).save(path("semantic_segmentation", ".png"))
            path("semantic_segmentation_labels", ".json").write_text(json.dumps(words))
            path("camera_params", ".json").write_text(json.dumps(params))
    return folder
