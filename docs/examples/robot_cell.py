"""Renders of a robot cell with 12 classes, as a camera and a projector see it: pyrender, trimesh, and no assets.

    python robot_cell.py renders --scenes 60              folders of images, for `bodyseg shard --source renders`
    python robot_cell.py my-shards --scenes 60 --shards   the same scenes straight into shards

Each scene is drawn by its key, so any part of them can be rendered anywhere: `--first 30` goes on after scene 29. Every
fifth is for testing. docs/tutorials/your_renders.md goes on from here to a network. Without a screen pyrender draws
through EGL.
"""

import argparse
import json
import os
import sys
import warnings
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.creation import box, cylinder, icosphere
from trimesh.transformations import rotation_matrix, translation_matrix

from bodyseg_data import Camera, Rig, ShardWriter, load_rig

if sys.platform.startswith("linux") and "DISPLAY" not in os.environ:
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # pyrender's last release uses features that Python deprecates
    import pyrender

CLASSES = [
    *("floor", "wall", "table", "conveyor", "robot base", "upper arm", "forearm", "gripper"),
    *("box", "bin", "post", "person"),
]


RIG = """# The camera, and a projector 0.25 m beside it; both aim at a point 2.8 m away.
format = "bodyseg rig 1"
name = "cell"
stand_off_m = 2.8
range_step_mm = 0.25

[camera]
rows = {rows}
columns = {columns}
focal_px = {focal_px}

[projector]
rows = {rows}
columns = {columns}
focal_px = {focal_px}
position_m = [-0.25, 0.0, 0.0]
aims_at_m = [0.0, 0.0, 2.8]
"""

SET = """format = "bodyseg renders 1"
name = "robot cell"
classes = {classes}
rig = "rig.toml"
unit_m = 0.00025                      # of the numbers in range/ and projector/
"""


def at(x: float, y: float, z: float, yaw: float = 0.0) -> np.ndarray:
    """A pose in the cell: z up, metres; yaw in radians."""
    return translation_matrix((x, y, z)) @ rotation_matrix(yaw, (0, 0, 1))


def rod(start: np.ndarray, end: np.ndarray, radius: float) -> trimesh.Trimesh:
    """A cylinder from one point to another, with round ends."""
    ends = [icosphere(subdivisions=2, radius=radius).apply_translation(point) for point in (start, end)]
    return trimesh.util.concatenate([cylinder(radius, segment=(start, end), sections=24), *ends])


