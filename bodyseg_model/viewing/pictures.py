"""Content of a page at one moment: pictures, panels of one size with captions, and points and devices in space.

In space, x is to the right and y up as the sensor's camera looks, z towards it. Units are metres. Of a set, the origin
is the body's middle, which stands upright; of a recording, it is the camera.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from bodyseg_data.drawing import EMPTY, FAINT, INK, PAPER, THING, colour_shares, font
from bodyseg_data.labels import BACKGROUND, LabelMap, colour_labels
from bodyseg_data.rigs import Camera, PlacedCamera, Rig
from bodyseg_data.samples import View

Legend = tuple[tuple[str, tuple[int, int, int]], ...]
"""Name and sRGB of each colour."""

KIND_LEGEND: Final[Legend] = (
    ("right", (196, 200, 206)),
    ("left for right", (74, 124, 206)),
    ("front for back", (224, 161, 60)),
    ("both at once", (176, 48, 140)),
    ("any other part", (214, 60, 52)),
)
"""Name and sRGB of each of `KINDS` of predictions."""

CONFIDENCE_LEGEND: Final[Legend] = (
    ("confidence 0 %", (196, 40, 52)),
    ("50 %", (236, 196, 76)),
    ("100 %", (38, 150, 96)),
)
"""Three of the colours of confidences."""

WIDTH: Final = 1040
"""Width of a picture, pixels: more than twice that of its place on the page, for screens of high density."""

_GAP: Final = 8
_HEAD: Final = 32
_NOTE: Final = 82  # three lines: the words of a sensor's draws, such as "noise 2 mm, 0% missing, 13% in patches"
_MOST_ROWS: Final = 420

Viewpoint = Literal["points", "sensor", "camera"]
VIEWPOINTS: Final[tuple[Viewpoint, ...]] = get_args(Viewpoint)
"""What a window can look at: the points, the sensor with them, and both as the sensor's camera sees them."""

_DIRECTIONS: Final = {"points": (0.2, 0.1, 1.0), "sensor": (1.0, 0.35, 0.5), "camera": (0.0, 0.0, 1.0)}
_AROUND: Final = 1.12  # A window takes in so many times what it looks at
_LEAST_CONTRAST: Final = 1.6  # of a class's colour with white, the page, and with `EMPTY`, as WCAG 2 measures it
_GAP_M: Final = 0.01
_FEW: Final = 100
_SMALLEST_M: Final = 0.15
_NAME_M: Final = 0.13  # distance of a device and its name
_OPENCV: Final = np.diag([1.0, -1.0, -1.0])  # axes of a camera that looks along -z, rows: to its right, down, forward


# Pictures.


@dataclass(frozen=True)
class Panel:
    """An image with its name above and a note below. image: sRGB uint8 [H, W, 3]."""

    name: str
    image: NDArray[np.uint8] = field(repr=False)
    note: str = ""


