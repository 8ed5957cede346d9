"""Frames of one sensor with the pixels of people marked, as every measurement here reads them, and surfaces in them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig
from bodyseg_data.machine import required
from bodyseg_data.rigs import Camera
from bodyseg_data.samples import box_of
from bodyseg_model.recordings import Frame, Skipping, evenly_apart, to_metres
from bodyseg_model.segmentation import Background, find_bodies

Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]

_POWERS: Final = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
_RADII: Final = (3, 8)
_SLOPE_ERROR: Final = 0.04  # error allowed for a fitted slope, as its tangent


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


def third_differences(range_m: NDArray[np.floating], known: Mask) -> Floats:
    """Third differences along rows and columns, scaled so that independent noise of the pixels keeps its deviation.

    (1, -3, 3, -1) / sqrt(20), in which quadratic surfaces cancel: [N], in the unit of range_m [H, W].
    """
    values = []
    image = range_m.astype(np.float64)
    for a, m in ((image, known), (image.T, known.T)):
        usable = m[:, :-3] & m[:, 1:-2] & m[:, 2:-1] & m[:, 3:]
        third = (a[:, :-3] - a[:, 3:] + 3 * (a[:, 2:-1] - a[:, 1:-2])) / np.sqrt(20)
        values.append(third[usable])
    return np.concatenate(values)


def smooth_surface(range_m: NDArray[np.floating], known: Mask, noise_m: float, camera: Camera) -> tuple[Floats, Floats]:
    """Fit a quadratic in row and column to the known pixels of a window around each pixel, as large as noise needs.

    range_m: [H, W], metres; known: bool [H, W]; noise_m: of the ranges. Returns the surface's range, metres, and the
    tangent of its slope to the image plane, [H, W] each; NaN where half of a window or more is not known.
    """
    from scipy.ndimage import correlate1d

    along = partial(correlate1d, mode="constant")
    surface, slope = np.full(range_m.shape, np.nan), np.full(range_m.shape, np.nan)
    middle = float(np.median(range_m[known])) if known.any() else 1.0  # subtracted, or squares lose digits
    width = np.sqrt(noise_m * np.sqrt(12) * camera.focal_px / middle / _SLOPE_ERROR)
    radius = int(np.clip(np.ceil((width - 1) / 2), *_RADII))
    inside = box_of(known, radius)
    if inside is None:
        return surface, slope
    weight = known[inside].astype(np.float64)
    image = np.where(known[inside], range_m[inside] - middle, 0)
    offsets = np.arange(-radius, radius + 1) / radius

    def moment(of: Floats, across: int, down: int) -> Floats:
        return np.asarray(along(along(of, offsets**across, 1), offsets**down, 0))

    enough = moment(weight, 0, 0) > len(offsets) ** 2 / 2
    moments = {(i, j): moment(weight, i, j)[enough] for i in range(5) for j in range(5 - i)}
    matrix = np.stack([np.stack([moments[a + c, b + d] for c, d in _POWERS], -1) for a, b in _POWERS], -2)
    right = np.stack([moment(image, *powers)[enough] for powers in _POWERS], -1)
    fitted = np.linalg.solve(matrix + 1e-6 * np.eye(len(_POWERS)), right[..., None])[..., 0]
    surface[inside][enough] = fitted[:, 0] + middle
    slope[inside][enough] = np.hypot(fitted[:, 1], fitted[:, 2]) / radius * camera.focal_px / (fitted[:, 0] + middle)
    return surface, slope


def jumps(range_m: NDArray[np.floating], known: Mask, least_m: float) -> Mask:
    """The known pixels whose range differs by more than `least_m` from that of a known neighbour, bool [H, W]."""
    found = np.zeros(known.shape, np.bool_)
    for axis in (0, 1):
        a, b = (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])
        both = known[a] & known[b] & (np.abs(np.diff(range_m, axis=axis)) > least_m)
        found[a] |= both
        found[b] |= both
    return found


_MOST_FRAMES: Final = 40  # most frames that are measured: of more, groups of four neighbours, evenly spread
_STILL_SHARE: Final = 0.5  # least share of a still body in one frame that another, which may lose as much, has, too
_BLOCK: Final = 8
_LARGE_BLOCK: Final = 32
_COHERENT: Final = 0.6  # of a moving body, means of large blocks are at least this share of those of small ones
_ALIKE: Final = 0.5  # correlation of blocks between two pairs of frames: of motion 0.7 and more, of noise 0.2 at most
_MOST_DRIFT: Final = 0.4  # share of the pixels' differences in block means; 64 independent pixels give an eighth
_LEAST_DRIFT_M: Final = 3e-4


@dataclass(frozen=True)
class MarkedFrame:
    """One frame. stored: uint16 [H, W] as in the file. range_m: float32 [H, W], metres, 0 where nothing was measured.

    body: bool [H, W], measured pixels of people; room: all other measured pixels.
    """

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
        values = third_differences(self.range_m, self.body)
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
        return bool(self.pairs) and all(self._still(a, b) for a, b in (*self.pairs, (0, len(self.frames) - 1)))

    @cached_property
    def fours(self) -> tuple[tuple[MarkedFrame, ...], ...]:
        """Frames a, b, c and d, none twice: b follows a, and d follows c. What a driver repeats is left out."""
        successors = {b for _, b in self.pairs}
        twos: list[tuple[MarkedFrame, MarkedFrame]] = []
        first: MarkedFrame | None = None
        for number, frame in enumerate(self.frames):
            if number not in successors:
                first = None
            elif not (frame.stored != self.frames[number - 1].stored).any():
                continue
            if first is None:
                first = frame
            else:
                twos.append((first, frame))
                first = None
        return tuple((*one, *other) for one, other in zip(twos[::2], twos[1::2], strict=False))

    @cached_property
    def _sways(self) -> bool:
        """True if blocks change alike in two pairs of four frames, as with moving bodies, or if there are no fours."""
        if not self.fours:
            return True
        for four in (*self.fours, (*self.fours[0][:2], *self.fours[-1][2:])):
            known = np.logical_and.reduce([frame.body for frame in four])
            a, b, c, d = (_block_means(frame.range_m, known, _BLOCK)[0] for frame in four)
            for one, other in ((b - a, d - c), (c - a, d - b), (d - a, c - b)):
                if len(a) < 4 or abs(one @ other) > _ALIKE * np.linalg.norm(one) * np.linalg.norm(other):
                    return True
        return False

    def _still(self, a: int, b: int) -> bool:
        """True if two bodies cover each other and their ranges differ from pixel to pixel, not over areas."""
        bodies = [self.frames[index].body for index in (a, b)]
        first, second = (closing(body, 2) for body in bodies)
        smaller = min(np.count_nonzero(first), np.count_nonzero(second))
        if not smaller or np.count_nonzero(first & second) < _STILL_SHARE * smaller:
            return False
        both = bodies[0] & bodies[1]
        difference = self.frames[b].range_m - self.frames[a].range_m
        means, counts = _block_means(difference, both, _BLOCK)
        if len(means) < 4:
            return False
        spread = _robust(difference[both])
        # Fewer pixels in a block leave more of the noise in its mean.
        limit = spread * (2 / np.sqrt(np.median(counts)) + _MOST_DRIFT / 2) + _LEAST_DRIFT_M
        large, _ = _block_means(difference, both, _LARGE_BLOCK)
        shared = len(large) >= 4 and _robust(large) <= _COHERENT * _robust(means)
        return _robust(means) <= limit or (shared and not self._sways)


def _block_means(image: NDArray[np.float32], known: Mask, side: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Means of an image's known pixels in square blocks with at least a quarter known, [N], and pixels of each."""
    down, across = (length // side for length in known.shape)
    cut = (each[: down * side, : across * side] for each in (np.where(known, image, 0), known))
    sums, counts = (each.reshape(down, side, across, side).sum((1, 3)) for each in cut)
    full = counts >= side * side // 4
    return sums[full] / counts[full], counts[full]


def mean_of(frames: Sequence[MarkedFrame]) -> tuple[Floats, Mask, float]:
    """Mean range of a still body [H, W], the pixels measured in a fifth of its frames or more, and the mean's noise."""
    counts = sum(frame.body.astype(np.int64) for frame in frames)
    total = sum(np.where(frame.body, frame.range_m, 0).astype(np.float64) for frame in frames)
    known = np.asarray(counts >= max(1, len(frames) // 5))
    noise_m = float(np.linalg.norm([frame.noise_m for frame in frames])) / len(frames)
    return np.where(known, total / np.maximum(counts, 1), 0), known, noise_m


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
    for library in ("scipy", "skimage"):  # which all of this room needs
        required(library, "bodyseg sensor fit", "sensor")
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
        range_m = to_metres(stored, step_m)
        body = _body(range_m, camera, background, nearer_than_m, quarters)
        frames.append(MarkedFrame(stored, range_m, body))
    if not any(frame.body.any() for frame in frames):
        raise BadConfig(
            "no frame shows a body: are --units, --near, --far or --nearer-than right, and the camera's focal length, "
            f"{camera.focal_px:.5g} px? {files[0].where}"
        )
    pairs = tuple((places[a], places[b]) for a, b in pairs if a in places and b in places)
    return MarkedRecording(tuple(frames), camera, step_m, pairs)


def chosen_frames(count: int, most: int = _MOST_FRAMES) -> tuple[list[int], tuple[tuple[int, int], ...]]:
    """Indices of the frames to measure, ascending, and pairs of neighbours as positions in that list."""
    if count <= most:
        return list(range(count)), tuple((index, index + 1) for index in range(count - 1))
    chosen = sorted({start + shift for start in evenly_apart(count - 3, most // 4) for shift in range(4)})
    pairs = [(index, index + 1) for index in range(len(chosen) - 1) if chosen[index + 1] == chosen[index] + 1]
    return chosen, tuple(pairs)


def _body(
    range_m: NDArray[np.float32], camera: Camera, background: Background, nearer_than_m: float | None, quarters: int
) -> Mask:
    if nearer_than_m is not None:
        return (range_m > 0) & (range_m < nearer_than_m)
    upright = np.ascontiguousarray(np.rot90(range_m, -quarters))
    marked = np.zeros(upright.shape, np.bool_)
    for found in find_bodies(upright, camera.turned(quarters), background):
        marked.ravel()[found.pixels] = True
    return np.ascontiguousarray(np.rot90(marked, quarters))


def _robust(values: NDArray[np.float32]) -> float:
    """Standard deviation by the median of sizes; where more than half are 0, by the mean square."""
    median = float(np.median(np.abs(values))) if len(values) else 0.0
    return 1.4826 * median if median else float(np.sqrt(np.mean(np.square(values)))) if len(values) else 0.0
