"""The transforms that ship: crop, crop to the body, horizontal flip, roll and zoom of the camera, remnants of a wall.

Of a moved image, a pixel takes its value from the nearest one of the image as it was, so none lies between surfaces.
"""

import math
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, replace
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import Checked, bounded, uniform
from bodyseg_data.labels import BACKGROUND, NOWHERE, TEMPLATE, looked_up
from bodyseg_data.loading.transform import Box, CameraImage, Transform, ends_of
from bodyseg_data.rigs import MAX_SIDE
from bodyseg_data.samples import FARTHEST_STEPS

Place = Literal["axis", "body", "anywhere"]
_FARTHEST: Final = int(FARTHEST_STEPS)
_CELL: Final = 4  # side of the squares of pixels that are remnants or not


@dataclass(frozen=True)
class Crop(Checked, Transform):
    """A window of `rows` x `columns` pixels, unscaled; what lies outside of the image is background.

    at: "axis" centres the window on the optical axis, at which bodies are rendered. "body" centres it on the box of the
    labelled pixels, or on the axis if there are none; the box is that of the image with artifacts, so windows of two
    variants may differ where pixels are lost at the body's outline. "anywhere" draws its place inside the image,
    uniformly; where the window is longer than the image, the image's place inside the window. Ranges stay as they are.
    Raises BadConfig for a size or a place out of range.
    """

    name = "crop"
    version = 2
    rows: int = bounded(MISSING, 1, MAX_SIDE)
    columns: int = bounded(MISSING, 1, MAX_SIDE)
    at: Place = "axis"

    def shape(self, rows: int, columns: int) -> tuple[int, int]:
        return self.rows, self.columns

    def __call__(self, image: CameraImage, random: np.random.Generator) -> CameraImage:
        if self.at == "anywhere":
            height, width = image.range.shape
            top, left = _anywhere(uniform(random), height - self.rows), _anywhere(uniform(random), width - self.columns)
        else:
            x, y = image.centre_px
            if self.at == "body" and (box := image.body_box) is not None:
                x, y = (box[2] + box[3]) / 2, (box[0] + box[1]) / 2
            top, left = round(y - self.rows / 2), round(x - self.columns / 2)
        return take_window(image, top, left, self.rows, self.columns)


def _anywhere(drawn: float, spare: int) -> int:
    """A first pixel, from 0 to `spare`, the pixels that the image has more than the window; both may be negative."""
    place = int(drawn * (abs(spare) + 1))
    return place if spare >= 0 else -place


@dataclass(frozen=True)
class BodyCrop(Checked, Transform):
    """The smallest window that holds the body with a margin, scaled to `rows` x `columns` pixels.

    margin: width of the border around the box of the labelled pixels, as a share of the box's height and width, 0 to 1.
    The window has the aspect ratio of the result and the centre of the box; outside of the image it holds background.
    If the image has no labels, the window holds all of it. Pixels take the value of the nearest one; ranges stay as
    they are, and the focal length in pixels grows with the scale. The box is that of the image with artifacts, so the
    windows of two variants may differ slightly. Raises BadConfig for a size or a margin out of range.
    """

    name = "body_crop"
    version = 2
    rows: int = bounded(MISSING, 1, MAX_SIDE)
    columns: int = bounded(MISSING, 1, MAX_SIDE)
    margin: float = bounded(0.1, 0, 1)

    def shape(self, rows: int, columns: int) -> tuple[int, int]:
        return self.rows, self.columns

    def __call__(self, image: CameraImage, random: np.random.Generator) -> CameraImage:
        top, bottom, left, right = image.body_box or (0, image.range.shape[0], 0, image.range.shape[1])
        larger = 1 + 2 * self.margin
        scale = min(self.rows / (larger * (bottom - top)), self.columns / (larger * (right - left)))
        first_row = (top + bottom) / 2 - self.rows / scale / 2
        first_column = (left + right) / 2 - self.columns / scale / 2
        x, y = image.centre_px
        return take_grid(
            image,
            first_row + (np.arange(self.rows) + 0.5) / scale,
            first_column + (np.arange(self.columns) + 0.5) / scale,
            focal_px=image.focal_px * scale,
            centre_px=((x - first_column) * scale, (y - first_row) * scale),
        )