def draw_cell(key: str) -> tuple[list[tuple[str, trimesh.Trimesh]], np.ndarray, dict[str, object]]:
    """The objects of a scene, each with its class; the camera's pose, 4 x 4, x right, y down, z forward; the fields."""
    random = np.random.default_rng(zlib.crc32(key.encode()))
    found: list[tuple[str, trimesh.Trimesh]] = []

    def add(name: str, *pieces: trimesh.Trimesh) -> None:
        found.append((name, trimesh.util.concatenate(pieces)))

    add("floor", box((9, 9, 0.02), at(0, 0, -0.01)))
    add("wall", box((3.6, 0.1, 2.1), at(-0.9, 1.9, 1.05)), box((0.1, 4, 2.1), at(-2.6, 0, 1.05)))
    legs = [box((0.05, 0.05, 0.7), at(x, y, 0.35)) for x in (0.05, 1.05) for y in (-0.55, 0.05)]
    add("table", box((1.15, 0.75, 0.04), at(0.55, -0.25, 0.72)), *legs)
    supports = [box((0.08, 0.4, 0.55), at(x, 0.85, 0.275)) for x in (-1, 0, 1)]
    rims = [box((2.6, 0.03, 0.08), at(0, y, 0.66)) for y in (0.62, 1.08)]
    add("conveyor", box((2.6, 0.46, 0.1), at(0, 0.85, 0.6)), *supports, *rims)

    base = np.array([-0.55, 0.05, 0.0])
    add(
        "robot base",
        cylinder(0.2, 0.06, transform=at(*base)),
        cylinder(0.13, 0.75, transform=at(*np.add(base, (0, 0, 0.375)))),
    )
    yaw, shoulder, elbow = random.uniform(-1.2, 1.0), random.uniform(0.3, 1.2), random.uniform(-1.9, -0.8)
    out = np.array([np.cos(yaw), np.sin(yaw), 0])
    joints = [np.add(base, (0, 0, 0.82))]
    for length, angle in ((0.5, shoulder), (0.45, shoulder + elbow), (0.1, shoulder + elbow - 0.4)):
        joints.append(joints[-1] + length * (np.cos(angle) * out + (0, 0, np.sin(angle))))
    add("upper arm", rod(joints[0], joints[1], 0.075))
    add("forearm", rod(joints[1], joints[2], 0.055))
    across, along = np.cross(out, (0, 0, 1)), joints[3] - joints[2]
    fingers = [rod(joints[3] + side * across, joints[3] + side * across + along, 0.014) for side in (-0.045, 0.045)]
    add(
        "gripper",
        rod(joints[2], joints[3], 0.045),
        rod(joints[3] - 0.05 * across, joints[3] + 0.05 * across, 0.025),
        *fingers,
    )

    boxes = int(random.integers(3, 8))
    for number in range(boxes):
        size = random.uniform(0.08, 0.24, 3)
        on_table = number % 2 == 0
        x, y, z = (
            (random.uniform(0.15, 0.95), random.uniform(-0.5, 0), 0.74)
            if on_table
            else (random.uniform(-1, 1.1), 0.85, 0.65)
        )
        add("box", box(size, at(x, y, z + size[2] / 2, random.uniform(0, 3))))
    side, x, y = 0.4, random.uniform(-1.3, -0.9), random.uniform(-0.6, -0.3)
    walls = [box((side, 0.02, 0.35), at(x, y + s * side / 2, 0.18)) for s in (-1, 1)]
    walls += [box((0.02, side, 0.35), at(x + s * side / 2, y, 0.18)) for s in (-1, 1)]
    add("bin", box((side, side, 0.02), at(x, y, 0.01)), *walls)
    posts = [cylinder(0.02, 1.3, transform=at(x, 1.3, 0.65)) for x in np.arange(-1.8, 1.9, 0.6)]
    add("post", *posts, box((3.6, 0.03, 0.03), at(0, 1.3, 1.28)), box((3.6, 0.03, 0.03), at(0, 1.3, 0.7)))
    if has_person := bool(random.random() < 0.6):
        add(
            "person",
            person(random).apply_transform(
                at(random.uniform(1.3, 1.6), random.uniform(-0.4, 0.5), 0, random.uniform(-3, 3))
            ),
        )

    azimuth, height = random.uniform(-0.6, 0.5), random.uniform(1.3, 2.2)
    position = np.array([2.7 * np.sin(azimuth), 0.2 - 2.7 * np.cos(azimuth), height])
    forward = np.array([0.15, 0.2, 0.65]) + random.uniform(-0.1, 0.1, 3) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, position], axis=1)
    fields = {"boxes": boxes, "person": has_person, "camera_height_m": float(round(height, 3))}
    return found, pose, fields


def person(random: np.random.Generator) -> trimesh.Trimesh:
    """Somebody who stands, arms wherever they are, in one mesh."""
    points = {"hip": (0.1, 0, 0.9), "foot": (0.13, 0, 0.08), "shoulder": (0.2, 0, 1.4)}
    pieces = [
        rod(np.array([0, 0, 0.95]), np.array([0, 0, 1.35]), 0.15),
        icosphere(3, 0.12).apply_translation((0, 0, 1.65)),
    ]
    for side in (-1, 1):
        hip, foot, shoulder = (np.array(points[name]) * (side, 1, 1) for name in points)
        elbow = shoulder + 0.28 * unit(random.normal((side, 1, -2), 1))
        hand = elbow + 0.3 * unit(random.normal((0, 2, 0), 1))
        pieces += [rod(hip, foot, 0.075), rod(shoulder, elbow, 0.05), rod(elbow, hand, 0.04)]
    return trimesh.util.concatenate(pieces)


def unit(vector: np.ndarray) -> np.ndarray:
    """The vector's direction."""
    return vector / np.linalg.norm(vector)