@dataclass(frozen=True)
class Layout:
    """Lines of `columns` panels of images of `rows` x `width` pixels, the size that they are reduced to."""

    columns: int
    rows: int
    width: int

    @classmethod
    def of(cls, columns: int, shape: tuple[int, int]) -> Layout:
        """The layout of images of `shape` (rows, columns) as large as fit into `WIDTH`."""
        scale = min((WIDTH - _GAP * (columns + 1)) / columns / shape[1], _MOST_ROWS / shape[0])
        return cls(columns, max(1, round(shape[0] * scale)), max(1, round(shape[1] * scale)))

    def reduced(self, image: NDArray[Any]) -> NDArray[Any]:
        """An image [H, W, ...] in the size of a panel, by its nearest pixels: means would hide missing ones."""
        rows = ((np.arange(self.rows) + 0.5) * image.shape[0] / self.rows).astype(np.intp)
        columns = ((np.arange(self.width) + 0.5) * image.shape[1] / self.width).astype(np.intp)
        picked: NDArray[Any] = image[rows[:, None], columns]
        return picked

    def draw(self, lines: Sequence[Sequence[Panel]]) -> NDArray[np.uint8]:
        """All panels in one picture, sRGB uint8 [H, W, 3]; their images are of the size of `reduced`."""
        # Notes of the last line, such as of a user's own sensor, may have more than three lines.
        below = max(_NOTE // 3 * (1 + self._note(panel).count("\n")) - _NOTE for panel in lines[-1])
        sheet = Image.new("RGB", (WIDTH, self._line * len(lines) + max(0, below) + _GAP), PAPER)
        pen = ImageDraw.Draw(sheet)
        for number, line in enumerate(lines):
            for panel, (left, top, _, _) in zip(line, self.boxes(number), strict=False):
                pen.text((left, top - _HEAD), panel.name, INK, font=font(24))
                sheet.paste(Image.fromarray(panel.image), (left, top))
                pen.text((left, top + self.rows + 2), self._note(panel), FAINT, font=font(20))
        return np.asarray(sheet)

    def _note(self, panel: Panel) -> str:
        """A panel's note, divided at commas if it is wider than the panel's place."""
        fits = font(20).getlength(panel.note) <= WIDTH / self.columns - _GAP
        return panel.note if fits else panel.note.replace(", ", ",\n")

    def boxes(self, line: int) -> list[tuple[int, int, int, int]]:
        """Left, top, width and height of the images of a line in the picture."""
        cell, top = (WIDTH - _GAP) // self.columns, _GAP + line * self._line + _HEAD
        return [(_GAP + column * cell, top, self.width, self.rows) for column in range(self.columns)]

    @property
    def _line(self) -> int:
        return _HEAD + self.rows + _NOTE


def class_image(
    classes: NDArray[np.uint8], measured: NDArray[np.bool_], colours: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Classes in their colours, sRGB uint8 [H, W, 3]; what was measured and has no class is grey.

    classes: uint8 [H, W], rows of `colours`, uint8 [N, 3]; 255 where there is none. measured: bool [H, W].
    """
    image = colour_labels(classes, EMPTY, legible(colours))
    image[(classes == BACKGROUND) & measured] = THING
    return image


def luminance(colours: NDArray[Any]) -> NDArray[np.float64]:
    """Relative luminance of sRGB colours [..., 3], 0 to 1."""
    shares = np.asarray(colours, np.float64) / 255
    light = np.where(shares <= 0.04045, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
    return light @ [0.2126, 0.7152, 0.0722]


_EMPTY_LIGHT: Final = luminance(np.array(EMPTY)) + 0.05


def legible(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Colours, sRGB uint8 [N, 3], darkened or lightened where they would be lost on the white page or in `EMPTY`."""
    found = colours.astype(np.int64)
    while True:
        bright = luminance(found)[:, None]
        pale, dark = 1.05 / (bright + 0.05) < _LEAST_CONTRAST, bright + 0.05 < _LEAST_CONTRAST * _EMPTY_LIGHT
        if not (pale | dark).any():
            return found.astype(np.uint8)
        found = np.where(pale, found * 31 // 32, np.where(dark, 255 - (255 - found) * 31 // 32, found))


def share_image(shares: NDArray[np.float32], measured: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Shares from 0, red, through 0.5, yellow, to 1, green, sRGB uint8 [H, W, 3].

    shares: float32 [H, W], such as confidences. measured: bool [H, W]; elsewhere the image is nearly black.
    """
    colours = colour_shares(shares, np.array([colour for _, colour in CONFIDENCE_LEGEND]))
    colours[~measured] = EMPTY
    return colours


def class_legend(label_map: LabelMap) -> Legend:
    """The classes of a map with their numbers in label images."""
    colours = [(int(red), int(green), int(blue)) for red, green, blue in legible(label_map.colours)]
    names = [f"{number} {name}" for number, name in enumerate(label_map.names)]
    return tuple(zip(names, colours, strict=True))


def legend_html(entries: Legend, columns: int) -> str:
    """A legend as HTML, in columns from top to bottom."""
    square = "flex:none;width:12px;height:12px;border-radius:3px;background:rgb"
    lines = "".join(
        '<div style="break-inside:avoid;display:flex;gap:6px;align-items:center">'
        f'<span style="{square}{colour}"></span><span>{escape(name)}</span></div>'
        for name, colour in entries
    )
    style = f"columns:{columns};column-gap:10px;font-size:12px;line-height:1.5;padding:4px 8px"
    return f'<div style="{style}">{lines}</div>'


def facts_html(facts: Sequence[str], warning: str = "") -> str:
    """Lines of text as HTML, the first one bold; a warning, where there is one, in red above them."""
    lines = [f'<div style="color:#c22f2f;font-weight:600">{escape(warning)}</div>'] if warning else []
    lines += [f"<div><b>{escape(line)}</b></div>" for line in facts[:1]]
    lines += [f"<div>{escape(line)}</div>" for line in facts[1:]]
    return f'<div style="font-size:12px;line-height:1.45;padding:2px 8px">{"".join(lines)}</div>'


def sheet_of(picture: NDArray[np.uint8], view: NDArray[np.uint8], facts: Sequence[str]) -> Image.Image:
    """The picture of panels with the points as a browser drew them beside it, and facts above both.

    picture: sRGB uint8 [H, W, 3]. view: the same, of any size; it is scaled to the picture's height.
    """
    width = max(1, round(view.shape[1] * picture.shape[0] / view.shape[0]))
    line = 24
    top = line * len(facts) + 2 * _GAP
    sheet = Image.new("RGB", (picture.shape[1] + width, top + picture.shape[0]), PAPER)
    pen = ImageDraw.Draw(sheet)
    for number, fact in enumerate(facts):
        pen.text((_GAP, _GAP + number * line), fact, INK, font=font(17))
    sheet.paste(Image.fromarray(picture), (0, top))
    seen = Image.fromarray(np.ascontiguousarray(view))
    sheet.paste(seen.resize((width, picture.shape[0]), Image.Resampling.LANCZOS), (picture.shape[1], top))
    return sheet


# Space.


@dataclass(frozen=True)
class Points:
    """Coloured points. xyz: float32 [N, 3], metres; colours: sRGB uint8 [N, 3]."""

    xyz: NDArray[np.float32] = field(repr=False)
    colours: NDArray[np.uint8] = field(repr=False)


def points_at(range_m: NDArray[np.float32], placed: PlacedCamera) -> NDArray[np.float32]:
    """Points of the pixels that measured something, in reading order, float32 [N, 3].

    range_m: [H, W], metres along the optical axis, 0 = nothing measured.
    """
    return placed.points(range_m, *np.nonzero(range_m > 0)).astype(np.float32)


def point_gap_m(range_m: NDArray[np.float32], camera: Camera) -> float:
    """Distance of points of neighbouring pixels at the median of the ranges measured, metres; 1 cm if there is none.

    range_m: of the camera's pixels, metres, 0 = nothing measured.
    """
    seen = range_m[range_m > 0]
    return float(np.median(seen)) / camera.focal_px if len(seen) else _GAP_M


def rig_before(rig: Rig, view: View) -> tuple[PlacedCamera, ...]:
    """Camera and projectors of a view, seen from in front: the body is turned instead of the rig."""
    ahead = replace(view, azimuth_deg=0)
    one = [single.placed(np.zeros(3), ahead) for single in rig.by_projector()]
    return (one[0][0], *(projector for _, projector in one))


def camera_alone(camera: Camera) -> PlacedCamera:
    """A camera in the origin that looks along -z."""
    return PlacedCamera(camera, _OPENCV, np.zeros(3))


def viewpoint(
    xyz: NDArray[np.float32], devices: Sequence[PlacedCamera], kind: Viewpoint, fov_rad: float, aspect: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A place to look from and a point to look at, metres, float64 [3] each, that take in what `kind` says.

    xyz: of the points, float32 [N, 3]. fov_rad: vertical field of view of the window; aspect: its width over its
    height. "points": before them, a little beside and above the sensor's camera. "sensor": from the side, the points
    and all devices. "camera": the sensor's. The farthest hundredth of the points, as noise puts some, is left aside.
    """
    seen = np.asarray(xyz if len(xyz) else [[-1, -1, -1], [1, 1, 1]], np.float64)
    low, high = np.quantile(seen, (0.01, 0.99), axis=0)
    if kind == "camera" and devices:
        place = devices[0].position
        return place, np.array([*place[:2], (low[2] + high[2]) / 2])
    near = seen[((seen >= low) & (seen <= high)).all(axis=1)] if len(seen) > _FEW else seen
    if kind == "sensor":
        near = np.concatenate([near, *(each.position[None] for each in devices)])
    middle = (near.min(axis=0) + near.max(axis=0)) / 2
    towards = np.array(_DIRECTIONS[kind]) / np.linalg.norm(_DIRECTIONS[kind])
    across = np.cross([0.0, 1.0, 0.0], towards)
    across /= np.linalg.norm(across)
    side, up, ahead = (np.abs((near - middle) @ axis) for axis in (across, np.cross(towards, across), towards))
    half = np.tan(fov_rad / 2)
    away = np.max(ahead + np.maximum(side / aspect, np.maximum(up, _SMALLEST_M)) * _AROUND / half)
    return middle + float(away) * towards, middle


def name_heights(devices: Sequence[PlacedCamera]) -> list[float]:
    """Height of each device's name above the device, metres: names of devices that nearly coincide lie apart.

    The highest device has its name above it, of equally high ones the leftmost; the next ones have theirs below them.
    """
    order = sorted(devices, key=lambda each: (-round(float(each.position[1]), 1), float(each.position[0])))
    places = [next(place for place, other in enumerate(order) if other is each) for each in devices]
    return [-_NAME_M * place if place else _NAME_M for place in places]


@dataclass(frozen=True)
class Drawing:
    """Points, devices by their names, a picture of panels, sRGB uint8 [H, W, 3], and facts in lines of plain text.

    gap_m: distance of neighbouring points, metres, which their size on the page follows. bodies: number of the first
    points, which are of bodies, and to which a window is turned. legend: of the colours of the points.
    """

    points: Points
    devices: Mapping[str, PlacedCamera]
    picture: NDArray[np.uint8] = field(repr=False)
    facts: tuple[str, ...]
    gap_m: float
    bodies: int
    legend: Legend = field(repr=False)