@dataclass(frozen=True)
class Flip(Checked, Transform):
    """The image mirrored left to right.

    Labels of classes that are mirror images of each other (`LabelClass.mirror`) are exchanged, and so are points of the
    map of the body.
    share: of the samples that are mirrored, 0 to 1; drawn for each. The body seen is then the mirror image of the one
    rendered. Shadows of the projector lie on the other side, as of a rig whose projector stands there. Raises BadConfig
    for a share out of range.
    """

    name = "flip"
    version = 2
    share: float = bounded(0.5, 0, 1)

    def __call__(self, image: CameraImage, random: np.random.Generator) -> CameraImage:
        if uniform(random) >= self.share:
            return image
        planes = {name: plane[:, ::-1] for name, plane in image.planes.items()}
        if image.has_map:
            from bodyseg_data.bodies import load_template  # loads meshes, which streaming does not need

            planes[TEMPLATE] = load_template().mirrored.take(planes[TEMPLATE])
        return replace(
            image,
            range=np.ascontiguousarray(image.range[:, ::-1]),
            labels=looked_up(image.labels[:, ::-1], image.classes.mirrored),
            centre_px=(image.range.shape[1] - image.centre_px[0], image.centre_px[1]),
            planes=planes,
        )


@dataclass(frozen=True)
class Roll(Checked, Transform):
    """The image that the camera takes when turned about its optical axis; what leaves the image is lost.

    largest_deg: largest angle either way, degrees, 0 to 180; the angle is drawn uniformly. Positive angles turn the
    camera clockwise as seen from behind it (`View.roll_deg`), and the body in the image the other way. Ranges are along
    the axis and stay as they are. Pixels take the value of the nearest one. Noise and shadows turn with the image, as
    if the projector were turned, too. Raises BadConfig for an angle out of range.
    """

    name = "roll"
    version = 3
    largest_deg: float = bounded(15.0, 0, 180)

    def __call__(self, image: CameraImage, random: np.random.Generator) -> CameraImage:
        angle = self.largest_deg * (2 * uniform(random) - 1)
        return turned(image, angle) if angle else image


@dataclass(frozen=True)
class Zoom(Checked, Transform):
    """The image magnified about the optical axis, as by another focal length.

    largest: largest magnification, 1 to 4; it is drawn from 1 / largest to largest, its logarithm uniformly. Ranges
    stay, and pixels take the value of the nearest one. Noise and lost pixels are magnified with the image. Raises
    BadConfig for a magnification out of range.
    """

    name = "zoom"
    version = 3
    largest: float = bounded(1.25, 1, 4)

    def __call__(self, image: CameraImage, random: np.random.Generator) -> CameraImage:
        return magnified(image, self.largest ** (2 * uniform(random) - 1))


def magnified(image: CameraImage, by: float) -> CameraImage:
    """The image magnified about the optical axis by its focal length."""
    (height, width), (x, y) = image.range.shape, image.centre_px
    rows, columns = (np.arange(height) + 0.5 - y) / by + y, (np.arange(width) + 0.5 - x) / by + x
    return take_grid(image, rows, columns, focal_px=image.focal_px * by)


