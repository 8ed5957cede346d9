"""Frames of one sensor with the pixels of people marked, as every measurement here reads them, and surfaces in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.artifacts import box_of
from bodyseg_data.core import BadConfig
from bodyseg_data.machine import missing_library
from bodyseg_data.rigs import Camera
from bodyseg_model.recordings import Frame, Skipping, evenly_apart, to_metres
from bodyseg_model.segmentation import Background, find_bodies

Mask = NDArray[np.bool_]


def require_libraries_of_fit() -> None:
    """Raise MissingLibrary unless SciPy and scikit-image, which all of this room needs, are installed."""
    try:
        import scipy  # noqa: F401
        import skimage  # noqa: F401
    except ImportError as error:
        raise missing_library("bodyseg sensor fit", error, extra="sensor") from error


def dilated(mask: Mask, radius: int) -> Mask:
    """Grow a mask by a square of 2 radius + 1 pixels a side, bool [H, W]."""
    from scipy.ndimage import maximum_filter

    grown: Mask = maximum_filter(mask, 2 * radius + 1, mode="constant")
    return grown


def eroded(mask: Mask, radius: int) -> Mask:
    """Shrink a mask by such a square; the world outside the image counts as empty."""
    from scipy.ndimage import minimum_filter

    shrunk: Mask = minimum_filter(mask, 2 * radius + 1, mode="constant")
    return shrunk


def closing(mask: Mask, radius: int) -> Mask:
    """Fill gaps narrower than such a square, bool [H, W]; nothing set is lost, also at the image's border."""
    return eroded(dilated(np.pad(mask, 2 * radius), radius), radius)[2 * radius : -2 * radius, 2 * radius : -2 * radius]


def opening(mask: Mask, radius: int) -> Mask:
    """Keep what such a square fits into, bool [H, W]."""
    return dilated(eroded(mask, radius), radius)


def holes(mask: Mask, outside: Mask) -> Mask:
    """The empty pixels that neither the image's border nor a pixel of `outside` reaches through empty ones.

    mask, outside: bool [H, W]. Steps go to the four neighbours.
    """
    from skimage.measure import label

    regions = label(np.pad(~mask, 1, constant_values=True), connectivity=1)  # 0 on the mask
    inside = regions[1:-1, 1:-1]
    open_regions = np.append(np.unique(inside[outside]), (regions[0, 0], 0))
    return np.isin(inside, open_regions, invert=True)


def connected(mask: Mask, pixel: int) -> Mask:
    """The pixels of a mask that steps to the four neighbours reach from one of them, a flat index; bool [H, W]."""
    from skimage.segmentation import flood

    reached: Mask = flood(mask, np.unravel_index(pixel, mask.shape), connectivity=1)
    return reached


Floats = NDArray[np.float64]

_POWERS: Final = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
_FULL: Final = 0.5  # least share of a window's pixels that must be measured for a fit


@dataclass(frozen=True)
class SmoothSurface:
    """A smooth surface in a range image, all arrays [H, W].

    range_m: metres, NaN where there were too few pixels. slope_m: metres a pixel, the length of the gradient.
    incidence_rad: the angle between a pixel's ray and the surface's normal, by the smaller differences to its
    neighbours as artifacts take it (`bodyseg_data.artifacts.slants`). misfit_m: standard deviation of the
    pixels around the surface within the window.
    """

    range_m: Floats
    slope_m: Floats
    incidence_rad: Floats
    misfit_m: Floats

    def at(self, known: Mask) -> Mask:
        """The pixels of `known` at which there is a surface."""
        return known & np.isfinite(self.range_m)


