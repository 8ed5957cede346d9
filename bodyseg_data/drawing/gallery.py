"""Gallery picture: many views of one or more sets, each as a shaded surface in the colours of its parts."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from bodyseg_data.artifacts import Scene
from bodyseg_data.core import BadConfig, generator
from bodyseg_data.drawing.style import EMPTY, FAINT, INK, PAPER, THING, draw_legend, font
from bodyseg_data.labels import PARTS33, LabelMap, colour_labels
from bodyseg_data.rigs import Camera
from bodyseg_data.samples import split_key

COLUMNS: Final = 12
_TILE_ROWS: Final = 320
_CAPTION: Final = 32
_HIGHER_CAPTION: Final = 46  # with pitch, roll and height
_GAP: Final = 6
_EDGE_M: Final = 0.03
"""Difference in range beyond which neighbouring pixels are on different surfaces."""

_BODY: Final = re.compile(r"(?P<source>[^-]+)-(?P<subject>[^-]+)-(?P<mesh>.+)")


def choose_views(keys: Sequence[str], count: int) -> list[int]:
    """Choose `count` samples for a gallery, as indices into `keys`, ascending by group and mesh.

    They are divided evenly among groups of subjects (P000, P001, … are one group) and, within each, among its meshes
    by name; the view of a mesh is a random draw seeded by its name. Samples whose keys name no view are one group, and
    each is a mesh. Raises BadConfig for a count outside 1 to the number of keys.
    """
    if not 1 <= count <= len(keys):
        raise BadConfig(f"a gallery of these sets shows 1 to {len(keys)} views, found {count}")
    groups: dict[str, dict[str, list[int]]] = {}
    for index, key in enumerate(keys):
        body, view = split_key(key)
        match = _BODY.fullmatch(body)
        if match is None or not view:
            groups.setdefault("", {})[key] = [index]
            continue
        group = f"{match['source']}-{re.sub('[0-9]+', '', match['subject'])}"
        groups.setdefault(group, {}).setdefault(match["mesh"], []).append(index)
    shares = dict.fromkeys(sorted(groups), 0)
    room = {name: sum(map(len, meshes.values())) for name, meshes in groups.items()}
    for _ in range(count):
        shares[min((name for name in shares if shares[name] < room[name]), key=lambda name: shares[name])] += 1
    return [index for name, share in shares.items() for index in _from_group(groups[name], share)]


def _from_group(meshes: dict[str, list[int]], share: int) -> list[int]:
    """Choose one view each of evenly spaced meshes, and more views of the same meshes if there are too few."""
    names = sorted(meshes)
    chosen: list[int] = []
    for name in names:
        generator(0, 0, name, "gallery").shuffle(meshes[name])
    for round_ in range(max(map(len, meshes.values()))):
        left = [meshes[name][round_] for name in names if round_ < len(meshes[name])]
        wanted = min(share - len(chosen), len(left))
        chosen += [left[(2 * number + 1) * len(left) // (2 * wanted)] for number in range(wanted)]
    return chosen


def draw_gallery(scenes: Sequence[Scene], title: str, label_map: LabelMap = PARTS33) -> Image.Image:
    """Draw a grid of views, twelve a line, with a caption below each and a legend of the classes; RGB."""
    tiles = [_tile(scene, label_map) for scene in scenes]
    width = max(tile.width for tile in tiles)
    lines = -(-len(tiles) // COLUMNS)
    columns = min(COLUMNS, len(tiles))
    legend = draw_legend(max(columns * (width + _GAP), 900), label_map)
    words = [(scene.sample.info.view.words if scene.sample.info.view else "").split(", ") for scene in scenes]
    plain = all(len(each) <= 2 for each in words)
    top, step = 44, _TILE_ROWS + (_CAPTION if plain else _HIGHER_CAPTION) + _GAP
    picture = Image.new("RGB", (legend.width + 2 * _GAP, top + lines * step + legend.height + _GAP), PAPER)
    pen = ImageDraw.Draw(picture)
    pen.text((_GAP + 2, 10), title, INK, font=font(18))
    for number, (scene, tile) in enumerate(zip(scenes, tiles, strict=True)):
        left, upper = _GAP + number % COLUMNS * (width + _GAP), top + number // COLUMNS * step
        picture.paste(tile, (left, upper))
        info = scene.sample.info
        named = ", ".join(str(info.get(name)) for name in ("subject", "pose") if info.get(name)) or scene.sample.key
        pen.text((left + 2, upper + _TILE_ROWS + 2), named[:26], INK, font=font(11))
        where = ", ".join(filter(None, (*words[number][:2], info.split)))
        pen.text((left + 2, upper + _TILE_ROWS + 15), where, FAINT, font=font(11))
        pen.text((left + 2, upper + _TILE_ROWS + 29), ", ".join(words[number][2:]), FAINT, font=font(9))
    picture.paste(legend, (_GAP, picture.height - legend.height - _GAP))
    return picture


def _tile(scene: Scene, label_map: LabelMap) -> Image.Image:
    sample = scene.sample
    foreground = sample.range > 0
    canvas = np.full((*sample.range.shape, 3), EMPTY, np.uint8)
    shade = surface_shading(sample.range, scene.step_m, scene.rig.camera)[foreground]
    canvas[foreground] = np.clip(
        colour_labels(sample.labels, THING, label_map.colours)[foreground] * (0.35 + 0.7 * shade[:, None]), 0, 255
    )
    picture = Image.fromarray(canvas)
    return picture.resize((round(picture.width * _TILE_ROWS / picture.height), _TILE_ROWS), Image.Resampling.LANCZOS)


def surface_shading(image: NDArray[np.uint16], step_m: float, camera: Camera) -> NDArray[np.float64]:
    """Lambertian shading, float64 [H, W], 0 to 1, by a light a little above and left of the camera.

    image: uint16 [H, W], range in steps of `step_m` metres, 0 background. A normal is the cross product of the
    differences to the neighbours right and below (or left and above, where those are on another surface). Background
    is 0.
    """
    depth = image.astype(np.float64) * step_m
    rows, columns = image.shape
    x = (np.arange(columns) + 0.5 - camera.centre_px[0]) / camera.focal_px
    y = (np.arange(rows) + 0.5 - camera.centre_px[1]) / camera.focal_px
    points = np.stack([depth * x, depth * y[:, None], depth], axis=-1)
    normals = np.cross(_slope(points, axis=0), _slope(points, axis=1))
    length = np.linalg.norm(normals, axis=-1)
    light = np.array([-0.3, -0.45, -1.0]) / np.linalg.norm([-0.3, -0.45, -1.0])
    shade = np.divide(normals @ light, length, out=np.zeros_like(depth), where=length > 0)
    shade[image == 0] = 0
    clipped: NDArray[np.float64] = np.clip(shade, 0, 1)
    return clipped


def _slope(points: NDArray[np.float64], axis: int) -> NDArray[np.float64]:
    """Difference to the next or from the previous point along `axis`, whichever is nearer in range, [H, W, 3]."""
    change = np.diff(points, axis=axis)
    edge = np.zeros_like(np.take(points, [0], axis))
    ahead, behind = np.concatenate([change, edge], axis), np.concatenate([edge, change], axis)
    last, first = [slice(None)] * 2, [slice(None)] * 2
    last[axis], first[axis] = slice(-1, None), slice(0, 1)
    reach_ahead, reach_behind = np.abs(ahead[..., 2]), np.abs(behind[..., 2])
    reach_ahead[tuple(last)], reach_behind[tuple(first)] = np.inf, np.inf
    chosen = np.where((reach_ahead <= reach_behind)[..., None], ahead, behind)
    chosen[np.minimum(reach_ahead, reach_behind) > _EDGE_M] = 0
    smooth: NDArray[np.float64] = chosen
    return smooth