@dataclass(frozen=True)
class Remnants(Checked, Transform):
    """Remnants of a wall behind the body, as the removal of a background leaves them in; they have no class.

    share: of the images that get any. nearest_m, farthest_m: distance of the wall, a tilted plane, behind the body's
    median range, drawn between the two; it is nowhere before the body's outline. Over up to 4 cm the range rises from
    the outline's to the wall's, as with sensors that match windows of several pixels.
    widest_m: remnants reach at most so far from the outline, 12 % farther aslant; how far is drawn for each image, and
    from place to place, so that much of an outline has none. Remnants have the body's noise and lose as many pixels.
    Raises BadConfig for a share or a distance out of range.
    """

    name = "remnants"
    share: float = bounded(0.4, 0, 1)
    nearest_m: float = bounded(0.05, 0, 10)
    farthest_m: float = bounded(0.8, 0, 10, not_below="nearest_m")
    widest_m: float = bounded(0.25, 0, 2)

    def __call__(self, image: CameraImage, random: np.random.Generator) -> CameraImage:
        box = ends_of(image.range)
        if uniform(random) >= self.share or box is None:
            return image
        middle = float(np.median(image.range[image.range > 0]))
        a_metre = image.focal_px / (middle * image.step_m)  # pixels
        reach, bias, width, gap = (
            low + (high - low) * uniform(random)
            for low, high in ((0.2, 1.0), (-0.7, 0.9), (0.0, 0.04), (self.nearest_m, self.farthest_m))
        )
        reach *= self.widest_m * a_metre
        (rows, top), (columns, left) = (
            _in_cells(*ends, side, math.ceil(reach))
            for ends, side in zip((box[:2], box[2:]), image.range.shape, strict=True)
        )
        if not rows or not columns:
            return image
        window = np.s_[top : top + rows * _CELL, left : left + columns * _CELL]
        ranges = image.range[window]
        in_cells = ranges.reshape(rows, _CELL, columns, _CELL)
        counts = np.count_nonzero(in_cells, axis=(1, 3))
        body = counts > 0
        own = np.where(body, in_cells.sum(axis=(1, 3)) / np.maximum(counts, 1), np.inf)
        outline, away = _spread(own, math.ceil(reach / _CELL))
        left_in = away * _CELL < reach * np.clip((_smooth(rows, columns, a_metre, random) + bias) / 2, 0, 1)
        amid = np.logical_and.reduce(_around(body, 1, corners=True))  # pixels lost amid a body show no wall
        left_in &= (away > 0) | ~amid
        down, across = (
            (np.arange(size) - size / 2) * (_CELL / a_metre / image.step_m) * most * (2 * uniform(random) - 1)
            for size, most in ((rows, 0.2), (columns, 0.5))
        )
        behind = np.maximum(middle + gap / image.step_m + np.add.outer(down, across) - outline, 0.03 / image.step_m)
        wall = outline + behind * np.clip(away * _CELL / max(width * a_metre, 1e-3), 0, 1)
        added = _of_pixels(left_in) & (ranges == 0)
        ranges[added] = _measured(_of_pixels(wall), ranges, int(body.sum()) * _CELL**2, random)[added]
        return image


