"""Frames of one still person from all round, each with its camera, and the person's pixels in them.

A frame is NAME_depth.png, in millimetres, with NAME_camera.xml beside it: OpenCV's XML with the matrices `intrinsic`,
`R` and `t`, where a point of the world is R times a point of the camera's frame plus t.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benches.measuring import evenly_spaced
from bodyseg_data.core import BadConfig
from bodyseg_data.rigs import Camera, PlacedCamera
from bodyseg_model.recordings import find_frames, to_metres
from bodyseg_model.segmentation import Background, find_bodies

BACKGROUND: Final = Background("limits", 0.4, 1.2)
"""The person is what is nearer than 1.2 m, whatever finds people: the recordings are of one who turns so near."""

_DEPTH: Final = "_depth"
_STEP_M: Final = 0.001
_SQUARE: Final = 0.01  # largest difference of the focal lengths, as a share
_ROTATION: Final = 1e-3  # largest error of a matrix that is to be a rotation
_JUMP_M: Final = 0.02  # between pixels two apart: more is an edge
_MIRROR: Final = np.diag([-1.0, 1.0, 1.0])

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Frame:
    """One frame. range_m: float32 [H, W], metres, 0 = nothing measured. pixels: int64 [N], the person's, ascending,
    row * W + column. placed: its camera in the world.
    """

    name: str
    range_m: NDArray[np.float32]
    pixels: NDArray[np.intp]
    placed: PlacedCamera

    def local_points(self, pixels: NDArray[np.intp]) -> Floats:
        """Points that `pixels` [N] see, in the camera's frame, float64 [N, 3], metres."""
        camera = self.placed.camera
        row, column = np.divmod(pixels, camera.columns)
        depth = self.range_m.ravel()[pixels].astype(np.float64)
        x, y = column + 0.5 - camera.centre_px[0], row + 0.5 - camera.centre_px[1]
        return np.stack([x / camera.focal_px * depth, y / camera.focal_px * depth, depth], axis=1)

    def points(self, pixels: NDArray[np.intp] | None = None) -> Floats:
        """Points that the person's pixels, or some `pixels` [N], see, in the world, float64 [N, 3], metres."""
        local = self.local_points(self.pixels if pixels is None else pixels)
        return local @ self.placed.axes + self.placed.position

    def normals(self) -> Floats:
        """Unit normals of the person's pixels in the camera's frame, towards it, float64 [N, 3]; NaN beside edges.

        Cross products of the differences of points two pixels apart.
        """
        image = np.full((*self.range_m.shape, 3), np.nan)
        image.reshape(-1, 3)[self.pixels] = self.local_points(self.pixels)
        rows, columns = np.divmod(self.pixels, self.range_m.shape[1])
        above, below = np.maximum(rows - 1, 0), np.minimum(rows + 1, self.range_m.shape[0] - 1)
        left, right = np.maximum(columns - 1, 0), np.minimum(columns + 1, self.range_m.shape[1] - 1)
        across, down = image[rows, right] - image[rows, left], image[below, columns] - image[above, columns]
        for step in (across, down):
            step[np.linalg.norm(step, axis=1) > _JUMP_M] = np.nan
        normal = np.cross(down, across)  # x right, y down: towards the camera
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        found: Floats = normal / np.where(length > 0, length, np.nan)
        return found

    def mirrored(self) -> Frame:
        """The frame with left and right exchanged, in a world with left and right exchanged."""
        columns = self.range_m.shape[1]
        row, column = np.divmod(self.pixels, columns)
        lens = self.placed.camera
        camera = replace(lens, centre_px=(columns - lens.centre_px[0], lens.centre_px[1]))
        placed = PlacedCamera(camera, _MIRROR @ self.placed.axes @ _MIRROR, _MIRROR @ self.placed.position)
        flipped = np.ascontiguousarray(self.range_m[:, ::-1])
        return Frame(self.name, flipped, np.sort(row * columns + columns - 1 - column), placed)


def read_recording(folder: Path, count: int) -> list[Frame]:
    """Read `count` frames with cameras from a folder, evenly over it, all if there are fewer, as they are, in natural
    order of names; those without a person are left out.

    Raises BadConfig for a folder without such frames, a frame or camera that cannot be read, a camera without square
    pixels or rotation, or if no frame shows a person.
    """
    frames = []
    files = [file for file in find_frames([folder]) if file.name.endswith(_DEPTH)]
    if not files:
        raise BadConfig(f"a recording needs frames NAME{_DEPTH}.png with NAME_camera.xml, found none in {folder}")
    for file in evenly_spaced(files, count):
        range_m = to_metres(file.read(), _STEP_M)
        name = file.name.removesuffix(_DEPTH)
        placed = _camera(folder / f"{name}_camera.xml", (range_m.shape[0], range_m.shape[1]))
        bodies = find_bodies(range_m, placed.camera, BACKGROUND)
        if bodies:
            frames.append(Frame(name, range_m, bodies[0].pixels, placed))
    if not frames:
        raise BadConfig(f"a recording needs a person, found none in the frames in {folder}")
    return frames


def _camera(path: Path, shape: tuple[int, int]) -> PlacedCamera:
    try:
        tree = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError) as error:
        raise BadConfig(f"cannot read the camera {path}: {error}") from error
    lens = _matrix(tree, "intrinsic", (3, 3), path)
    rotation, move = _matrix(tree, "R", (3, 3), path), _matrix(tree, "t", (3,), path)
    if abs(lens[0, 0] / lens[1, 1] - 1) > _SQUARE:
        raise BadConfig(f"{path}: pixels must be square, found focal lengths {lens[0, 0]:g} and {lens[1, 1]:g} px")
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _ROTATION or np.linalg.det(rotation) < 0:
        raise BadConfig(f"{path}: 'R' must be a rotation, found {rotation.tolist()}")
    centre = float(lens[0, 2]), float(lens[1, 2])
    camera = Camera(*shape, float(lens[0, 0]), centre, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    return PlacedCamera(camera, rotation.T, move)


def _matrix(tree: ElementTree.Element, name: str, shape: tuple[int, ...], path: Path) -> Floats:
    text = tree.findtext(f"{name}/data", "")
    try:
        return np.array(text.split(), np.float64).reshape(shape)
    except ValueError:
        raise BadConfig(f"{path}: {name!r} must hold {np.prod(shape)} numbers, found {text.strip()!r}") from None
