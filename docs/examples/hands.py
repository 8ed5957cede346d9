"""Renders of two hands over a table, whose classes are mirror images of each other: pyrender, trimesh, and no assets.

    python hands.py hands --scenes 40
    bodyseg shard --source renders --path hands --out hands-shards

Thirteen classes: palm and fingers of each hand, and the table. A flip of an image exchanges left and right, since
set.toml says which class is whose mirror image. Rig and rendering are those of robot_cell.py, which lies beside.
"""

import argparse
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from robot_cell import RIG, Cell, at, pyrender, rod, save
from trimesh.creation import box, icosphere
from trimesh.transformations import rotation_matrix, translation_matrix

from bodyseg_data import load_rig

PARTS = ("palm", "thumb", "index", "middle", "ring", "little")
SIDES = ("left", "right")
CLASSES = [*(f"{side} {part}" for side in SIDES for part in PARTS), "table"]


SET = """format = "bodyseg renders 1"
name = "hands"
rig = "rig.toml"
unit_m = 0.00025
"""


def set_file() -> str:
    """The content of set.toml: each class with its mirror image and the whole that it belongs to."""
    text = SET
    for name in CLASSES:
        text += f'\n[[classes]]\nname = "{name}"\n'
        if name != "table":
            side, part = name.split()
            text += f'mirror = "{SIDES[side == "left"]} {part}"\nwithin = "{side} hand"\n'
    return text


def hand(side: str, random: np.random.Generator) -> list[tuple[str, trimesh.Trimesh]]:
    """A hand in its own frame, palm down, fingers along y, metres; the left one is the right one mirrored in x."""
    palm = icosphere(subdivisions=3, radius=0.05)
    palm.apply_scale((0.9, 1.0, 0.35))
    found = [("palm", palm)]
    for number, part in enumerate(PARTS[1:]):
        thumb = part == "thumb"
        angle = -0.9 if thumb else 0.2 * (number - 2.5)
        bend = random.uniform(0.1, 0.4) if thumb else random.uniform(0.05, 0.7)
        start = np.array((-0.035, 0.0, 0.0) if thumb else (0.022 * (number - 2.5), 0.045, 0.0))
        pieces, whole = [], bend
        for length in (0.038, 0.026, 0.02):
            along = np.array([np.sin(angle) * np.cos(whole), np.cos(angle) * np.cos(whole), -np.sin(whole)])
            pieces.append(rod(start, start + length * along, 0.009))
            start, whole = start + length * along, whole + bend
        found.append((part, trimesh.util.concatenate(pieces)))
    for _, mesh in found:
        mesh.apply_scale((-1 if side == "left" else 1, 1, 1))
    return [(f"{side} {part}", mesh) for part, mesh in found]


def draw(key: str) -> tuple[list[tuple[str, trimesh.Trimesh]], np.ndarray]:
    """The objects of a scene, each with its class, and the pose of the rig, which looks down on the table."""
    random = np.random.default_rng(zlib.crc32(key.encode()))
    found = [("table", box((1.2, 0.8, 0.02), at(0, 0, -0.01)))]
    for side, x in (("left", -0.12), ("right", 0.12)):
        tilt = rotation_matrix(random.uniform(-0.4, 0.4), (0, 1, 0)) @ rotation_matrix(
            random.uniform(0, 0.4), (1, 0, 0)
        )
        pose = at(
            x + random.uniform(-0.03, 0.03),
            random.uniform(-0.05, 0.05),
            random.uniform(0.1, 0.2),
            random.uniform(-0.5, 0.5),
        )
        found += [(name, mesh.apply_transform(pose @ tilt)) for name, mesh in hand(side, random)]
    pose = translation_matrix((0, 0.04, random.uniform(0.6, 0.7))) @ np.diag([1, -1, -1, 1])
    return found, pose


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="a new folder")
    parser.add_argument("--scenes", type=int, default=40, help="number of scenes (default: 40)")
    parser.add_argument("--columns", type=int, default=640, help="width of the images; they are 4:3 (default: 640)")
    options = parser.parse_args(words)
    options.out.mkdir(parents=True, exist_ok=True)
    text = RIG.format(rows=options.columns * 3 // 4, columns=options.columns, focal_px=0.9 * options.columns)
    text = text.replace('"cell"', '"hands"').replace("2.8", "0.6").replace("0.25,", "0.05,").replace("0.25 m", "0.05 m")
    (options.out / "rig.toml").write_text(text)
    (options.out / "set.toml").write_text(set_file())
    rig = load_rig(options.out / "rig.toml")
    renderer = pyrender.OffscreenRenderer(rig.camera.columns, rig.camera.rows)
    with (options.out / "samples.jsonl").open("w") as table:
        for number in range(options.scenes):
            key = f"hands-{number:04d}"
            objects, pose = draw(key)
            scene = Cell(objects, CLASSES)
            range_m, instances = scene.see(renderer, rig.camera, pose)
            projector_range_m, _ = scene.see(renderer, rig.projector, pose)
            images = {"range_m": range_m, "projector_range_m": projector_range_m, "labels": scene.labels[instances]}
            split = "test" if number % 5 == 4 else "train"
            described = {"key": key, "split": split, "fields": {}, "planes": {"instances": instances}}
            table.write(save({**described, **images}, options.out, rig.range_step_m) + "\n")


if __name__ == "__main__":
    main()
