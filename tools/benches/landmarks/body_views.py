"""Pictures of labelled bodies from four sides, to check landmarks and parts by eye."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from bodyseg_data.drawing import FAINT, INK, PAPER, THING, draw_legend, font
from bodyseg_data.labels import colour_labels
from bodyseg_data.meshes import Mesh, Partition
from bodyseg_data.rendering import open_renderer
from bodyseg_data.rigs import Camera, PlacedCamera, axes_at

LabelledBody = tuple[str, Mesh, Partition, NDArray[np.int64]]
"""A body to draw: title, mesh, partition, landmarks int64 [33]."""

SIDES: Final = (("front", 0), ("its left", 90), ("back", 180), ("its right", 270))
"""Caption and azimuth in degrees of each view."""

HEIGHTS_PX: Final = range(100, 4001)
"""Allowed heights of a body in the picture, pixels."""

_DISTANCE_M: Final = 12.0  # far enough that the four views have nearly one scale
_SUPERSAMPLING: Final = 3  # factor of rendering before reduction, for smooth outlines
_MARGIN: Final = 26
_BODY_MARGIN: Final = 34  # room for numbers beside the body
_TITLE_HEIGHT: Final = 58
_NUMBER_SIZE: Final = 11
_DOT: Final = 3
_FREE_PX: Final = 4  # a number this close to its dot needs no line
_OCCLUSION_TOLERANCE_M: Final = 0.008

Box = tuple[float, float, float, float]


def draw_body_views(bodies: Sequence[LabelledBody], height_px: int = 600) -> Image.Image:
    """Draw one RGB picture with a row for each body, from its front, left, back and right, and a legend of the parts.

    height_px: of a body in the picture, one of `HEIGHTS_PX`. A dot with the label as a number marks every landmark on
    the sides that it faces. Raises MissingLibrary without embreex.
    """
    rows = [_row(body, height_px) for body in bodies]
    legend = draw_legend(max(max(row.width for row in rows), 1000) - 2 * _MARGIN)
    width = legend.width + 2 * _MARGIN
    picture = Image.new("RGB", (width, sum(row.height for row in rows) + legend.height + 2 * _MARGIN), PAPER)
    top = 0
    for row in rows:
        picture.paste(row, ((width - row.width) // 2, top))
        top += row.height
    picture.paste(legend, (_MARGIN, top + _MARGIN))
    return picture


def draw_side(body: LabelledBody, azimuth_deg: int, pixels_per_m: float) -> Image.Image:
    """Draw one body from one side with dots and numbers, RGB. azimuth_deg: 0 front, 90 its left, 180 back."""
    image, dots = draw_parts(body, azimuth_deg, pixels_per_m)
    _mark(image, dots)
    return image


def draw_parts(
    body: LabelledBody, azimuth_deg: int, pixels_per_m: float
) -> tuple[Image.Image, dict[int, tuple[float, float]]]:
    """Draw one body from one side without marks, RGB, and locate the landmarks that are seen.

    azimuth_deg: as for `draw_side`. Returns the image, and by label the pixel (x, y) of every landmark that faces the
    viewer with nothing before it.
    """
    _, mesh, parts, landmarks = body
    normals = mesh.vertex_normals
    camera = _camera(mesh, azimuth_deg, pixels_per_m)
    renderer = open_renderer("embree", mesh)
    fine = PlacedCamera(camera.camera.scaled(_SUPERSAMPLING), camera.axes, camera.position)
    seen = renderer.render(fine)
    renderer.close()

    rows, columns = np.nonzero(seen.face >= 0)
    faces = seen.face[rows, columns]
    points = fine.points(seen.range, rows, columns)
    weights = mesh.barycentric(faces, points)
    facing = np.einsum("nk,nkd->nd", weights, normals[mesh.faces[faces]])
    facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-12)
    light = np.array([-0.35, -0.5, -1.0]) @ camera.axes  # from above the viewer's left shoulder
    brightness = 0.42 + 0.62 * np.clip(facing @ (light / np.linalg.norm(light)), 0, 1)
    canvas = np.empty((*seen.face.shape, 3), np.uint8)
    canvas[:] = PAPER
    colours = colour_labels(parts.labels_at(mesh, faces, points)[None], THING)[0]  # as an image of one row
    canvas[rows, columns] = np.clip(colours * brightness[:, None], 0, 255)
    image = Image.fromarray(canvas).reduce(_SUPERSAMPLING)

    pixels, ranges = camera.project(mesh.vertices[landmarks])
    towards = -(normals[landmarks] @ camera.axes[2])
    fine_rows, fine_columns = (np.floor(pixels[:, axis] * _SUPERSAMPLING).astype(np.int64) for axis in (1, 0))
    nearest = seen.range[fine_rows, fine_columns]  # the image holds the whole body, so every landmark is inside
    visible = (towards > 0.12) & ((nearest == 0) | (ranges < nearest + _OCCLUSION_TOLERANCE_M))
    return image, {int(label): (float(x), float(y)) for label, (x, y) in enumerate(pixels) if visible[label]}


def _row(body: LabelledBody, height_px: int) -> Image.Image:
    title, mesh, _, _ = body
    pixels_per_m = height_px / float(np.ptp(mesh.surface_vertices[:, 1]))
    views = [draw_side(body, azimuth, pixels_per_m) for _, azimuth in SIDES]
    width = sum(view.width for view in views) + 2 * _MARGIN
    row = Image.new("RGB", (width, _TITLE_HEIGHT + views[0].height), PAPER)
    draw = ImageDraw.Draw(row)
    draw.text((width / 2, 24), title, INK, font=font(20), anchor="mm")
    left = _MARGIN
    for (caption, _), view in zip(SIDES, views, strict=True):
        row.paste(view, (left, _TITLE_HEIGHT))
        draw.text((left + view.width / 2, _TITLE_HEIGHT - 6), caption, FAINT, font=font(14), anchor="mm")
        left += view.width
    return row


def _camera(mesh: Mesh, azimuth_deg: int, pixels_per_m: float) -> PlacedCamera:
    """Distant camera whose image contains the body and a margin."""
    axes = axes_at(azimuth_deg)
    local = (mesh.surface_vertices - mesh.centre) @ axes.T
    size = 2 * np.abs(local[:, :2]).max(axis=0) * pixels_per_m * 1.05 + 2 * _BODY_MARGIN  # nearer looks larger
    columns, rows = (math.ceil(side) for side in size)
    camera = Camera(rows, columns, pixels_per_m * _DISTANCE_M, (columns / 2, rows / 2), (0, 0, 0), (0, 0, 1))
    return PlacedCamera(camera, axes, mesh.centre - _DISTANCE_M * axes[2])


def _mark(image: Image.Image, dots: dict[int, tuple[float, float]]) -> None:
    """Draw dots, by label, and their numbers where they cover no other dot or number."""
    draw = ImageDraw.Draw(image)
    small = font(_NUMBER_SIZE)
    taken: list[Box] = [(x - _DOT - 1, y - _DOT - 1, x + _DOT + 1, y + _DOT + 1) for x, y in dots.values()]
    plates: list[tuple[Box, int]] = []
    for label, (x, y) in sorted(dots.items(), key=lambda item: item[1][1]):
        width, height = draw.textlength(str(label), small) + 7, _NUMBER_SIZE + 4
        plate = _label_box(x, y, width, height, image.size, taken)
        taken.append(plate)
        plates.append((plate, label))
    for plate, label in plates:
        x, y = dots[label]
        near = (min(max(x, plate[0]), plate[2]), min(max(y, plate[1]), plate[3]))
        if math.dist(near, (x, y)) > _DOT + _FREE_PX:
            draw.line([(x, y), near], INK, 1)
    for x, y in dots.values():
        draw.ellipse([x - _DOT, y - _DOT, x + _DOT, y + _DOT], "white", INK)
    for plate, label in plates:
        draw.rounded_rectangle(plate, 4, "white", INK)
        middle = ((plate[0] + plate[2]) / 2, (plate[1] + plate[3]) / 2)
        draw.text(middle, str(label), INK, font=small, anchor="mm")


def _label_box(x: float, y: float, width: float, height: float, size: tuple[int, int], taken: list[Box]) -> Box:
    """Nearest free box for a number around (x, y), outwards first; an overlapping one only if none is free."""
    outwards = 1 if x >= size[0] / 2 else -1
    first: Box | None = None
    for gap in (3, 9, 16, 24, 34, 46):
        for right, down in ((1, 0), (0.8, -0.8), (0.8, 0.8), (0, -1), (0, 1), (-1, 0), (-0.8, -0.8), (-0.8, 0.8)):
            middle_x = x + outwards * right * (_DOT + gap + width / 2)
            middle_y = y + down * (_DOT + gap + height / 2)
            box = (middle_x - width / 2, middle_y - height / 2, middle_x + width / 2, middle_y + height / 2)
            first = first or box
            within = box[0] >= 1 and box[1] >= 1 and box[2] < size[0] - 1 and box[3] < size[1] - 1
            if within and not any(_overlap(box, other) for other in taken):
                return box
    return first if first is not None else (x, y, x, y)


def _overlap(a: Box, b: Box) -> bool:
    return a[0] < b[2] + 1 and b[0] < a[2] + 1 and a[1] < b[3] + 1 and b[1] < a[3] + 1