def _measured(
    wall: NDArray[np.float64], body: NDArray[np.uint16], covered: int, random: np.random.Generator
) -> NDArray[np.float64]:
    """Ranges [H, W] of a wall, in steps, with the noise of a body's, and 0 where it is lost as the body's pixels are.

    covered: pixels of cells with any of the body. If up to a fifth of them are 0, these are beside it: none is lost.
    """
    apart = np.abs(np.diff(body.astype(np.int32), axis=1))[(body[:, 1:] > 0) & (body[:, :-1] > 0)]
    deviation = float(np.median(apart)) / 0.954 if len(apart) else 0.0  # of normal noise, by differences of pixels
    words = random.bit_generator.random_raw((body.size + 1) // 2).view(np.uint16).reshape(-1, 2)
    noise, kept = (words[: body.size, of].reshape(body.shape) / 65536 for of in (0, 1))
    seen = np.count_nonzero(body) / max(1, covered)
    found = np.clip(np.rint(wall + deviation * math.sqrt(12) * (noise - 0.5)), 1, _FARTHEST)
    return np.where(kept < (seen if seen < 0.8 else 1.0), found, 0.0)


def _in_cells(first: int, end: int, side: int, more: int) -> tuple[int, int]:
    """Number of whole cells, and first pixel, of an axis of `side` pixels around a box with `more` on each side."""
    begin = max(0, first - more)
    return (min(side, end + more) - begin) // _CELL, begin


def _of_pixels(cells: NDArray[Any]) -> NDArray[Any]:
    return cells.repeat(_CELL, axis=0).repeat(_CELL, axis=1)


def _around(cells: NDArray[Any], value: float, corners: bool) -> list[NDArray[Any]]:
    """The four cells [h, w] beside each; with `corners` all nine around it, itself included. `value`: outside."""
    rows, columns = cells.shape
    padded = np.pad(cells, 1, constant_values=value)
    every = [(down, across) for down in range(3) for across in range(3) if corners or (down + across) % 2]
    return [padded[down : down + rows, across : across + columns] for down, across in every]


def _spread(own: NDArray[np.float64], rings: int) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """The range of the nearest cell with one, not inf, and cells to it, [h, w] each; beyond `rings`, 0 and one more."""
    found, away = own.copy(), np.where(own < np.inf, 0, rings + 1)
    for ring in range(1, rings + 1):
        nearest = np.minimum.reduce(_around(found, np.inf, corners=ring % 2 == 0))
        new = (found == np.inf) & (nearest < np.inf)
        if not new.any():  # all cells have one, or none has
            break
        found[new], away[new] = nearest[new], ring
    return np.where(found < np.inf, found, 0.0), away


def _smooth(rows: int, columns: int, a_metre: float, random: np.random.Generator) -> NDArray[np.float64]:
    """A random field over cells, [rows, columns], of mean 0 and deviation about 1, smooth over 0.1 to 0.25 m."""
    wave = (0.1 + 0.15 * uniform(random)) * a_metre / _CELL
    (row, down), (column, across) = (np.divmod(np.arange(size) / wave, 1) for size in (rows, columns))
    size = int(row[-1]) + 2, int(column[-1]) + 2
    lattice = random.bit_generator.random_raw(size[0] * size[1]).reshape(size) / 2**64 - 0.5
    row, down, across = row.astype(np.intp), down[:, None], across[None]
    by_row = lattice[row] * (1 - down) + lattice[row + 1] * down
    column = column.astype(np.intp)
    field: NDArray[np.float64] = by_row[:, column] * (1 - across) + by_row[:, column + 1] * across
    return 5.0 * field


def take_grid(
    image: CameraImage, rows: NDArray[np.floating[Any]], columns: NDArray[np.floating[Any]], **camera: Any
) -> CameraImage:
    """The image with the pixels that hold the points (columns[j], rows[i]), in image coordinates; outside: background.

    rows, columns: increasing, float64 [H], [W]. camera: fields of the camera that change.
    """
    found = background(image, len(rows), len(columns))
    box = _held(image)
    if box is not None:
        down, along = _within(np.floor(rows), *box[:2]), _within(np.floor(columns), *box[2:])
        below, across = rows[down].astype(np.intp), columns[along].astype(np.intp)
        for source, target in _pairs(image, found):
            target[down, along] = source.take(below, axis=0).take(across, axis=1)
    return replace(found, **camera)


def _within(places: NDArray[np.floating[Any]], first: int, end: int) -> slice:
    """The stretch of increasing `places` that lie from `first` to below `end`."""
    return slice(*np.searchsorted(places, (first, end)).tolist())


def background(image: CameraImage, rows: int, columns: int) -> CameraImage:
    """The image with arrays of another size, in which nothing was measured; planes are 0, or `NOWHERE`."""
    ranges, labels = np.zeros((rows, columns), np.uint16), np.full((rows, columns), BACKGROUND, np.uint8)
    planes = {name: np.zeros((rows, columns), plane.dtype) for name, plane in image.planes.items()}
    if image.has_map:
        planes[TEMPLATE].fill(NOWHERE)
    return replace(image, range=ranges, labels=labels, planes=planes)


def _held(image: CameraImage) -> Box | None:
    """The smallest box that holds all that was measured; all of an image with planes, which hold more than that."""
    return (0, image.range.shape[0], 0, image.range.shape[1]) if image.planes else ends_of(image.range)


def _pairs(source: CameraImage, target: CameraImage) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
    """Range, labels and planes of two images, each with its partner."""
    yield source.range, target.range
    yield source.labels, target.labels
    for name, plane in source.planes.items():
        yield plane, target.planes[name]


def take_window(image: CameraImage, top: int, left: int, rows: int, columns: int) -> CameraImage:
    """A window of the image, in pixels as they are; what lies outside is background."""
    (height, width), (x, y) = image.range.shape, image.centre_px
    found = background(image, rows, columns)
    first, end = max(top, 0), min(top + rows, height)
    start, stop = max(left, 0), min(left + columns, width)
    if first < end and start < stop:
        for source, target in _pairs(image, found):
            target[first - top : end - top, start - left : stop - left] = source[first:end, start:stop]
    return replace(found, centre_px=(x - left, y - top))


def turned(image: CameraImage, angle_deg: float) -> CameraImage:
    """The image as a camera takes it that is turned by an angle about its axis, degrees, clockwise from behind.

    What leaves the image is lost; what comes into it is background.
    """
    cos, sin = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    (height, width), (x, y) = image.range.shape, image.centre_px
    found, box = background(image, height, width), _held(image)
    if box is not None:
        across, below = np.arange(width) + 0.5 - x, np.arange(height) + 0.5 - y  # of the pixels' centres, from the axis
        rows = np.floor(np.add.outer(cos * below + y, sin * across)).astype(np.intp)
        columns = np.floor(np.add.outer(x - sin * below, cos * across)).astype(np.intp)
        inside = (rows >= box[0]) & (rows < box[1]) & (columns >= box[2]) & (columns < box[3])
        sources = rows[inside], columns[inside]
        for source, target in _pairs(image, found):
            target[inside] = source[sources]
    return found