class Cell:
    """A scene in pyrender. objects: as `draw_cell` gives them. classes: names in the order of their labels."""

    def __init__(self, objects: list[tuple[str, trimesh.Trimesh]], classes: Sequence[str] = CLASSES) -> None:
        self.labels = np.array([255, *(classes.index(name) for name, _ in objects)], np.uint8)
        self.scene = pyrender.Scene(bg_color=(0, 0, 0, 0))
        self.colours = {}
        for number, (_, mesh) in enumerate(objects, start=1):
            node = self.scene.add(pyrender.Mesh.from_trimesh(mesh, smooth=False))
            self.colours[node] = (number & 255, number >> 8, 0)

    def see(
        self, renderer: pyrender.OffscreenRenderer, device: Camera, pose: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Range along the optical axis, float32 [H, W], metres, 0 for nothing; and the object's number, uint16 [H, W].

        pose: of the rig, 4 x 4. By segmentation pyrender draws one sample a pixel, so borders are not mixed.
        """
        own = np.eye(4)
        own[:3, :3], own[:3, 3] = device.axes.T, device.position_m
        eye = pyrender.IntrinsicsCamera(device.focal_px, device.focal_px, *device.centre_px, znear=0.3, zfar=12)
        node = self.scene.add(eye, pose=pose @ own @ np.diag([1, -1, -1, 1]))  # OpenGL: y up, looking along -z
        flags = pyrender.RenderFlags.SEG | pyrender.RenderFlags.SKIP_CULL_FACES
        seen, depth = renderer.render(self.scene, flags, self.colours)
        self.scene.remove_node(node)
        return depth.astype(np.float32), seen[..., 0].astype(np.uint16) | seen[..., 1].astype(np.uint16) << 8


def scenes(first: int, count: int, rig: Rig) -> Iterator[dict[str, Any]]:
    """Arguments of `ShardWriter.write`, scene by scene."""
    height = max(rig.camera.rows, rig.projector.rows)
    renderer = pyrender.OffscreenRenderer(rig.camera.columns, height)
    for number in range(first, first + count):
        key = f"cell-{number:04d}"
        objects, pose, fields = draw_cell(key)
        cell = Cell(objects)
        range_m, instances = cell.see(renderer, rig.camera, pose)
        projector_range_m, _ = cell.see(renderer, rig.projector, pose)
        yield {
            "key": key,
            "range_m": range_m,
            "labels": cell.labels[instances],
            "projector_range_m": projector_range_m,
            "planes": {"instances": instances},
            "split": "test" if number % 5 == 4 else "train",
            "fields": fields,
        }


def save(scene: dict[str, Any], out: Path, step_m: float) -> str:
    """Write the images of a scene as PNGs of 16 bits, and labels of 8, and return its row of the table."""
    ranges = {"range": scene["range_m"], "projector": scene["projector_range_m"]}
    images = {name: np.rint(image.astype(np.float64) / step_m).astype(np.uint16) for name, image in ranges.items()}
    images |= {"labels": scene["labels"], "planes/instances": scene["planes"]["instances"]}
    for folder, image in images.items():
        (out / folder).mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(out / folder / f"{scene['key']}.png")
    return json.dumps({"key": scene["key"], "split": scene["split"], **scene["fields"]})


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="a new folder")
    parser.add_argument("--scenes", type=int, default=60, help="number of scenes (default: 60)")
    parser.add_argument("--first", type=int, default=0, help="number of the first one (default: 0)")
    parser.add_argument("--columns", type=int, default=640, help="width of the images; they are 4:3 (default: 640)")
    parser.add_argument("--shards", action="store_true", help="write shards instead of folders of images")
    options = parser.parse_args(words)
    rows, focal_px = options.columns * 3 // 4, 0.9 * options.columns
    text = RIG.format(rows=rows, columns=options.columns, focal_px=focal_px)
    options.out.mkdir(parents=True, exist_ok=True)
    rig_file = options.out.with_name(f"{options.out.name}-rig.toml") if options.shards else options.out / "rig.toml"
    rig_file.write_text(text)
    rig = load_rig(rig_file)
    rendered = scenes(options.first, options.scenes, rig)
    if options.shards:
        with ShardWriter(options.out, rig=rig, classes=CLASSES, source="robot cell") as out:
            for scene in rendered:
                out.write(**scene)
        return
    (options.out / "set.toml").write_text(SET.format(classes=json.dumps(CLASSES)))
    with (options.out / "samples.jsonl").open("a" if options.first else "w") as table:
        for scene in rendered:
            table.write(save(scene, options.out, rig.range_step_m) + "\n")


if __name__ == "__main__":
    main()