def smooth_surface(range_m: NDArray[np.floating], known: Mask, camera: Camera, radius: int) -> SmoothSurface:
    """Fit a quadratic in row and column to the known pixels of each window, 2 radius + 1 pixels a side.

    range_m: [H, W], metres. known: bool [H, W], the pixels to fit, of one continuous surface as far as can be told.
    """
    inside = box_of(known, radius)
    if inside is None:
        empty = np.full(range_m.shape, np.nan)
        return SmoothSurface(empty, empty.copy(), empty.copy(), empty.copy())
    weight = known[inside].astype(np.float64)
    # About their middle, so that squares lose no digits.
    middle = float(np.median(range_m[known]))
    image = np.where(known[inside], range_m[inside].astype(np.float64) - middle, 0)
    offsets = np.arange(-radius, radius + 1, dtype=np.float64)
    columns = [_along(weight, offsets**power, 1) for power in range(5)]
    moments = {(i, j): _along(columns[i], offsets**j, 0) for i in range(5) for j in range(5 - i)}
    sides = [_along(image, offsets**power, 1) for power in range(3)]
    right = np.stack([_along(sides[i], offsets**j, 0) for i, j in _POWERS], -1)
    square = _along(_along(image**2, offsets**0, 1), offsets**0, 0)
    enough = moments[0, 0] >= max(_FULL * len(offsets) ** 2, len(_POWERS) + 3)
    few = {power: moment[enough] for power, moment in moments.items()}
    matrix = np.stack([np.stack([few[a + c, b + d] for c, d in _POWERS], -1) for a, b in _POWERS], -2)
    fitted = np.full((*enough.shape, 6), np.nan)
    scale = np.array([float(radius) ** (i + j) for i, j in _POWERS])
    scaled = matrix / (scale[:, None] * scale)
    scaled += 1e-9 * few[0, 0][:, None, None] * np.eye(6)
    fitted[enough] = np.linalg.solve(scaled, (right[enough] / scale)[..., None])[..., 0] / scale
    rest = np.maximum(square - (fitted * right).sum(-1), 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        misfit = np.sqrt(rest / (moments[0, 0] - len(_POWERS)))
    value, across, down = fitted[..., 0] + middle, fitted[..., 1], fitted[..., 2]
    full = [np.full(range_m.shape, np.nan) for _ in range(4)]
    least = (_smaller(across, fitted[..., 3]), _smaller(down, fitted[..., 5]))
    parts = (value, np.hypot(across, down), _incidence(value, *least, camera, inside), misfit)
    for whole, part in zip(full, parts, strict=True):
        whole[inside] = part
    return SmoothSurface(*full)


def third_differences(range_m: NDArray[np.floating], known: Mask) -> tuple[Floats, NDArray[np.intp]]:
    """Third differences along rows and columns, scaled so that independent noise of the pixels keeps its deviation.

    Returns the differences [N], in the unit of range_m, and their pixels [N], flat indices. Quadratic surfaces cancel:
    (1, -3, 3, -1) / sqrt(20).
    """
    values, pixels = [], []
    index = np.arange(known.size).reshape(known.shape)
    image = range_m.astype(np.float64)
    for a, m, i in ((image, known, index), (image.T, known.T, index.T)):
        usable = m[:, :-3] & m[:, 1:-2] & m[:, 2:-1] & m[:, 3:]
        third = (a[:, :-3] - a[:, 3:] + 3 * (a[:, 2:-1] - a[:, 1:-2])) / np.sqrt(20)
        values.append(third[usable])
        pixels.append(i[:, 1:-2][usable])
    return np.concatenate(values), np.concatenate(pixels)


def _smaller(slope: Floats, bend: Floats) -> Floats:
    """The smaller one of the differences slope + bend and slope - bend to a pixel's two neighbours."""
    forward, backward = slope + bend, slope - bend
    smaller: Floats = np.where(np.abs(forward) <= np.abs(backward), forward, backward)
    return smaller


def _incidence(value: Floats, across: Floats, down: Floats, camera: Camera, box: tuple[slice, slice]) -> Floats:
    """Angle between ray and normal, radians: the normal of z(u, v) is (-f z_u, -f z_v, z + u z_u + v z_v)."""
    v = (np.arange(camera.rows)[box[0]] + 0.5 - camera.centre_px[1])[:, None]
    u = (np.arange(camera.columns)[box[1]] + 0.5 - camera.centre_px[0])[None]
    focal = camera.focal_px
    normal = np.sqrt((focal * across) ** 2 + (focal * down) ** 2 + (value + u * across + v * down) ** 2)
    ray = np.sqrt(1 + (u / focal) ** 2 + (v / focal) ** 2)
    angle: Floats = np.arccos(np.clip(value / (normal * ray), 0, 1))
    return angle


def _along(image: Floats, kernel: Floats, axis: int) -> Floats:
    """Correlate with a kernel of odd length along one axis; the world outside the image is 0."""
    from scipy.ndimage import correlate1d

    found: Floats = correlate1d(image, kernel, axis, mode="constant")
    return found


MOST_FRAMES: Final = 40
"""The most frames that are measured: of a longer recording, pairs of neighbours spread evenly over it."""

STILL_SHARE: Final = 0.5
"""Least overlap of the bodies of two frames (intersection over union) for a body that stands still; half of each may be
lost, and elsewhere."""

_BLOCK: Final = 8
_MOST_DRIFT: Final = 0.4  # of the pixels' differences; blocks of 64 independent pixels show an eighth
_LEAST_DRIFT_M: Final = 3e-4


@dataclass(frozen=True)
class MarkedFrame:
    """One frame. stored: uint16 [H, W] as in the file. range_m: float32 [H, W], metres, 0 where nothing was measured.

    body: bool [H, W], measured pixels of people; room: all other measured pixels.
    """

    name: str
    stored: NDArray[np.uint16]
    range_m: NDArray[np.float32]
    body: Mask

    @cached_property
    def room(self) -> Mask:
        """Measured pixels that show no body, bool [H, W]."""
        return (self.range_m > 0) & ~self.body

    @cached_property
    def noise_m(self) -> float:
        """A robust standard deviation of the body's noise, metres, by `third_differences`; 0 where there are none."""
        values, _ = third_differences(self.range_m, self.body)
        return float(1.4826 * np.median(np.abs(values))) if len(values) else 0.0


@dataclass(frozen=True)
class MarkedRecording:
    """Frames of one camera. step_m: metres in one step of the files. pairs: indices of successive frames."""

    frames: tuple[MarkedFrame, ...]
    camera: Camera
    step_m: float
    pairs: tuple[tuple[int, int], ...] = ()

    @cached_property
    def still(self) -> bool:
        """True if the bodies of all pairs and of the first and last frame stand still: frames then differ by noise."""
        if not self.pairs:
            return False
        return all(self._still(a, b) for a, b in (*self.pairs, (0, len(self.frames) - 1)))

    @cached_property
    def still_room(self) -> bool:
        """True if the room behind the bodies stays the same between the frames of every pair."""
        return bool(self.pairs) and all(self.unmoved(a, b, body=False) for a, b in self.pairs)

    def unmoved(self, a: int, b: int, body: bool) -> bool:
        """Compare two frames: True if the body's (or the room's) ranges differ from pixel to pixel, not over areas."""
        first, second = self.frames[a], self.frames[b]
        both = first.body & second.body if body else first.room & second.room
        difference = np.where(both, second.range_m - first.range_m, 0)
        rows, columns = (side // _BLOCK * _BLOCK for side in both.shape)
        blocks = difference[:rows, :columns].reshape(rows // _BLOCK, _BLOCK, -1, _BLOCK).swapaxes(1, 2)
        counts = both[:rows, :columns].reshape(rows // _BLOCK, _BLOCK, -1, _BLOCK).swapaxes(1, 2).sum((2, 3))
        full = counts >= _BLOCK * _BLOCK // 4
        if np.count_nonzero(full) < 4:
            return False
        means = blocks.sum((2, 3))[full] / counts[full]
        spread = _robust(difference[both])
        # Fewer pixels in a block leave more of the noise in its mean.
        by_chance = spread / np.sqrt(np.median(counts[full]))
        return bool(_robust(means) <= 2 * by_chance + _MOST_DRIFT * spread / 2 + _LEAST_DRIFT_M)

    def _still(self, a: int, b: int) -> bool:
        first, second = (closing(self.frames[index].body, 2) for index in (a, b))
        either = np.count_nonzero(first | second)
        if not either or np.count_nonzero(first & second) < STILL_SHARE * either:
            return False
        return self.unmoved(a, b, body=True)


def read_recording(
    files: Sequence[Frame],
    camera: Camera,
    background: Background,
    nearer_than_m: float | None,
    skipping: Skipping | None = None,
    quarters: int = 0,
) -> MarkedRecording:
    """Read frames and find the bodies in them.

    files: in the order of time. nearer_than_m: every measured pixel nearer than this is a body's; None: bodies are
    found by `background`, as `bodyseg segment` does. skipping: of frames that cannot be read, by default none.
    quarters: right angles by which frames are turned clockwise where bodies are sought, and nowhere else. Raises
    BadConfig for frames that cannot be read, that are not the camera's, of different units, or none of which shows a
    body; MissingLibrary without the extra `sensor`.
    """
    require_libraries_of_fit()
    skipping = skipping or Skipping()
    step_m = files[0].step_m
    chosen, pairs = chosen_frames(len(files))
    frames: list[MarkedFrame] = []
    places: dict[int, int] = {}
    for place, index in enumerate(chosen):
        if files[index].step_m != step_m:
            raise BadConfig(
                f"frames must have one unit, found {step_m:g} and {files[index].step_m:g} m a step: "
                f"{files[index].where}"
            )
        stored = skipping.read(files[index])
        if stored is None:
            continue
        places[place] = len(frames)
        if stored.shape != (camera.rows, camera.columns):
            raise BadConfig(
                f"frames must have the size of the first, {camera.rows} x {camera.columns}, "
                f"found {stored.shape[0]} x {stored.shape[1]}: {files[index].where}"
            )
        frames.append(_frame(files[index].name, stored, camera, step_m, background, nearer_than_m, quarters))
    if not any(frame.body.any() for frame in frames):
        raise BadConfig(
            "no frame shows a body: are --units, --near, --far or --nearer-than right, and the camera's focal length, "
            f"{camera.focal_px:.5g} px? {files[0].where}"
        )
    pairs = tuple((places[a], places[b]) for a, b in pairs if a in places and b in places)
    return MarkedRecording(tuple(frames), camera, step_m, pairs)


def chosen_frames(count: int, most: int = MOST_FRAMES) -> tuple[list[int], tuple[tuple[int, int], ...]]:
    """Indices of the frames to measure, ascending, and pairs of neighbours as positions in that list."""
    if count <= most:
        return list(range(count)), tuple((index, index + 1) for index in range(count - 1))
    chosen = sorted({start + shift for start in evenly_apart(count - 1, most // 2) for shift in (0, 1)})
    pairs = [(index, index + 1) for index in range(len(chosen) - 1) if chosen[index + 1] == chosen[index] + 1]
    return chosen, tuple(pairs)


def _frame(
    name: str,
    stored: NDArray[np.uint16],
    camera: Camera,
    step_m: float,
    background: Background,
    nearer_than_m: float | None,
    quarters: int,
) -> MarkedFrame:
    range_m = to_metres(stored, step_m)
    body = np.zeros(stored.shape, np.bool_)
    if nearer_than_m is not None:
        body[(range_m > 0) & (range_m < nearer_than_m)] = True
    else:
        upright = np.ascontiguousarray(np.rot90(range_m, -quarters))
        marked = np.zeros(upright.shape, np.bool_)
        for found in find_bodies(upright, camera.turned(quarters), background):
            marked.ravel()[found.pixels] = True
        body = np.ascontiguousarray(np.rot90(marked, quarters))
    return MarkedFrame(name, stored, range_m, body)


def _robust(values: NDArray[np.float32]) -> float:
    """Standard deviation by the median of sizes; where more than half are 0, by the mean square."""
    median = float(np.median(np.abs(values))) if len(values) else 0.0
    return 1.4826 * median if median else float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0
